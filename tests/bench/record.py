"""The JSON file that the bench writes: one section for each part, so that parts can be measured anew alone.

Nothing in it names the machine, or a path on it.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results" / "results.json"
PACKAGES = ("mavftpfs", "mavsdk", "pyfuse3", "pymavlink", "trio")


def sections(path: Path) -> dict[str, dict[str, Any]]:
    """Return all sections by part; none if there is no file yet."""
    found: dict[str, dict[str, Any]] = json.loads(path.read_text())["sections"] if path.exists() else {}
    return found


def put(path: Path, part: str, argv: Sequence[str], load: float, results: Any) -> None:
    """Replace a part's section.

    argv: what it was run with. load: the machine's, before it began: seconds of a busy one are worth little.
    """
    words = [word for before, word in zip(["", *argv], argv, strict=False) if "--json" not in (before, word)]
    versions = {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}
    section = {
        "command": " ".join(["scripts/bench", part, *words]),
        "cpus": os.cpu_count(),
        "date": date.today().isoformat(),
        "load": round(load, 1),
        "results": results,
        "versions": versions,
    }
    content = {"schema": 1, "sections": {**sections(path), part: section}}
    path.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")
