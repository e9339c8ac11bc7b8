"""The control socket: commands and programs send requests to a running mount. Layer: client.

Each mount has a Unix socket, named after a hash of the mountpoint. A request and its reply are each a JSON
object on a line; the reply to `umount` is sent after the last upload, when the session is closed. These lines
never change, so that a command can query and end mounts of all versions. After a request for `files`, the
messages of client.wire follow.

The socket belongs to the user alone (0600). A mount of root has its socket in SYSTEM, and also serves the
user that `uid=` names.

This is the side of the commands: plain blocking code, because commands should start at once. The mount's side
is mount.controlserver.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import select
import socket
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from mavftpfs.shared.errors import MountFailed

Reply = dict[str, Any]

MAX_LINE = 1 << 20
MEANWHILE = 1.0
"""Seconds between two calls of `meanwhile`."""
SYSTEM = Path("/run/mavftpfs")
USERS = Path("/tmp")
"""Has a directory for the sockets of each user: its path is short, and a logout does not remove it."""
FOREIGN = "belongs to another user; only that user and root may use it by commands"
"""The reason why a mount refuses, although its files may be for everybody."""
BOUND = Path("/proc/net/unix")
"""The kernel's table of sockets that are bound."""
_SUFFIX = ".sock"
_OURS = re.compile(r"^/.*/mavftpfs(?:-[0-9]+)?/[0-9a-f]{20}\.sock$")


class ControlError(MountFailed):
    """The mount's process refused, or did not answer in time."""


class Refused(ControlError):
    """The mount's process refused; the text gives the reason."""


class NobodyThere(ControlError):
    """No running mount answers there."""


# -- where the sockets are ------------------------------------------------------------------------


def socket_name(mountpoint: str) -> str:
    """Return the socket's file name for a mountpoint (an absolute path)."""
    digest = hashlib.sha256(mountpoint.encode("utf-8", "surrogateescape")).hexdigest()
    return digest[:20] + _SUFFIX


def usable_directory() -> Path:
    """Return the directory for this user's sockets, and make it if necessary.

    Raises:
        ControlError: it cannot be made, or other users may enter it.
    """
    if os.getuid() == 0 and _is_roots(SYSTEM):
        return SYSTEM
    directory = USERS / f"mavftpfs-{os.getuid()}"
    with suppress(OSError):
        with suppress(FileExistsError):
            directory.mkdir(mode=0o700)
        facts = directory.lstat()
        if stat.S_ISDIR(facts.st_mode) and facts.st_uid == os.getuid() and not facts.st_mode & 0o077:
            return directory
    raise ControlError(f"no control socket, because {directory} is not a directory of this user alone")


def _is_roots(directory: Path) -> bool:
    """Make a directory that all may enter; return whether only root may change its entries."""
    with suppress(OSError):
        with suppress(FileExistsError):
            directory.mkdir()
            directory.chmod(0o755)  # whatever the umask is
        facts = directory.lstat()
        return stat.S_ISDIR(facts.st_mode) and facts.st_uid == 0 and not facts.st_mode & 0o022
    return False


# -- asking ---------------------------------------------------------------------------------------


def ask(path: Path, request: Reply, *, timeout: float, meanwhile: Callable[[], None] | None = None) -> Reply:
    """Send one request and return the reply; `meanwhile` is called about each second while there is none.

    Raises:
        NobodyThere: the process is gone. Refused. ControlError: it does not answer within `timeout` seconds.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(timeout)
            client.connect(str(path))
            client.sendall(json.dumps(request).encode() + b"\n")
            deadline = time.monotonic() + timeout
            while meanwhile is not None and not select.select([client], [], [], MEANWHILE)[0]:
                if time.monotonic() > deadline:
                    break
                meanwhile()
            with client.makefile("rb") as lines:
                line = lines.readline(MAX_LINE)
        reply = json.loads(line)
    except (ConnectionError, FileNotFoundError) as exc:
        raise NobodyThere("the mount's process is gone") from exc
    except PermissionError as exc:
        raise Refused(FOREIGN) from exc
    except (OSError, ValueError) as exc:
        raise ControlError(f"no answer from the mount's process: {exc}") from exc
    return granted(reply)


def granted(reply: object) -> Reply:
    """Return a reply.

    Raises:
        Refused: the reply gives the reason. ControlError: the reply is malformed.
    """
    if not isinstance(reply, dict):
        raise ControlError("malformed answer")
    if not reply.get("ok"):
        raise Refused(str(reply.get("error")))
    return reply


# -- finding --------------------------------------------------------------------------------------


def find_socket(mountpoint: str, uid: int | None = None) -> Path:
    """Return the socket of the mount on `mountpoint`, of this user, of root or of `uid`.

    Raises:
        NobodyThere: there is no such socket.
    """
    for path in all_sockets(uid):
        if path.name == socket_name(mountpoint):
            return path
    raise NobodyThere(f"no vehicle of yours is mounted on {mountpoint}")


def all_sockets(uid: int | None = None) -> Iterator[Path]:
    """Yield the sockets at which mounts of this user, of root or of `uid` listen in this network namespace,
    in every directory."""
    owners = {0, os.getuid(), uid}
    try:
        lines = BOUND.read_text(errors="surrogateescape").splitlines()
    except OSError:
        return
    for path in dict.fromkeys(line.split(maxsplit=7)[-1] for line in lines):
        if _OURS.search(path):
            with suppress(OSError):  # the directory is another user's
                if os.stat(path).st_uid in owners:
                    yield Path(path)
