"""Exit codes of the command line, and which error means which. Layer: top."""

from __future__ import annotations

from enum import IntEnum

from mavftpfs.shared.errors import (
    AlreadyExists,
    Armed,
    CrossDevice,
    DirectoryNotEmpty,
    FileBusy,
    InvalidMove,
    IsADirectory,
    LinkError,
    LocalProtocolError,
    MavftpfsError,
    NotADirectory,
    NotFound,
    NotSupported,
    ReadOnly,
    RequestTimeout,
    UsageError,
)


class ExitCode(IntEnum):
    """What the shell is told."""

    OK = 0
    USAGE = 1
    NO_VEHICLE = 2
    INCOMPLETE = 2  # of several things some failed
    MOUNT_FAILED = 3
    UNDELIVERED = 4
    BUG = 70
    INTERRUPTED = 130


EXIT_CODES = {
    ExitCode.OK: "fine",
    ExitCode.USAGE: "wrong usage, or not possible with the files as they are",
    ExitCode.NO_VEHICLE: "no vehicle, no FTP, or no right answer from it",
    ExitCode.MOUNT_FAILED: "mounting or unmounting failed",
    ExitCode.UNDELIVERED: "data could not be delivered to the card; the message names where it lies",
    ExitCode.BUG: "a bug of ours",
    ExitCode.INTERRUPTED: "interrupted; 128 and the number of the signal for others",
}
"""What each means, for the man page."""

SIGNALLED = 128
"""Plus a signal's number: that signal ended it, as shells say it."""


class MountFailed(MavftpfsError):
    """The kernel side cannot be set up or taken down."""


class NoFtp(MavftpfsError):
    """A vehicle is there, but its files are not."""


class NotDelivered(MavftpfsError):
    """Bytes that were to be written are not provably on the vehicle."""


_NOT_POSSIBLE = (
    UsageError,
    *(NotFound, NotADirectory, IsADirectory, AlreadyExists, DirectoryNotEmpty, InvalidMove, CrossDevice),
    *(ReadOnly, Armed, FileBusy, NotSupported, LocalProtocolError),
)
"""The vehicle is there, but what was asked cannot be done with the files as they are."""

_CODES: tuple[tuple[type[MavftpfsError], ExitCode], ...] = (
    *((cls, ExitCode.USAGE) for cls in _NOT_POSSIBLE),
    (NotDelivered, ExitCode.UNDELIVERED),
    (MountFailed, ExitCode.MOUNT_FAILED),
    (NoFtp, ExitCode.NO_VEHICLE),
    (LinkError, ExitCode.NO_VEHICLE),
    (RequestTimeout, ExitCode.NO_VEHICLE),
)


def exit_code_for(error: MavftpfsError) -> ExitCode:
    """Return the exit code an error ends a command with."""
    for cls, code in _CODES:
        if isinstance(error, cls):
            return code
    return ExitCode.NO_VEHICLE
