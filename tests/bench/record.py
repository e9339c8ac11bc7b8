"""The JSON file that the bench writes: one section for each part, so that parts can be measured anew alone.

    {"schema": 1, "sections": {"mount": {"command": ..., "date": ..., "versions": ..., "results": ...}, ...}}

Nothing in it names the machine, or a path on it.
"""

from __future__ import annotations

import json
import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

SCHEMA = 1
PACKAGES = ("mavftpfs", "mavsdk", "pyfuse3", "pymavlink", "trio")


class Record:
    """One such file; a section that is put there replaces its predecessor and leaves the others alone."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def sections(self) -> dict[str, dict[str, Any]]:
        """Return all sections; none if there is no file yet.

        Raises:
            ValueError: the file is of another schema, or no JSON.
        """
        if not self.path.exists():
            return {}
        content = json.loads(self.path.read_text())
        if not isinstance(content, dict) or content.get("schema") != SCHEMA:
            raise ValueError(f"{self.path} was not written by this bench")
        sections: dict[str, dict[str, Any]] = content["sections"]
        return sections

    def put(self, name: str, command: str, results: Any, date: str, load: float) -> None:
        """Write a section: what the command found, with versions and the date as the user gave it.

        load: the machine's load when it began; beyond a part of `cpus` seconds are worth little.
        """
        sections = self.sections()
        sections[name] = {
            "command": command,
            "cpus": os.cpu_count(),
            "date": date,
            "load": round(load, 1),
            "results": results,
            "versions": versions(),
        }
        content = {"schema": SCHEMA, "sections": sections}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")


def versions() -> dict[str, str]:
    """Return what was measured with."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}
