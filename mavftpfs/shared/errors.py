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
    """The vehicle did not answer, or made no progress, within the deadline."""


class OutcomeUnknown(RequestTimeout):
    """A change of the card was not answered, and a listing could not show whether it happened."""


class NotFound(MavftpfsError):
    """A fresh and complete listing does not have the name (ENOENT)."""


class NotADirectory(MavftpfsError):
    """The call needs a directory, and the path is a file, or leads through one (ENOTDIR)."""


class ListingIncomplete(MavftpfsError):
    """The vehicle did not list a directory to its end (EIO).

    Attributes:
        entries: (name, attributes) of the known entries.
    """

    def __init__(self, reason: str, entries: Sequence[tuple[bytes, Any]]) -> None:
        super().__init__(reason)
        self.entries = entries


class IsADirectory(MavftpfsError):
    """The call needs a file, and the path is a directory (EISDIR)."""


class FileChanged(MavftpfsError):
    """The remote file is no longer the one that was opened (ESTALE)."""


class DataUnproven(MavftpfsError):
    """Bytes arrived but cannot be proven to belong to the file; they are dropped (EIO)."""


class SessionLost(MavftpfsError):
    """The server's session is gone, or may be gone: reopen the file and continue at the same offset.

    Attributes:
        by_server: a reply said so; otherwise the server was silent.
    """

    def __init__(self, reason: str, *, by_server: bool = False) -> None:
        super().__init__(reason)
        self.by_server = by_server


class SessionBusy(MavftpfsError):
    """Another client kept the server's session (EBUSY)."""


class SessionTaken(SessionBusy):
    """Another client that was heard has a file open in the server's session: try again once it is closed."""


class Armed(MavftpfsError):
    """The vehicle is armed (or was never heard), and the request must wait for the end of the flight."""


class NotDeliveredYet(MavftpfsError):
    """The vehicle does not have all bytes of the file yet, so it cannot compute their checksum (EAGAIN)."""


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
    """The vehicle did not accept all values of a saved text (EIO)."""


class NotSupported(MavftpfsError):
    """This server offers no safe way to do this (EOPNOTSUPP)."""


class FileTooLarge(MavftpfsError):
    """A partial change would take too long, because the whole file is sent again (EFBIG)."""


class NoSpace(MavftpfsError):
    """The spool, which keeps pending changes, is full (ENOSPC)."""


class SpoolFailed(MavftpfsError):
    """The local disk that keeps pending changes failed (EIO)."""


class WriteFailed(MavftpfsError):
    """An earlier write of this open file failed, so nothing of the file reaches the card (EIO)."""


class VerificationFailed(MavftpfsError):
    """The card has other bytes than those written, and sending them again did not help (EIO)."""


class NotVerified(MavftpfsError):
    """The bytes on the card are suspect, and the vehicle reported no checksum (EIO); they are compared
    later."""


class MountFailed(MavftpfsError):
    """The kernel's mount cannot be made or removed."""


class NoFtp(MavftpfsError):
    """A vehicle is there, but it does not serve its files."""


class NotDelivered(MavftpfsError):
    """No answer proves that the vehicle has the written bytes.

    Attributes:
        there: whether the vehicle has the file as it was written. False: it has the old file, or none, and
            nothing is sent later. None: unknown.
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
    22: "invalid argument, such as a name that the card cannot store",
    28: "the card is full",
    30: "it is read-only",
}
"""Words for people, by opcode, NAK code and errno. The errnos are those that all systems share. A message
ends with the numbers."""


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
    INCOMPLETE = 2  # some of several files failed
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
"""The meaning of each code, for the man page."""

SIGNALLED = 128
"""A command that a signal ended exits with this plus the signal's number, as in shells."""


_NOT_POSSIBLE = (
    UsageError,
    *(NotFound, NotADirectory, IsADirectory, AlreadyExists, DirectoryNotEmpty, InvalidMove, CrossDevice),
    *(ReadOnly, Armed, FileBusy, NotSupported, InvalidText, LocalProtocolError),
)
"""The vehicle answers, but cannot do the request with the files as they are."""

_CODES: tuple[tuple[type[MavftpfsError], ExitCode], ...] = (
    *((cls, ExitCode.USAGE) for cls in _NOT_POSSIBLE),
    (NotDelivered, ExitCode.UNDELIVERED),
    (MountFailed, ExitCode.MOUNT_FAILED),
)
"""All other errors: NO_VEHICLE, because no right answer arrived."""


def exit_code_for(error: MavftpfsError) -> ExitCode:
    """Return the exit code of a command that an error ends."""
    for cls, code in _CODES:
        if isinstance(error, cls):
            return code
    return ExitCode.NO_VEHICLE
