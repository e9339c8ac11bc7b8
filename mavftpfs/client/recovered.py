"""The files below `recovered`, which did not reach a vehicle. Layer: client; prints nothing.

A mount that ends with undelivered files moves them there, with a `NAME.json` beside each file
(cache.recovery). The next mount moves there what a killed mount held.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.model import normalise


@dataclass(frozen=True, slots=True)
class Recovered:
    """The copy here of a file that did not reach the vehicle.

    facts: the description that lies beside it as JSON.
    """

    file: Path
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def path(self) -> bytes | None:
        """Its path on the vehicle, None if the description does not tell that."""
        path = self.facts.get("path")
        return normalise(os.fsencode(path)) if isinstance(path, str) and path else None

    @property
    def size(self) -> int:
        """Bytes of the local copy."""
        return self.file.stat().st_size

    @property
    def vehicle(self) -> str:
        """Its vehicle, for people; "" if the description does not tell that."""
        system, uid = self.facts.get("system"), self.facts.get("uid")
        if system is None:
            return ""
        return f"vehicle {system} (id {uid})" if uid else f"vehicle {system}"

    def is_of_another(self, vehicle: Mapping[str, Any]) -> bool:
        """Return whether the file is of another vehicle than this one (as in `status --json`). False if one
        of them has no unique id.

        A board may have a long id and a short one, and only the short one goes over MAVLink 1. After one of
        them the other counts as another board's.
        """
        mine, other = self.facts.get("uid"), vehicle.get("uid")
        return bool(mine and other and mine != other)

    @property
    def hindrance(self) -> str:
        """Why `recover` cannot put the file back, or ""."""
        if self.path is None:
            return "where it belongs was not written down"
        if "whole" not in self.facts:
            return "a program was still writing it, so it may be a part only"
        if self.facts.get("broken"):
            return "a write failed, so this is only the part that was written before"
        return "" if self.facts.get("whole") else "only the changed parts of it are here"


def recovered_below(base: Path) -> list[Recovered]:
    """Return all files in the recovery directories, the oldest directory first.

    Raises:
        UsageError: they cannot be read.
    """
    try:
        directories = sorted(path for path in base.iterdir() if path.is_dir())
    except FileNotFoundError:
        return []
    except OSError as exc:
        raise UsageError(f"{base}: {exc.strerror}") from exc
    return [copy for directory in directories for copy in recovered_in(directory)]


def recovered_in(directory: Path) -> list[Recovered]:
    """Return the files in one recovery directory. The descriptions of files that a person removed go, too.

    Raises:
        UsageError: it cannot be read.
    """
    try:
        paths = {path for path in directory.iterdir() if path.is_file() and not path.is_symlink()}
    except OSError as exc:
        raise UsageError(f"{directory}: {exc.strerror}") from exc
    files = {path for path in paths if not (path.suffix == ".json" and path.with_suffix("") in paths)}
    strays = {path for path in files if Path(f"{path}.json") not in paths and _is_description(path)}
    for stray in strays:
        with suppress(OSError):
            stray.unlink()
    return [Recovered(path, _read_facts(Path(f"{path}.json"))) for path in sorted(files - strays)]


def _is_description(path: Path) -> bool:
    """Return whether a file describes another one; a user's file may have such a name, too."""
    return path.suffix == ".json" and _read_facts(path).keys() >= {"path", "system", "uid"}


def _read_facts(path: Path) -> dict[str, Any]:
    """Return the content of a description; {} if it is damaged."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def chosen(names: Sequence[str], base: Path) -> list[Recovered]:
    """Return the files that a person named: by their paths, or by a directory for all that is in it.

    Raises:
        UsageError: there is no such file.
    """
    found: list[Recovered] = []
    for name in names:
        path = Path(name) if os.path.exists(name) else base / name
        if path.is_dir():
            found += recovered_in(path)
            continue
        if not path.is_file():
            raise UsageError(f"{name} is not a recovered file; list them with: mavftpfs recover")
        found += [copy for copy in recovered_in(path.parent) if copy.file.name == path.name]
    return found
