"""Files that did not reach a vehicle: lists them, and puts them back. Layer: client; prints nothing.

A mount that ends with undelivered files moves them below `recovered`, with a `NAME.json` beside each file
(cache.recovery). The next mount moves there what a killed mount held. Nothing is put back by itself, because
the file on the vehicle may have changed since. Nothing is put on another vehicle, or over a file that was
changed since: `mavftpfs put` does that.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import trio

from mavftpfs.client.connect import VERSION_PATIENCE
from mavftpfs.client.files import Session
from mavftpfs.client.progress import Progress
from mavftpfs.client.proof import NO_CHECKSUM, local_crc32
from mavftpfs.client.upload import put_file
from mavftpfs.shared.errors import (
    NotDelivered,
    NotFound,
    UsageError,
)
from mavftpfs.shared.model import EntryKind, normalise
from mavftpfs.shared.readable import name_text

_TICK = 0.05
"""Seconds between two questions whether the vehicle told its unique id."""


@dataclass(frozen=True, slots=True)
class Recovered:
    """The copy here of a file that did not reach the vehicle.

    facts: what was written down about it, as JSON holds it.
    """

    file: Path
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def path(self) -> bytes | None:
        """Where it belongs on the vehicle, None if that was not written down."""
        path = self.facts.get("path")
        return normalise(os.fsencode(path)) if isinstance(path, str) and path else None

    @property
    def size(self) -> int:
        """Bytes of the local copy."""
        return self.file.stat().st_size

    @property
    def vehicle(self) -> str:
        """The vehicle it is of, for people; "" if that was not written down."""
        system, uid = self.facts.get("system"), self.facts.get("uid")
        if system is None:
            return ""
        return f"vehicle {system} (id {uid})" if uid else f"vehicle {system}"

    def is_of_another(self, vehicle: Mapping[str, Any]) -> bool:
        """Return whether it is of another vehicle than this one (as in `status --json`). False if one of them
        has no unique id.

        A board may have a long id and a short one, and only the short one goes over MAVLink 1. After one of
        them the other counts as another board's.
        """
        mine, other = self.facts.get("uid"), vehicle.get("uid")
        return bool(mine and other and mine != other)

    @property
    def hindrance(self) -> str:
        """Why we cannot put it back, or ""."""
        if self.path is None:
            return "where it belongs was not written down"
        if "whole" not in self.facts:
            return "a program was still writing it, so it may be a part only"
        if self.facts.get("broken"):
            return "a write failed, so this is only the part that was written before"
        return "" if self.facts.get("whole") else "only the changed parts of it are here"


# -- what there is --------------------------------------------------------------------------------


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
    """Return the files in one recovery directory.

    Raises:
        UsageError: it cannot be read.
    """
    try:
        paths = {path for path in directory.iterdir() if path.is_file() and not path.is_symlink()}
    except OSError as exc:
        raise UsageError(f"{directory}: {exc.strerror}") from exc
    files = {path for path in paths if not (path.suffix == ".json" and path.with_suffix("") in paths)}
    return [Recovered(path, _read_facts(Path(f"{path}.json"))) for path in sorted(files)]


def _read_facts(path: Path) -> dict[str, Any]:
    """Return what was written down; {} if that is damaged."""
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
            raise UsageError(f"{name} is nothing that was kept; `mavftpfs recover` lists what is")
        found += [copy for copy in recovered_in(path.parent) if copy.file.name == path.name]
    return found


# -- putting back ---------------------------------------------------------------------------------


async def put_back(
    session: Session,
    wanted: Sequence[Recovered],
    progress: Progress,
    tell: Callable[[Recovered, bool], None],
) -> list[Recovered]:
    """Put files where they belonged. Once it is proven that the vehicle has a file, the copy here is removed.

    tell: called for each file, with whether it was there already.

    Returns those of other vehicles, which stay here.

    Raises:
        UsageError: one of them cannot be put back, and the text says why; the others were put back.
        NotDelivered: it did not arrive.
    """
    others = await _of_others(session, wanted)
    hindered = [copy for copy in wanted if copy not in others and copy.hindrance]
    wanted = [copy for copy in wanted if copy not in others and not copy.hindrance]
    progress.plan(len(wanted), sum(copy.size for copy in wanted))
    for copy in wanted:
        path = _in_session(session, copy)
        there_already = await _is_there(session, path, copy)
        if not there_already:
            await put_file(session, copy.file, path, progress)
            if await _differs(session, path, copy):
                raise NotDelivered(f"{name_text(path)} differs on the vehicle; the copy stays in {copy.file}")
        _forget(copy)
        tell(copy, there_already)
    for copy in hindered:
        raise UsageError(f"{copy.file}: {copy.hindrance}; look at it, use `mavftpfs put`, and delete it here")
    return others


async def _of_others(session: Session, wanted: Sequence[Recovered]) -> list[Recovered]:
    """Return the files that are of another vehicle."""
    if not any(copy.facts.get("uid") for copy in wanted):
        return []
    vehicle = (await session.status())["vehicle"]
    with trio.move_on_after(VERSION_PATIENCE):
        while vehicle["firmware"] is None:  # it is told together with the unique id
            await trio.sleep(_TICK)
            vehicle = (await session.status())["vehicle"]
    return [copy for copy in wanted if copy.is_of_another(vehicle)]


def _in_session(session: Session, copy: Recovered) -> bytes:
    """Return the path of a file below the session's root."""
    assert copy.path is not None
    root = session.root.rstrip(b"/")
    if not copy.path.startswith(root + b"/"):
        raise UsageError(f"{name_text(copy.path)} does not lie below {name_text(session.root)}")
    return copy.path[len(root) :]


async def _is_there(session: Session, path: bytes, copy: Recovered) -> bool:
    """Return whether the vehicle has the file with exactly these bytes.

    Raises:
        UsageError: it has another file than the one that was to be replaced.
    """
    try:
        found = await session.files.stat(path)
    except NotFound:
        return False
    if found.kind is not EntryKind.FILE:
        raise UsageError(f"{name_text(path)} is a directory on the vehicle")
    if found.size == copy.size and await _differs(session, path, copy) is False:
        return True
    before = copy.facts.get("size_on_vehicle")
    if found.size not in (before, 0):  # an empty one holds nothing to lose
        known = "nothing" if before is None else f"{before} bytes"
        raise UsageError(
            f"{name_text(path)} has {found.size} bytes on the vehicle, and had {known} when this was kept: "
            f"it was changed since; to replace it: mavftpfs put SOURCE {copy.file} {name_text(path)}"
        )
    return False


async def _differs(session: Session, path: bytes, copy: Recovered) -> bool | None:
    """Compare with the vehicle's checksum; None where there is none."""
    try:
        return await session.files.crc32(path) != await local_crc32(copy.file)
    except NO_CHECKSUM:
        return None


def _forget(copy: Recovered) -> None:
    """Remove a copy and its description, and the directory with the last one."""
    directory = copy.file.parent
    copy.file.unlink()
    copy.file.with_name(f"{copy.file.name}.json").unlink(missing_ok=True)
    if not recovered_in(directory):
        with suppress(OSError):
            directory.rmdir()
