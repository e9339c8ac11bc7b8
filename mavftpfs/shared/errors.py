"""The exception tree, and the exit code for each. Layer: shared; imports only the standard library.

Every error that leaves a layer is one of these; `shared.errnos` turns them into the kernel's numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Any


class MavftpfsError(Exception):
    """Base of every error this package raises on purpose; its text is one line for a person."""


class UsageError(MavftpfsError, ValueError):
    """The caller asked for something impossible (bad option, bad SOURCE); exit code 1."""


class LinkError(MavftpfsError):
    """The pipe to the vehicle does not work."""


class LinkClosed(LinkError):
    """The transport could not be opened, or was closed for good."""


class VehicleLost(LinkError):
    """No heartbeat for a while and a request timed out: requests fail at once until a heartbeat returns."""


class ProtocolError(MavftpfsError):
    """A rule of the protocol was broken."""


class LocalProtocolError(ProtocolError):
    """mavftpfs broke a rule: a bug, or a request that cannot be expressed (a path that is too long)."""


class PathTooLong(LocalProtocolError):
    """The path does not fit a request; refused before a byte is sent (servers cut it silently)."""


class RemoteProtocolError(ProtocolError):
    """The peer broke a rule: malformed bytes, or an answer that cannot be right."""


class RequestTimeout(MavftpfsError):
    """No answer, or no progress, within the deadline."""


class OutcomeUnknown(RequestTimeout):
    """A change of the card was not answered, and no listing could tell whether it happened."""


class NotFound(MavftpfsError):
    """No such name, by a fresh and complete listing (ENOENT)."""


class NotADirectory(MavftpfsError):
    """A directory was needed and the path is a file, or runs through one (ENOTDIR)."""


class ListingIncomplete(MavftpfsError):
    """The vehicle did not list a directory to its end (EIO).

    Attributes:
        entries: (name, attributes) of what is known to be in it.
    """

    def __init__(self, reason: str, entries: Sequence[tuple[bytes, Any]]) -> None:
        super().__init__(reason)
        self.entries = entries


class IsADirectory(MavftpfsError):
    """A file was needed and the path is a directory (EISDIR)."""


class FileChanged(MavftpfsError):
    """The remote file is no longer the one that was opened (ESTALE)."""


class DataUnproven(MavftpfsError):
    """Bytes arrived but could not be proven to belong to the file; they are dropped (EIO)."""


class SessionLost(MavftpfsError):
    """The server's session is gone, or may be gone: reopen the file and go on at the same offset.

    Attributes:
        by_server: an answer said so; else the server was silent.
    """

    def __init__(self, reason: str, *, by_server: bool = False) -> None:
        super().__init__(reason)
        self.by_server = by_server


class SessionBusy(MavftpfsError):
    """The server's session stayed taken by someone else (EBUSY)."""


class SessionTaken(SessionBusy):
    """Another client has a file open in the server's session, and was heard: try again once it is closed."""


class Armed(MavftpfsError):
    """The vehicle is armed (or was never heard), and the request is not carried out in flight."""


class NotDeliveredYet(MavftpfsError):
    """The vehicle does not have all bytes of the file yet, so it cannot say their checksum (EAGAIN)."""


class ReadOnly(MavftpfsError):
    """The request would change a tree, or a part of one, that is read-only (EROFS)."""


class AlreadyExists(MavftpfsError):
    """The name is taken (EEXIST)."""


class DirectoryNotEmpty(MavftpfsError):
    """The directory still has entries (ENOTEMPTY)."""


class InvalidMove(MavftpfsError):
    """A directory cannot become a part of itself, nor a file a copy of itself (EINVAL)."""


class CrossDevice(MavftpfsError):
    """This server cannot rename: copy and delete instead, as mv does (EXDEV)."""


class FileBusy(MavftpfsError):
    """The vehicle, or another client, is writing the file (EBUSY)."""


class InvalidText(MavftpfsError):
    """A saved text has invalid lines; nothing of it was set (EINVAL)."""


class NotTaken(MavftpfsError):
    """The vehicle does not have what a saved text asked for (EIO)."""


class NotSupported(MavftpfsError):
    """This server offers no safe way to do it (EOPNOTSUPP)."""


class FileTooLarge(MavftpfsError):
    """A partial change would take too long, because the whole file is sent again (EFBIG)."""


class NoSpace(MavftpfsError):
    """The spool, which keeps what the vehicle does not have yet, is full (ENOSPC)."""


class SpoolFailed(MavftpfsError):
    """The local disk that keeps undelivered bytes failed (EIO)."""


class WriteFailed(MavftpfsError):
    """An earlier write of this open file failed, so nothing of the file reaches the card (EIO)."""


class VerificationFailed(MavftpfsError):
    """The card has other bytes than were written, and sending them again did not help (EIO)."""


