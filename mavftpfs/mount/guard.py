"""The guard of every handler of pyfuse3: only FUSEError leaves it, and it ends in time. Layer: mount.

Any other error would end pyfuse3's main loop, and with it the mount. A caller that waits in the kernel cannot
be killed. trio.Cancelled passes.
"""

from __future__ import annotations

import errno
import functools
import logging
from collections.abc import Callable, Coroutine
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

import trio
from pyfuse3 import FUSEError

from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import MavftpfsError

log = logging.getLogger("mavftpfs.fuse")

MARGIN = 3.0
"""Seconds beyond op_deadline for the tree to report its own, better error."""

LONG, LONGEST = 600.0, 4 * 3600.0
"""Seconds for calls that wait for a file to be read or a name to be changed, and for those that wait until
a file is sent. The tree itself ends a call without progress, so these end only a trickle."""

_BUDGETS = {
    **dict.fromkeys(("read", "getxattr", "create", "mkdir", "rmdir", "unlink", "rename"), LONG),
    **dict.fromkeys(("write", "flush", "fsync", "release", "setattr", "open"), LONGEST),
}
"""Handler -> its seconds. All others have op_deadline and MARGIN."""


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
        with trio.move_on_after(max(_BUDGETS.get(method.__name__, 0.0), self.op_deadline + MARGIN)):
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
