"""The guard of every handler of pyfuse3: only FUSEError leaves it, and it ends in time. Layer: mount.

Any other error would end pyfuse3's main loop, and with it the mount. A caller that waits in the kernel cannot
be killed. trio.Cancelled passes.
"""

from __future__ import annotations

import errno
import functools
import logging
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

import trio
from pyfuse3 import FUSEError

from mavftpfs.client.mountpoint import XATTR_CRC32
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import MavftpfsError

log = logging.getLogger("mavftpfs.fuse")

MARGIN = 3.0
"""Seconds beyond op_deadline for the tree to report its own, better error."""

CRC_BUDGET = 120.0
"""Seconds for a checksum, for which the vehicle reads the whole file (promise 2)."""

DELIVERY_BUDGET = 4 * 3600.0
"""Seconds for calls that move bytes. The tree itself ends calls without progress, so this ends only a
trickle."""

NAMESPACE_BUDGET = 240.0
"""Seconds for a change of names, which may have to finish a delivery, and to check whether it happened."""

_DELIVERING = frozenset({"write", "flush", "fsync", "release", "setattr", "open"})
_NAMING = frozenset({"create", "mkdir", "rmdir", "unlink", "rename"})

SLOWEST_RATE = 256
"""Bytes/s of the slowest link worth waiting for. The tree itself ends a read without progress; this ends a
read that trickles."""


class Guarded(Protocol):
    """Has handlers. op_deadline: seconds without progress after which the tree raises an error."""

    op_deadline: float


P = ParamSpec("P")
T = TypeVar("T")
S = TypeVar("S", bound=Guarded)
Handler = Callable[Concatenate[S, P], Coroutine[Any, Any, T]]


def handler(method: Handler[S, P, T]) -> Handler[S, P, T]:
    """Guard a handler."""

    async def guarded(self: S, /, *args: P.args, **kwargs: P.kwargs) -> T:
        with trio.move_on_after(budget(method.__name__, args, self.op_deadline)):
            try:
                return await method(self, *args, **kwargs)
            except FUSEError:
                raise
            except MavftpfsError as exc:
                log.debug("%s: %s", method.__name__, exc)
                raise FUSEError(errno_for(exc)) from exc
            except Exception as exc:
                log.exception("bug in %s; the caller gets EIO", method.__name__)
                raise FUSEError(errno.EIO) from exc
        log.warning("%s took longer than its deadline", method.__name__)
        raise FUSEError(errno.ETIMEDOUT)

    return functools.update_wrapper(guarded, method)


def budget(name: str, args: Sequence[Any], op_deadline: float) -> float:
    """Return the seconds that the handler of this name may take, with these arguments."""
    if name in _DELIVERING:
        return DELIVERY_BUDGET
    if name in _NAMING:
        return NAMESPACE_BUDGET
    if name == "read":
        return op_deadline + MARGIN + int(args[2]) / SLOWEST_RATE
    if name == "getxattr" and args[1] == XATTR_CRC32:
        return CRC_BUDGET + op_deadline + MARGIN
    return op_deadline + MARGIN
