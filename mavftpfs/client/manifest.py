"""The manifest of downloaded logs: a file in the local directory. Layer: client.

Each line describes a log as JSON; the last line of a log counts. Lines are only added, so that a power cut
loses at most the last one.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

NAME = ".mavftpfs-logs"
"""Name of the file."""

HEAD = 4096
"""A log without a time is recognised by the CRC32 of so many first bytes."""


@dataclass(frozen=True, slots=True)
class Downloaded:
    """A downloaded log. path: on the vehicle; file: below the local directory; size: in bytes; mtime: seconds
    UTC, None if the vehicle reports no times.

    vehicle: its unique id, None if sync did not ask for it. head: the CRC32 of the first HEAD bytes, None if
    unknown. proven: its checksum was compared, or is not required. handed_on: the command of `--exec` has
    run, or there is none.
    """

    path: str
    file: str
    size: int
    mtime: int | None
    vehicle: str | None = None
    head: int | None = None
    proven: bool = True
    handed_on: bool = True


Key = tuple[str | None, str]


class Manifest:
    """The logs that the manifest of a directory names when this object is made, and those noted since."""

    def __init__(self, local: Path) -> None:
        """Raises: OSError: the file cannot be read."""
        self.local = local
        self._place = local / NAME
        self._logs: dict[Key, Downloaded] = {}
        for line in self._read():
            log = _parsed(line)
            if log is not None:
                self._logs[log.vehicle, log.path] = log

    def of(self, vehicle: str | None, path: str) -> Downloaded | None:
        """Return the manifest's entry for a log."""
        return self._logs.get((vehicle, path))

    def logs(self) -> list[Downloaded]:
        """Return all logs of the manifest."""
        return list(self._logs.values())

    def begin(self) -> None:
        """Make the file, which marks the directory.

        Raises:
            OSError: the local disk refuses it.
        """
        self._place.touch()

    def is_there(self) -> bool:
        """Return whether the file is there."""
        return self._place.exists()

    def note(self, log: Downloaded) -> None:
        """Write down a log, replacing its entry in the manifest.

        Raises:
            OSError: the local disk refuses it.
        """
        if self.of(log.vehicle, log.path) == log:
            return
        with self._place.open("ab") as file:
            file.write(_line(log))
            file.flush()
            os.fsync(file.fileno())
        self._logs[log.vehicle, log.path] = log

    def _read(self) -> list[bytes]:
        try:
            return self._place.read_bytes().splitlines()
        except FileNotFoundError:
            return []


def _line(log: Downloaded) -> bytes:
    """Return a log as a line. The line begins with a line end, in case the last line was cut."""
    return b"\n" + json.dumps(asdict(log)).encode() + b"\n"


def _parsed(line: bytes) -> Downloaded | None:
    """Return the log of a line, None if the line is damaged."""
    try:
        facts: dict[str, Any] = json.loads(line)
        log = Downloaded(**facts)
    except (ValueError, TypeError, RecursionError):
        return None
    return log if isinstance(log.path, str) and isinstance(log.size, int) else None
