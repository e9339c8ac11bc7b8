"""Errors for programs: OSErrors of the right kind, with the sentence that people get. Layer: api."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mavftpfs.shared import errors
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import MavftpfsError, UsageError
from mavftpfs.shared.readable import readable

__all__ = ["NotDelivered", "UsageError", "os_error", "translated"]


class NotDelivered(OSError):
    """A file that was written is not on the vehicle, or that is not proven.

    It is also of the kind of its reason: a TimeoutError, a PermissionError.

    Attributes:
        on_vehicle: what is there now. True: the file as it was written. False: what was there before, or
            nothing; what was written is withdrawn, and nothing of it is sent later. None: that is not known.
    """

    on_vehicle: bool | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle it, as pools of processes do with errors."""
        return _not_delivered, (self.errno, self.strerror, self.on_vehicle)


def os_error(error: MavftpfsError, text: str = "") -> Exception:
    """Return the error that a program gets in place of one of ours; with its text, unless another is given.

    A UsageError stays one, which is a ValueError, unless the operating system is behind it.
    """
    number, text = _number(error), readable(text or str(error))
    if isinstance(error, errors.NotDelivered):
        return _not_delivered(number, f"{text} ({whereabouts(error.there)})", error.there)
    if isinstance(error, UsageError) and not isinstance(error.__cause__, OSError):
        return error if text == str(error) else UsageError(text)
    return OSError(number, text)


@contextmanager
def translated() -> Iterator[None]:
    """Turn errors of ours in the body into those that programs get."""
    try:
        yield
    except MavftpfsError as exc:
        told = os_error(exc)
        if told is exc:
            raise
        raise told from (None if isinstance(told, UsageError) else exc)


def note_or_raise(undelivered: NotDelivered, error: BaseException | None) -> None:
    """Note on the error of a `with` statement's body that its file was not delivered. Raise that instead, if
    the body had no error, or one of a file."""
    if error is None or isinstance(error, OSError):
        raise undelivered
    error.add_note(str(undelivered))


def whereabouts(there: bool | None) -> str:
    """Return the words about a file that was not delivered; see NotDelivered.on_vehicle."""
    if there is None:
        return "it is not known what the vehicle has now: look before you use it"
    if there:
        return "it is on the vehicle, whole"
    return "withdrawn: the vehicle has what it had, and nothing of it is sent later"


def _number(error: MavftpfsError) -> int:
    cause = error.__cause__
    match error:
        case errors.NotDelivered() | errors.NoFtp() | errors.LinkClosed() if isinstance(cause, MavftpfsError):
            return _number(cause)
        case errors.LinkClosed() | UsageError() if isinstance(cause, OSError) and cause.errno:
            return cause.errno
        case errors.LinkClosed():
            return errno.ECONNABORTED
        case errors.NoFtp():
            return errno.ETIMEDOUT
    return errno_for(error)


def _not_delivered(number: int, text: str, there: bool | None) -> NotDelivered:
    """Return a NotDelivered that is of the kind of an errno, too."""
    kinds = (NotDelivered, type(OSError(number, text)))
    error: NotDelivered = type("NotDelivered", kinds, {"__module__": NotDelivered.__module__})(number, text)
    error.on_vehicle = there
    return error
