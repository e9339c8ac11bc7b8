"""Errors for programs: OSErrors of the right kind, with the command line's sentences. Layer: api."""

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
    """The vehicle does not have a written file, or may not have it.

    The error is also of the kind of its reason: a TimeoutError, a PermissionError.

    Attributes:
        on_vehicle: what is there now. True: the file as it was written. False: the old file, or none; the
            changes are discarded, and nothing of them is sent later. None: unknown.
    """

    on_vehicle: bool | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the error, as pools of processes do."""
        return _not_delivered, (self.errno, self.strerror, self.on_vehicle)


def os_error(error: MavftpfsError, text: str = "") -> Exception:
    """Return the error that a program gets in place of a MavftpfsError; text: replaces its own text.

    A UsageError, which is a ValueError, stays unless the operating system caused it.
    """
    number, text = _number(error), readable(text or str(error))
    if isinstance(error, errors.NotDelivered):
        return _not_delivered(number, f"{text} ({whereabouts(error.there)})", error.there)
    if isinstance(error, UsageError) and not isinstance(error.__cause__, OSError):
        return error if text == str(error) else UsageError(text)
    return OSError(number, text)


@contextmanager
def translated() -> Iterator[None]:
    """Turn each MavftpfsError of the body into the error that programs get."""
    try:
        yield
    except MavftpfsError as exc:
        told = os_error(exc)
        if told is exc:
            raise
        raise told from (None if isinstance(told, UsageError) else exc)


def note_or_raise(undelivered: NotDelivered, error: BaseException | None) -> None:
    """Add a note about the undelivered file to the error of a `with` statement's body. Raise `undelivered`
    itself if the body raised no error, or one about a file."""
    if error is None or isinstance(error, OSError):
        raise undelivered
    error.add_note(str(undelivered))


def whereabouts(there: bool | None) -> str:
    """Return the words for NotDelivered.on_vehicle."""
    if there is None:
        return "the vehicle may have the old file, the new one, or a part: look before you use it"
    if there:
        return "the vehicle has the whole file"
    return "discarded: the vehicle keeps what it had, and nothing is sent later"


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
    """Return a NotDelivered that is also of an errno's kind."""
    kinds = (NotDelivered, type(OSError(number, text)))
    error: NotDelivered = type("NotDelivered", kinds, {"__module__": NotDelivered.__module__})(number, text)
    error.on_vehicle = there
    return error
