"""Whether a local file is what the vehicle has, and when its checksum is asked for. Layer: client."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

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

Verify = Literal["auto", "all", "none"]

PROVEN_BY_DEFAULT = 16_000_000
"""A file of up to so many bytes is proven even if it came in one piece. A vehicle computes the checksum of
about a megabyte a second, and most vehicles answer nothing else meanwhile."""

NOT_NOW = (Armed, NotDeliveredYet, RequestTimeout, SessionBusy, FileBusy)
"""Errors that say that there is no checksum now, though there may be one later."""

NO_CHECKSUM: tuple[type[MavftpfsError], ...] = (*NOT_NOW, FtpNak, NotSupported)
"""Errors that say that there is no checksum, and nothing else about the file."""


@dataclass(frozen=True, slots=True)
class Proof:
    """How a file was verified, in words. lacking: why its checksum was not compared although it should have
    been, or ""; later: the checksum may be had another time."""

    words: str
    lacking: str = ""
    later: bool = False


BY_CRC32 = Proof("size and CRC32")
BY_SIZE = Proof("size")
GENERATED = Proof("size (generated at each opening, so a checksum proves nothing)")


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a request for a checksum. crc: None if there is none; then `lacking` and `later` are as
    in Proof."""

    crc: int | None = None
    lacking: str = ""
    later: bool = False


NOT_ASKED = Answer()


def proof_needed(verify: Verify, *, resumed: bool, size: int) -> bool:
    """Return whether the vehicle is asked for a checksum of the whole file."""
    if resumed or verify == "all":
        return True
    return verify == "auto" and size <= PROVEN_BY_DEFAULT


async def ask_crc32(session: Session, remote: bytes) -> Answer:
    """Ask the vehicle for a file's checksum.

    Raises:
        LinkError: the vehicle, or the mount, is gone.
    """
    try:
        return Answer(await session.files.crc32(remote))
    except LinkError:
        raise
    except MavftpfsError as exc:
        return Answer(None, _why_not(exc), isinstance(exc, NOT_NOW))


def _why_not(error: MavftpfsError) -> str:
    """Return in a few words why there is no checksum."""
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
