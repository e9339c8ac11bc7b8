"""Files that did not reach a vehicle: lists them, and puts them back. Layer: client; prints nothing.

A mount that ends with undelivered files moves them below `recovered`, with a `NAME.json` beside each file
(cache.recovery). The next mount moves there what a killed mount held. Nothing is put back by itself, because
the file on the vehicle may have changed since. A file of another vehicle is put back only if a person names
the file itself, and insists.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
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
class Kept:
    """A file that did not reach the vehicle.

    facts: what was written down about it, as JSON holds it. named: a person named this file itself.
    """

    file: Path
    facts: Mapping[str, Any] = field(default_factory=dict)
    named: bool = False

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
        return _vehicle_text(self.facts)

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
        return "" if self.facts.get("whole") else "only the changed parts of it are here"

    def described(self) -> dict[str, Any]:
        """Return its facts for `--json`."""
        path = None if self.path is None else name_text(self.path)
        error, at = self.facts.get("error"), self.facts.get("at")
        facts = {"file": str(self.file), "path": path, "size": self.size, "error": error, "at": at}
        vehicle = {"system": self.facts.get("system"), "uid": self.facts.get("uid")}
        return {**facts, **vehicle, "hindrance": self.hindrance or None}


def _vehicle_text(facts: Mapping[str, Any]) -> str:
    """Return a vehicle for people: its system id and its unique id; "" if no system id is known."""
    system, uid = facts.get("system"), facts.get("uid")
    if system is None:
        return ""
    return f"vehicle {system} (id {uid})" if uid else f"vehicle {system}"


# -- what there is --------------------------------------------------------------------------------


def kept_below(base: Path) -> list[Kept]:
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
    return [kept for directory in directories for kept in kept_in(directory)]


def kept_in(directory: Path) -> list[Kept]:
    """Return the files in one recovery directory.

    Raises:
        UsageError: it cannot be read.
    """
    try:
        paths = {path for path in directory.iterdir() if path.is_file() and not path.is_symlink()}
    except OSError as exc:
        raise UsageError(f"{directory}: {exc.strerror}") from exc
    files = {path for path in paths if not (path.suffix == ".json" and path.with_suffix("") in paths)}
    return [Kept(path, _read_facts(Path(f"{path}.json"))) for path in sorted(files)]


def _read_facts(path: Path) -> dict[str, Any]:
    """Return what was written down; {} if that is damaged."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def chosen(names: Sequence[str], base: Path) -> list[Kept]:
    """Return the files that a person named: by their paths, or by a directory for all that is in it.

    Raises:
        UsageError: there is no such file.
    """
    found: list[Kept] = []
    for name in names:
        path = Path(name) if os.path.exists(name) else base / name
        if path.is_dir():
            found += kept_in(path)
            continue
        if not path.is_file():
            raise UsageError(f"{name} is nothing that was kept; `mavftpfs recover` lists what is")
        found += [replace(kept, named=True) for kept in kept_in(path.parent) if kept.file.name == path.name]
    return found


# -- putting back ---------------------------------------------------------------------------------


async def put_back(
    session: Session,
    wanted: Sequence[Kept],
    progress: Progress,
    tell: Callable[[Kept, bool], None],
    *,
    force: bool,
) -> list[Kept]:
    """Put files where they belonged. Once it is proven that the vehicle has a file, the copy here is removed.

    tell: called for each file, with whether it was there already. force: also replace a file that is not the
    one they were to replace, and put files that a person named on another vehicle than theirs.

    Returns those of other vehicles, which stay here.

    Raises:
        UsageError: one of them cannot be put back; the text says why. NotDelivered: it did not arrive.
    """
    others = await _of_others(session, wanted, force=force)
    wanted = [kept for kept in wanted if kept not in others]
    for kept in wanted:
        if kept.hindrance:
            raise UsageError(
                f"{kept.file}: {kept.hindrance}; look at it, use `mavftpfs put`, and delete it here"
            )
    progress.plan(len(wanted), sum(kept.size for kept in wanted))
    for kept in wanted:
        path = _in_session(session, kept)
        there_already = await _is_there(session, path, kept, force=force)
        if not there_already:
            await put_file(session, kept.file, path, progress)
            if await _differs(session, path, kept):
                raise NotDelivered(f"{name_text(path)} differs on the vehicle; the copy stays in {kept.file}")
        _forget(kept)
        tell(kept, there_already)
    return others


async def _of_others(session: Session, wanted: Sequence[Kept], *, force: bool) -> list[Kept]:
    """Return the files that are of another vehicle. force: but not those that a person named.

    Raises:
        UsageError: a person named one of them.
    """
    if not any(kept.facts.get("uid") for kept in wanted):
        return []
    vehicle = (await session.status())["vehicle"]
    with trio.move_on_after(VERSION_PATIENCE):
        while vehicle["firmware"] is None:  # it is told together with the unique id
            await trio.sleep(_TICK)
            vehicle = (await session.status())["vehicle"]
    others = [kept for kept in wanted if kept.is_of_another(vehicle) and not (kept.named and force)]
    for kept in others:
        if kept.named:
            here = _vehicle_text(vehicle)
            raise UsageError(
                f"{kept.file} is of {kept.vehicle}, and this is {here}; --force puts it here all the same"
            )
    return others


def _in_session(session: Session, kept: Kept) -> bytes:
    """Return the path of a file below the session's root."""
    assert kept.path is not None
    root = session.root.rstrip(b"/")
    if not kept.path.startswith(root + b"/"):
        raise UsageError(f"{name_text(kept.path)} does not lie below {name_text(session.root)}")
    return kept.path[len(root) :]


async def _is_there(session: Session, path: bytes, kept: Kept, *, force: bool) -> bool:
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
    if found.size == kept.size and await _differs(session, path, kept) is False:
        return True
    before = kept.facts.get("size_on_vehicle")
    if found.size not in (before, 0) and not force:  # an empty one holds nothing to lose
        known = "nothing" if before is None else f"{before} bytes"
        raise UsageError(
            f"{name_text(path)} has {found.size} bytes on the vehicle, and had {known} when this was kept: "
            "it was changed since; --force replaces it"
        )
    return False


async def _differs(session: Session, path: bytes, kept: Kept) -> bool | None:
    """Compare with the vehicle's checksum; None where there is none."""
    try:
        return await session.files.crc32(path) != await local_crc32(kept.file)
    except NO_CHECKSUM:
        return None


def _forget(kept: Kept) -> None:
    """Remove a copy and its description, and the directory with the last one."""
    directory = kept.file.parent
    kept.file.unlink()
    kept.file.with_name(f"{kept.file.name}.json").unlink(missing_ok=True)
    if not kept_in(directory):
        with suppress(OSError):
            directory.rmdir()
