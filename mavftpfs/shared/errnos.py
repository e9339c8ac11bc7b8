"""The kernel's number for every error. Layer: shared; pure, one total table.

A NAK means different things by request (servers.md 12 and 14.35): FileExists on a read from PX4 is left over
from an older request, FileNotFound on a read from ArduPilot means that the session is gone. So the key is
(opcode, NAK code), then the code alone, then EIO. Numbers behind FailErrno are those of the drone's OS, and
some are left over from an older failure. So only numbers that make sense for the request are passed on.

Opcodes and codes are plain numbers here, because their enums live one layer up; a test compares them.
"""

from __future__ import annotations

import errno

from mavftpfs.shared import errors

_LIST, _LIST_WITH_TIME, _OPEN_RO, _CREATE, _OPEN_WO = 3, 16, 4, 6, 11
_REMOVE, _MKDIR, _RMDIR, _RENAME, _CRC = 8, 9, 10, 13, 14
_READ, _WRITE, _BURST = 5, 7, 15

PATH_OPCODES = frozenset(
    {_LIST, _LIST_WITH_TIME, _OPEN_RO, _CREATE, _OPEN_WO, _REMOVE, _MKDIR, _RMDIR, _RENAME, _CRC}
)
"""Requests that carry a path, and whose NAK can therefore be about a name."""

_FAIL, _FAIL_ERRNO, _DATA_SIZE, _SESSION, _NO_SESSIONS, _UNKNOWN = 1, 2, 3, 4, 5, 7
_EXISTS, _PROTECTED, _NOT_FOUND = 8, 9, 10

_BY_CODE: dict[int, int] = {
    _DATA_SIZE: errno.EINVAL,
    _SESSION: errno.EBUSY,
    _NO_SESSIONS: errno.EBUSY,
    _UNKNOWN: errno.EOPNOTSUPP,
    _PROTECTED: errno.EACCES,
}

_BY_REQUEST: dict[tuple[int, int], int] = {
    **{(opcode, _DATA_SIZE): errno.ENAMETOOLONG for opcode in PATH_OPCODES},
    **{(opcode, _NOT_FOUND): errno.ENOENT for opcode in PATH_OPCODES},
    # Elsewhere FileExists is PX4's sticky EEXIST, and proves nothing (servers.md 12).
    **{(opcode, _EXISTS): errno.EEXIST for opcode in (_CREATE, _MKDIR, _RENAME, _OPEN_WO)},
    # ArduPilot without this opcode answers plain Fail (servers.md 6).
    (_LIST_WITH_TIME, _FAIL): errno.EOPNOTSUPP,
    # A fault of mavftpfs, not of the caller: its own request was wrong.
    (_READ, _DATA_SIZE): errno.EIO,
    (_BURST, _DATA_SIZE): errno.EIO,
    (_WRITE, _DATA_SIZE): errno.EIO,
}

_SAME_ON_ALL = (
    errno.EPERM,
    errno.ENOENT,
    errno.EIO,
    errno.ENXIO,
    errno.ENOMEM,
    errno.EACCES,
    errno.EBUSY,
    errno.EEXIST,
    errno.EXDEV,
    errno.ENODEV,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EINVAL,
    errno.ENFILE,
    errno.EMFILE,
    errno.EFBIG,
    errno.ENOSPC,
    errno.EROFS,
)
"""Numbers up to 34 agree on Linux, NuttX and newlib (servers.md 12)."""

_DRONE_ERRNO: dict[int, int] = {
    **{number: number for number in _SAME_ON_ALL},
    36: errno.ENAMETOOLONG,
    38: errno.EOPNOTSUPP,  # after ENOSYS itself the kernel would never ask again
    39: errno.ENOTEMPTY,
    40: errno.ELOOP,
    # newlib (ChibiOS, ESP32); on Linux these are socket errors, which no file request can mean
    88: errno.EOPNOTSUPP,
    90: errno.ENOTEMPTY,
    91: errno.ENAMETOOLONG,
    92: errno.ELOOP,
    95: errno.EOPNOTSUPP,
}

_SESSION_ERRNO = frozenset({errno.EIO, errno.EFBIG, errno.ENOSPC, errno.EROFS, errno.ENXIO})
"""Numbers that a request on an open file may have. Such a request names no path, so numbers about names are
left over from an older failure."""

_RMDIR_NOT_EMPTY = frozenset({errno.EEXIST, errno.EISDIR, errno.ENOTEMPTY})
"""RemoveDirectory of a full directory: unlink's EISDIR shows on POSIX ArduPilot (servers.md 9)."""

_BY_CLASS: dict[type[BaseException], int] = {
    errors.MavftpfsError: errno.EIO,
    errors.UsageError: errno.EINVAL,
    errors.LinkError: errno.EIO,
    errors.VehicleLost: errno.ETIMEDOUT,
    errors.LocalProtocolError: errno.EINVAL,
    errors.PathTooLong: errno.ENAMETOOLONG,
    errors.RemoteProtocolError: errno.EIO,
    errors.RequestTimeout: errno.ETIMEDOUT,
    errors.OutcomeUnknown: errno.ETIMEDOUT,
    errors.NotFound: errno.ENOENT,
    errors.NotADirectory: errno.ENOTDIR,
    errors.ListingIncomplete: errno.EIO,
    errors.IsADirectory: errno.EISDIR,
    errors.FileChanged: errno.ESTALE,
    errors.DataUnproven: errno.EIO,
    errors.SessionBusy: errno.EBUSY,
    errors.SessionLost: errno.EIO,
    errors.Armed: errno.EROFS,
    errors.NotDeliveredYet: errno.EAGAIN,
    errors.ReadOnly: errno.EROFS,
    errors.AlreadyExists: errno.EEXIST,
    errors.DirectoryNotEmpty: errno.ENOTEMPTY,
    errors.InvalidMove: errno.EINVAL,
    errors.CrossDevice: errno.EXDEV,
    errors.FileBusy: errno.EBUSY,
    errors.InvalidText: errno.EINVAL,
    errors.NotTaken: errno.EIO,
    errors.NotSupported: errno.EOPNOTSUPP,
    errors.FileTooLarge: errno.EFBIG,
    errors.NoSpace: errno.ENOSPC,
    errors.SpoolFailed: errno.EIO,
    errors.WriteFailed: errno.EIO,
    errors.VerificationFailed: errno.EIO,
    errors.NotVerified: errno.EIO,
    errors.MountFailed: errno.EIO,
    errors.NoFtp: errno.EIO,
    errors.NotDelivered: errno.EIO,
}


def errno_for(error: BaseException) -> int:
    """Return the errno with which a system call ends; EIO for every unknown error."""
    if isinstance(error, errors.FtpNak):
        return _errno_of_nak(error.opcode, error.code, error.server_errno)
    for cls in type(error).__mro__:
        if cls in _BY_CLASS:
            return _BY_CLASS[cls]
    return errno.EIO


def _errno_of_nak(opcode: int, code: int, server_errno: int | None) -> int:
    if code == _FAIL_ERRNO:
        return _errno_of_drone(opcode, server_errno)
    specific = _BY_REQUEST.get((opcode, code))
    return _BY_CODE.get(code, errno.EIO) if specific is None else specific


def _errno_of_drone(opcode: int, server_errno: int | None) -> int:
    number = _DRONE_ERRNO.get(server_errno or 0, errno.EIO)
    if opcode == _RMDIR and number in _RMDIR_NOT_EMPTY:
        return errno.ENOTEMPTY
    if opcode not in PATH_OPCODES and number not in _SESSION_ERRNO:
        return errno.EIO
    return number
