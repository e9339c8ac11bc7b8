"""Remembers which logs were brought into a local directory, in a file there. Layer: client.

Each line is a log as JSON; a later line of the same log counts. Lines are only added, so that a power cut
loses at most the last one.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

NAME = ".mavftpfs-logs"
"""Of the file."""

HEAD = 4096
"""First bytes by which logs of the same name and size are told apart if they have no time."""


@dataclass(frozen=True, slots=True)
class Brought:
    """A log that was brought. path: on the vehicle; vehicle: its unique id, None if that was not asked for;
    file: below the local directory; size: bytes; mtime: seconds UTC, None if unknown.

    head: the CRC32 of its first HEAD bytes, None if that was not noted. proven: its checksum was compared, or
    did not need to be. handed_on: `--exec` is done with it.
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


class Memory:
    """What is known of the logs in a directory; read when it is made."""

    def __init__(self, local: Path) -> None:
        """Raises: OSError: it cannot be read."""
        self._place = local / NAME
        self._logs: dict[Key, Brought] = {}
        for line in self._read():
            log = _parsed(line)
            if log is not None:
                self._logs[log.vehicle, log.path] = log

    def of(self, vehicle: str | None, path: str) -> Brought | None:
        """Return what is known of a log."""
        return self._logs.get((vehicle, path))

    def logs(self) -> list[Brought]:
        """Return all logs that are known."""
        return list(self._logs.values())

    def begin(self) -> None:
        """Make the file, which marks the directory.

        Raises:
            OSError: the local disk does not take it.
        """
        self._place.touch()

    def is_there(self) -> bool:
        """Return whether the file is there."""
        return self._place.exists()

    def note(self, log: Brought) -> None:
        """Remember a log, in place of what was known of it.

        Raises:
            OSError: the local disk does not take it.
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


def _line(log: Brought) -> bytes:
    """Return a log as a line. It begins with a line end, in case the last line was cut."""
    return b"\n" + json.dumps(asdict(log)).encode() + b"\n"


def _parsed(line: bytes) -> Brought | None:
    """Return the log of a line, None if the line is damaged."""
    try:
        facts: dict[str, Any] = json.loads(line)
        log = Brought(**facts)
    except (ValueError, TypeError, RecursionError):
        return None
    return log if isinstance(log.path, str) and isinstance(log.size, int) else None