class NotVerified(MavftpfsError):
    """The bytes on the card are in doubt, and the vehicle told no checksum (EIO); they are compared later."""


class MountFailed(MavftpfsError):
    """The kernel side cannot be set up or taken down."""


class NoFtp(MavftpfsError):
    """A vehicle is there, but it does not serve its files."""


class NotDelivered(MavftpfsError):
    """No answer proves that the vehicle has the bytes that were written.

    Attributes:
        there: whether the file is there as it was written. False: it is not, and nothing of it is sent from
            now on. None: that is not known.
    """

    def __init__(self, reason: str, *, there: bool | None = None) -> None:
        super().__init__(reason)
        self.there = there


_REQUESTS = {
    1: "close the file",
    3: "list the directory",
    4: "open the file",
    5: "read the file",
    6: "create the file",
    7: "write the file",
    8: "remove the file",
    9: "make the directory",
    10: "remove the directory",
    11: "open the file for writing",
    12: "truncate the file",
    13: "rename it",
    14: "compute the checksum",
    15: "read the file by bursts",
    16: "list the directory with times",
}
_REASONS = {
    1: "it failed",
    2: "its system reports an error",
    3: "wrong size of the request",
    4: "no such session",
    5: "no session is free",
    6: "nothing is there",
    7: "unknown command",
    8: "the name exists",
    9: "it is protected",
    10: "it does not exist",
}
_ERRNOS = {
    5: "its card reports an error",
    13: "permission denied",
    28: "the card is full",
    30: "it is read-only",
}
"""Words for people, by opcode, NAK code and errno. These errnos are the same on all systems. A message ends
with the numbers."""


class FtpNak(MavftpfsError):
    """The server refused a request.

    Attributes:
        opcode: the request's opcode (0..16).
        code: the NAK code as sent, 0..255 (`protocol.payload.NakCode` names 1..10).
        server_errno: errno byte behind FailErrno, else None; the number is the *drone's* OS's.
        retransmitted: the request was sent more than once, so the refusal may answer the second
            execution of a request whose first one worked (servers.md 14.4: "maybe done").
    """

    def __init__(
        self, opcode: int, code: int, server_errno: int | None = None, *, retransmitted: bool = False
    ) -> None:
        numbers = f"opcode {opcode}, NAK {code}" + ("" if server_errno is None else f", errno {server_errno}")
        what, why = _REQUESTS.get(opcode, "do that"), _REASONS.get(code, "without a known reason")
        why = why if server_errno is None else _ERRNOS.get(server_errno, why)
        super().__init__(f"the vehicle refused to {what}: {why} ({numbers})")
        self.opcode = opcode
        self.code = code
        self.server_errno = server_errno
        self.retransmitted = retransmitted


# -- exit codes of the command line ----------------------------------------------------------------


class ExitCode(IntEnum):
    """The exit codes of commands."""

    OK = 0
    USAGE = 1
    NO_VEHICLE = 2
    INCOMPLETE = 2  # of several things some failed
    MOUNT_FAILED = 3
    UNDELIVERED = 4
    BUG = 70
    INTERRUPTED = 130


EXIT_CODES = {
    ExitCode.OK: "success",
    ExitCode.USAGE: "wrong usage, or impossible with the files as they are",
    ExitCode.NO_VEHICLE: "no vehicle, no FTP, or no right answer; or some of several files failed",
    ExitCode.MOUNT_FAILED: "mounting or unmounting failed",
    ExitCode.UNDELIVERED: "a file did not reach the card; the message says where it is kept",
    ExitCode.BUG: "a bug in mavftpfs",
    ExitCode.INTERRUPTED: "interrupted; 128 and the number of the signal for others",
}
"""The meaning of each, for the man page."""

SIGNALLED = 128
"""This plus a signal's number is the exit code of a command that the signal ended, as in shells."""


_NOT_POSSIBLE = (
    UsageError,
    *(NotFound, NotADirectory, IsADirectory, AlreadyExists, DirectoryNotEmpty, InvalidMove, CrossDevice),
    *(ReadOnly, Armed, FileBusy, NotSupported, InvalidText, LocalProtocolError),
)
"""The vehicle is there, but cannot do what was asked with the files as they are."""

_CODES: tuple[tuple[type[MavftpfsError], ExitCode], ...] = (
    *((cls, ExitCode.USAGE) for cls in _NOT_POSSIBLE),
    (NotDelivered, ExitCode.UNDELIVERED),
    (MountFailed, ExitCode.MOUNT_FAILED),
)
"""All others: NO_VEHICLE, no right answer came from it."""


def exit_code_for(error: MavftpfsError) -> ExitCode:
    """Return the exit code an error ends a command with."""
    for cls, code in _CODES:
        if isinstance(error, cls):
            return code
    return ExitCode.NO_VEHICLE
