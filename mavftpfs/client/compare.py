"""Compares a local file with the vehicle's by size and CRC32. Layer: client.

get, sync, sync --check, recover and the watch all compare files here.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Literal, NamedTuple

import trio

from mavftpfs.client.files import READ_SIZE, Session
from mavftpfs.protocol.payload import NakCode, crc32
from mavftpfs.shared.errors import (
    Armed,
    FileBusy,
    FtpNak,
    LinkError,
    MavftpfsError,
    NotDeliveredYet,
    NotSupported,
    RequestTimeout,
    SessionBusy,
)
from mavftpfs.shared.model import is_snapshot

Verify = Literal["auto", "all", "none"]

VERIFIED_BY_DEFAULT = 16_000_000
"""The largest file for which `auto` asks for the checksum, in bytes. A vehicle computes about a megabyte a
second, and most vehicles answer nothing else meanwhile."""

NOT_NOW = (Armed, NotDeliveredYet, RequestTimeout, SessionBusy, FileBusy)
"""Errors of a request for a checksum that may succeed later."""


class Match(Enum):
    """The result of comparing two files."""

    SAME = "same"
    DIFFERS = "differs"
    UNKNOWN = "unknown"
    """The sizes agree, and no checksum was compared."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """The result of `compare`.

    how: for people, the properties that agree, or the difference. lacking: the reason why the vehicle
    reported no checksum although mavftpfs asked for one, otherwise "". later: the vehicle may report one
    later.
    """

    match: Match
    how: str
    lacking: str = ""
    later: bool = False


BY_CRC32 = Comparison(Match.SAME, "size and CRC32")
BY_SIZE = Comparison(Match.UNKNOWN, "size")
GENERATED = Comparison(Match.UNKNOWN, "size (generated at each opening, so a checksum proves nothing)")


class Content(NamedTuple):
    """The size in bytes and the CRC32 of local bytes."""

    size: int
    crc32: int


async def compare(
    session: Session,
    remote: bytes,
    local: Path | Content,
    *,
    size: int | None = None,
    checksum: bool = True,
) -> Comparison:
    """Compare a file of the vehicle with a local one.

    size: of the vehicle's file, if a listing or an open has just reported it. checksum: ask the vehicle for
    its CRC32; without one the match is UNKNOWN or DIFFERS.

    Raises:
        LinkError: the vehicle, or the mount, is gone. OSError: the local file cannot be read. For the size as
        Files.stat.
    """
    if size is None:
        size = (await session.files.stat(remote)).size
    here = local.size if isinstance(local, Content) else _size(local)
    if here != size:
        return Comparison(Match.DIFFERS, f"{here} bytes here, {size} on the vehicle")
    if is_snapshot(session.on_vehicle(remote)):
        return GENERATED
    if not checksum:
        return BY_SIZE
    try:
        theirs = await session.files.crc32(remote)
    except LinkError:
        raise
    except MavftpfsError as exc:
        return Comparison(Match.UNKNOWN, BY_SIZE.how, _why_not(exc), isinstance(exc, NOT_NOW))
    ours = local.crc32 if isinstance(local, Content) else await local_crc32(local)
    if ours == theirs:
        return BY_CRC32
    return Comparison(Match.DIFFERS, f"CRC32 {ours:08x} here, {theirs:08x} on the vehicle")


def wants_checksum(verify: Verify, size: int, *, resumed: bool = False) -> bool:
    """Return whether a file of that size is compared by its checksum, too. resumed: some of its bytes are
    from an earlier run."""
    if resumed or verify == "all":
        return True
    return verify == "auto" and size <= VERIFIED_BY_DEFAULT


def _size(local: Path) -> int:
    return local.stat().st_size


def _why_not(error: MavftpfsError) -> str:
    """Return the reason for a missing checksum in a few words."""
    match error:
        case Armed():
            return "armed"
        case NotDeliveredYet():
            return "not all of it is on the vehicle yet"
        case RequestTimeout():
            return "no answer"
        case SessionBusy():
            return "another client keeps the vehicle's session"
        case FileBusy():
            return "the vehicle is writing it"
        case NotSupported():
            return "the vehicle computes no checksums"
        case FtpNak() if error.code == NakCode.UNKNOWN_COMMAND:
            return "the vehicle computes no checksums"
    return str(error)


async def local_crc32(file: Path) -> int:
    """Return the CRC32 of a local file."""

    def compute() -> int:
        crc = 0
        with file.open("rb") as source:
            while data := source.read(READ_SIZE):
                crc = crc32(data, crc)
        return crc

    return await trio.to_thread.run_sync(compute)
