"""The control socket: how `status` and `umount` talk to a running mount. Layer: client.

One Unix socket (0600, in a 0700 directory) for each mount, named after a hash of the mountpoint. One
request and one reply, each a JSON object on a line; the reply to `umount` comes when all is delivered and
the session is closed. This is the side of the commands: plain blocking code, because they should start at
once. The mount's side is `controlserver`.
"""

from __future__ import annotations

import hashlib
import json
import os
import select
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mavftpfs.shared.errors import MountFailed
from mavftpfs.shared.private import directories_of, own_directories, private_directory

__all__ = ["directories_of", "own_directories"]

Reply = dict[str, Any]

MAX_LINE = 1 << 20
MEANWHILE = 1.0
"""Seconds between two calls of `meanwhile`."""
_SUFFIX = ".sock"


class ControlError(MountFailed):
    """The mount's process refused, or did not answer in time."""


class NobodyThere(ControlError):
    """No running mount answers there."""


# -- where the sockets are ------------------------------------------------------------------------


def socket_name(mountpoint: str) -> str:
    """Return the socket's file name for a mountpoint (an absolute path)."""
    digest = hashlib.sha256(mountpoint.encode("utf-8", "surrogateescape")).hexdigest()
    return digest[:20] + _SUFFIX


def usable_directory(directories: list[Path]) -> Path:
    """Return the first directory that is, or can be made, this user's alone.

    Raises:
        ControlError: none can.
    """
    found = private_directory(directories, longest_name=len(socket_name("")))
    if found is not None:
        return found
    raise ControlError(
        f"no private directory for the control socket (tried {', '.join(map(str, directories))})"
    )


# -- asking ---------------------------------------------------------------------------------------


def ask(path: Path, request: Reply, *, timeout: float, meanwhile: Callable[[], None] | None = None) -> Reply:
    """Send one request and return the reply; `meanwhile` is called about each second while there is none.

    Raises:
        NobodyThere: the process is gone.
        ControlError: it does not answer within `timeout` seconds, or refuses.
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
    except (OSError, ValueError) as exc:
        raise ControlError(f"no answer from the mount's process: {exc}") from exc
    if not isinstance(reply, dict) or not reply.get("ok"):
        raise ControlError(str(reply.get("error")) if isinstance(reply, dict) else "malformed answer")
    return reply


def find_socket(mountpoint: str, directories: list[Path]) -> Path:
    """Return the socket of the mount on `mountpoint`.

    Raises:
        NobodyThere: there is none.
    """
    for directory in directories:
        path = directory / socket_name(mountpoint)
        if _is_socket(path):
            return path
    raise NobodyThere(f"no vehicle of yours is mounted on {mountpoint}")


def all_sockets(directories: list[Path]) -> Iterator[Path]:
    """Yield the sockets of all mounts of this user, the dead ones too."""
    for directory in directories:
        try:
            names = sorted(os.listdir(directory))
        except OSError:
            continue
        paths = [directory / name for name in names if name.endswith(_SUFFIX)]
        yield from filter(_is_socket, paths)


def _is_socket(path: Path) -> bool:
    """Return whether there is a socket that we may see; False in another user's directories."""
    try:
        return path.is_socket()
    except OSError:
        return False
