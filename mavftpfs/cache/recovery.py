"""Undelivered files after the end of a mount, and their way to the next one. Layer: cache.

A spooled file `NNNNNN.data` lies in the mount's `SpoolDirectory`, with a description beside it,
`NNNNNN.json`:
- `path`: its path on the vehicle; `system` and `uid`: which vehicle, `uid` null if it did not tell its id.
  Nothing more while a program writes, and no close was confirmed or refused;
- what `writing.describe` tells of a file that could not be delivered.

The description is written before the first byte, and removed when the vehicle has all of the file, or all
programs are done with it. So the next mount can always say what it found, whenever the process was killed:
`SpoolDirectory.rescue` moves what has a description to a recovery directory. A mount that ends moves
there what it could not deliver. From there nothing is sent to a vehicle by itself, because the file on the
vehicle may have changed since. And it may be another vehicle with the same system id.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from mavftpfs.cache.spool import remove
from mavftpfs.shared.private import make_private_directory

log = logging.getLogger("mavftpfs.cache")

SLOTS = 64
"""Mounts of one vehicle by one user at the same time."""

LONGEST_NAME = 200
"""Bytes of the names in a recovery directory, so that every local disk takes what is added to them."""


class SpoolDirectory:
    """A directory on disk that one mount at a time uses."""

    def __init__(self, base: Path) -> None:
        """Claim a slot below `base` that no mount uses, and that has no files of an earlier one.

        Raises:
            OSError: it cannot be made, or every slot is taken.
        """
        make_private_directory(base)
        slots = [base / f"slot{number}" for number in range(SLOTS)]
        self._locks: dict[Path, int] = {}
        free = [slot for slot in slots if slot.exists() and self._lock(slot)]
        usable = [slot for slot in free if not data_in(slot)]
        new = (slot for slot in slots if slot not in free and self._lock(slot))
        path = usable[0] if usable else next(new, None)
        if path is None:
            raise OSError(f"all {SLOTS} slots of {base} are in use")
        self.path = path
        self._abandoned = [slot for slot in free if slot != path]

    def rescue(self, recovery: Path) -> list[Path]:
        """Move what dead mounts left to `recovery`; return the files, and let go of their slots.

        A file that cannot be moved stays where a later mount finds it.

        Raises:
            OSError: there was something, and nothing of it could be moved.
        """
        found: list[Path] = []
        failed: list[OSError] = []
        for slot in self._abandoned:
            moved, stuck = rescue(slot, recovery)
            found += moved
            failed += stuck
            self._unlock(slot)
        self._abandoned = []
        if failed and not found:
            raise failed[0]
        return found

    def discard(self) -> None:
        """Remove the files of this mount: the vehicle has them, even if a program has not closed one."""
        for data in data_in(self.path):
            remove(data)

    def close(self) -> None:
        """Let go of the directory."""
        for slot in list(self._locks):
            self._unlock(slot)

    def _lock(self, slot: Path) -> bool:
        slot.mkdir(mode=0o700, exist_ok=True)
        descriptor = os.open(slot / "owner", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return False
        self._locks[slot] = descriptor
        return True

    def _unlock(self, slot: Path) -> None:
        os.close(self._locks.pop(slot))


def data_in(slot: Path) -> list[Path]:
    """Return the spooled files of a directory."""
    return sorted(slot.glob("*.data"))


def rescue(slot: Path, recovery: Path) -> tuple[list[Path], list[OSError]]:
    """Move a dead mount's spooled files to `recovery`; return their new paths, and why others stay.

    Files that the vehicle has are removed, and so are descriptions without a file.
    """
    found, failed = [], []
    for data in data_in(slot):
        try:
            if _is_needed(data):
                found.append(move(data, _read_facts(data), recovery))
            else:
                remove(data)
        except OSError as exc:
            log.warning("%s stays where it is: %s", data, exc)
            failed.append(exc)
    for stray in (*slot.glob("*.json"), *slot.glob("*.new")):
        if not stray.with_suffix(".data").exists():
            with contextlib.suppress(OSError):
                stray.unlink()
    return found, failed


def left_in(slot: Path) -> list[Path]:
    """Return the files of a slot that the vehicle lacks; none while a mount uses the slot."""
    try:
        descriptor = os.open(slot / "owner", os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return []
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return [data for data in data_in(slot) if _is_needed(data)]
    except OSError:
        return []
    finally:
        os.close(descriptor)


def move(data: Path, facts: Mapping[str, object], recovery: Path) -> Path:
    """Move a spooled file and its description to a directory, which is made; return its new path.

    Raises:
        OSError: it is where it was.
    """
    make_private_directory(recovery)
    name = os.fsdecode(os.fsencode(_name_for(data, facts))[-LONGEST_NAME:])
    target, number = recovery / name, 0
    while target.exists() or _description(target).exists():
        number += 1
        target = recovery / f"{name}.{number}"
    try:
        shutil.move(data, target)
    except OSError:
        target.unlink(missing_ok=True)  # a part of a copy; the original is still there
        raise
    try:
        shutil.move(data.with_suffix(".json"), _description(target))
    except OSError as exc:
        log.info("%s has no description: %s", target, exc)
    return target


# --- inside


def _read_facts(data: Path) -> dict[str, object]:
    """Return the description of a file; {} if it is damaged."""
    try:
        facts = json.loads(data.with_suffix(".json").read_text())
    except (OSError, ValueError, RecursionError) as exc:
        log.warning("%s: what it belongs to was not written down: %s", data, exc)
        return {}
    return facts if isinstance(facts, dict) else {}


def _is_needed(data: Path) -> bool:
    """Return whether the vehicle lacks a spooled file that a user may want."""
    described = data.with_suffix(".json").exists()
    return described and (data.stat().st_size > 0 or "size" in _read_facts(data))


def _description(target: Path) -> Path:
    return target.with_name(target.name + ".json")


def _name_for(data: Path, facts: Mapping[str, object]) -> str:
    """Return a name that tells where the bytes belong, as far as that was written down."""
    path = facts.get("path")
    if not isinstance(path, str):
        return data.name
    try:
        os.fsencode(path)
    except UnicodeEncodeError:
        return data.name
    return path.replace("\0", "").strip("/").replace("/", "__") or data.name
