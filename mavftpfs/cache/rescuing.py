"""What is written down beside spooled bytes, and how the next mount finds both. Layer: cache.

A spooled file `NNNNNN.data` lies beside `NNNNNN.json`, which says what it is: `path` on the vehicle, and
either `unfinished` (a program was still writing: no close was confirmed or refused yet), or what
`delivery.describe` tells of a file that could not be delivered. `needed` false: the vehicle has it all, or
nobody wants it any more. A name is written before the first byte, so that whenever the process is killed the
next mount can say what it found.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import logging
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from mavftpfs.shared.errors import NoSpace, SpoolFailed
from mavftpfs.shared.private import make_private_directory, open_private

log = logging.getLogger("mavftpfs.cache")

_LONGEST_NAME = 200
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


def data_in(slot: Path) -> list[Path]:
    """Return the spooled files of a directory."""
    return sorted(slot.glob("*.data"))


def write_facts(data: Path, facts: Mapping[str, object], *, durable: bool) -> None:
    """Write down what a spooled file is, so that being killed leaves the old text or the new one.

    durable: also a loss of power does.

    Raises:
        OSError.
    """
    path = data.with_suffix(".json")
    draft = path.with_suffix(".new")
    with open(open_private(draft, os.O_WRONLY | os.O_TRUNC), "wb") as file:
        file.write(json.dumps(facts, indent=1).encode())
        file.flush()
        if durable:
            os.fsync(file.fileno())
    draft.replace(path)
    if durable:
        _sync_directory(path.parent)


def remove(data: Path) -> None:
    """Remove a spooled file and its description; what cannot be removed is only logged."""
    for path in (data, data.with_suffix(".json"), data.with_suffix(".new")):
        try:
            path.unlink(missing_ok=True)
        except OSError as exc:
            log.warning("cannot remove %s: %s", path, exc)


def rescue(slot: Path, recovery: Path) -> tuple[list[Path], list[OSError]]:
    """Move a dead mount's spooled files to `recovery`; return their new paths, and why others stay.

    What the vehicle has anyway is removed, and so is text that describes nothing.
    """
    found, failed = [], []
    for data in data_in(slot):
        facts = _read_facts(data)
        try:
            if _is_needed(data, facts):
                found.append(_move(data, facts, recovery))
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
    """Return the files that the vehicle lacks and that nobody holds any more; none while a mount uses it."""
    try:
        descriptor = os.open(slot / "owner", os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return []
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return [data for data in data_in(slot) if _is_needed(data, _read_facts(data))]
    except OSError:
        return []
    finally:
        os.close(descriptor)


def free_name(directory: Path, name: str) -> Path:
    """Return a path in `directory` that does not exist, made from at most 200 bytes of `name`."""
    short = os.fsdecode(os.fsencode(name)[-_LONGEST_NAME:])
    number = 0
    while True:
        path = directory / (short if not number else f"{short}.{number}")
        if not path.exists():
            return path
        number += 1


def trouble(exc: OSError, path: Path | None) -> NoSpace | SpoolFailed:
    """Return what a local disk's error means to whoever writes: it is full, or it fails."""
    kind = NoSpace if exc.errno in _FULL else SpoolFailed
    return kind(f"cannot keep bytes in {path}: {exc}")


# --- inside


def _sync_directory(path: Path) -> None:
    directory = os.open(path, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def _read_facts(data: Path) -> dict[str, object]:
    """Return what was written down; nothing if that is not there or not what we write."""
    try:
        facts = json.loads(data.with_suffix(".json").read_text())
    except (OSError, ValueError, RecursionError) as exc:
        log.warning("%s: what it belongs to was not written down: %s", data, exc)
        return {}
    return facts if isinstance(facts, dict) else {}


def _is_needed(data: Path, facts: Mapping[str, object]) -> bool:
    """Return whether the vehicle lacks a spooled file and somebody may want it."""
    return facts.get("needed") is not False and not (facts.get("unfinished") and not data.stat().st_size)


def _move(data: Path, facts: Mapping[str, object], recovery: Path) -> Path:
    """Move a spooled file and its description; return its new path."""
    make_private_directory(recovery)
    target = free_name(recovery, _name_for(data, facts))
    try:
        shutil.move(data, target)
    except OSError:
        target.unlink(missing_ok=True)  # a part of a copy; the original is still there
        raise
    try:
        shutil.move(data.with_suffix(".json"), target.with_name(target.name + ".json"))
    except OSError as exc:
        log.info("%s has no description: %s", target, exc)
    return target


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
