"""Uploads files that did not reach a vehicle to their paths there. Layer: client; prints nothing.

Only the user starts this, because the file on the vehicle may have changed since. `recover` uploads nothing
to another vehicle, and replaces no file that was changed since: `mavftpfs put` does that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import trio

from mavftpfs.client.compare import Match, compare
from mavftpfs.client.connect import VERSION_PATIENCE
from mavftpfs.client.files import Session
from mavftpfs.client.progress import Progress
from mavftpfs.client.undelivered import Recovered, recovered_in
from mavftpfs.client.upload import put_file
from mavftpfs.shared.errors import MavftpfsError, NotDelivered, NotFound, UsageError
from mavftpfs.shared.model import EntryKind
from mavftpfs.shared.readable import name_text

_TICK = 0.05
"""Seconds between two checks whether the vehicle has reported its unique id."""


@dataclass(frozen=True, slots=True)
class Left:
    """The files that stay here.

    others: those of other vehicles. failed: the others, each with the reason.
    """

    others: Sequence[Recovered]
    failed: Sequence[tuple[Recovered, str]]


async def put_back(
    session: Session,
    wanted: Sequence[Recovered],
    progress: Progress,
    tell: Callable[[Recovered, bool], None],
) -> Left:
    """Upload all files that can be uploaded. Remove the local copy of each file that is verified to be on the
    vehicle.

    tell: called for each uploaded file, with whether it was there already.

    Return the files that stay here.
    """
    others = await _of_others(session, wanted)
    mine = [copy for copy in wanted if copy not in others]
    failed = [
        (copy, f"{copy.hindrance}; look at it, `mavftpfs put` it if nothing is missing, and delete it here")
        for copy in mine
        if copy.hindrance
    ]
    mine = [copy for copy in mine if not copy.hindrance]
    progress.plan(len(mine), sum(copy.size for copy in mine))
    for copy in mine:
        try:
            there_already = await _put_back(session, copy, progress)
        except MavftpfsError as error:
            failed.append((copy, str(error)))
        else:
            tell(copy, there_already)
    return Left(others, failed)


async def _put_back(session: Session, copy: Recovered, progress: Progress) -> bool:
    """Upload a file, and remove its local copy. Return whether the vehicle had it already.

    Raises:
        UsageError: it cannot be uploaded, and the text gives the reason.
        NotDelivered: it did not reach the vehicle.
    """
    path = _in_session(session, copy)
    there_already = await _is_there(session, path, copy)
    if not there_already:
        await put_file(session, copy.file, path, progress)
        if (await compare(session, path, copy.file)).match is Match.DIFFERS:
            raise NotDelivered(f"{name_text(path)} differs on the vehicle")
    _forget(copy)
    return there_already


async def _of_others(session: Session, wanted: Sequence[Recovered]) -> list[Recovered]:
    """Return the files that belong to another vehicle."""
    if not any(copy.facts.get("uid") for copy in wanted):
        return []
    vehicle = (await session.status())["vehicle"]
    with trio.move_on_after(VERSION_PATIENCE):
        while vehicle["firmware"] is None:  # arrives together with the unique id
            await trio.sleep(_TICK)
            vehicle = (await session.status())["vehicle"]
    return [copy for copy in wanted if copy.is_of_another(vehicle)]


def _in_session(session: Session, copy: Recovered) -> bytes:
    """Return the path of a file below the session's root."""
    assert copy.path is not None
    root = session.root.rstrip(b"/")
    if not copy.path.startswith(root + b"/"):
        raise UsageError(f"{name_text(copy.path)} is not below {name_text(session.root)}")
    return copy.path[len(root) :]


async def _is_there(session: Session, path: bytes, copy: Recovered) -> bool:
    """Return whether the vehicle has the file with exactly these bytes.

    Raises:
        UsageError: the vehicle has another file than the one that was to be replaced.
    """
    try:
        found = await session.files.stat(path)
    except NotFound:
        return False
    if found.kind is not EntryKind.FILE:
        raise UsageError(f"{name_text(path)} is a directory on the vehicle")
    if (await compare(session, path, copy.file, size=found.size)).match is Match.SAME:
        return True
    before = copy.facts.get("size_on_vehicle")
    if found.size not in (before, 0):  # an empty file has nothing to lose
        known = "nothing" if before is None else f"{before} bytes"
        raise UsageError(
            f"{name_text(path)} has {found.size} bytes on the vehicle, and had {known} when this was kept: "
            f"it was changed since; to replace it: mavftpfs put SOURCE {copy.file} {name_text(path)}"
        )
    return False


def _forget(copy: Recovered) -> None:
    """Remove a copy and its description, and the directory with the last one."""
    directory = copy.file.parent
    copy.file.unlink()
    copy.file.with_name(f"{copy.file.name}.json").unlink(missing_ok=True)
    if not recovered_in(directory):
        with suppress(OSError):
            directory.rmdir()
