"""Which vehicles are mounted on this machine, and what each mount says of itself. Layer: top.

A mount is asked over its control socket. Where that cannot be reached (it is another user's) the extended
attribute of its root says the same to whoever may read the mount. Root may ask everybody's.
"""

from __future__ import annotations

import errno
import json
import os
import pwd
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mavftpfs import control
from mavftpfs.control import ControlError, NobodyThere
from mavftpfs.mountpoint import OUR_TYPE, Mounted, mounts

Status = Mapping[str, Any]

STATUS_XATTR = "user.mavftpfs.status"
PATIENCE = 10.0
"""Seconds for a mount to answer: it does so without asking the vehicle."""


def all_statuses() -> list[Status]:
    """Return the status of each mount that this user may ask, the dead ones too, by mountpoint."""
    found: dict[str, Status] = {}
    for path, mount in mounts().items():
        status = _status_of(path, mount) if mount.type == OUR_TYPE else None
        if status is not None:
            found[path] = status
    known = {control.socket_name(path) for path in found}
    for socket in control.all_sockets(control.own_directories()):
        if socket.name not in known:
            # The kernel shows it no more, but it still delivers; or it is in another mount namespace.
            status = _ask_or_remove(socket)
            if status is not None:
                found.setdefault(status["mountpoint"], status)
    return [found[path] for path in sorted(found)]


def status_of(mountpoint: str) -> Status:
    """Return the status of one mount; if it cannot be asked `state` (dead, mute) and `problem` in words.

    Raises:
        NobodyThere: no vehicle is mounted there, or this user may not ask.
    """
    mount = mounts().get(mountpoint)
    if mount is not None and mount.type == OUR_TYPE:
        status = _status_of(mountpoint, mount)
        if status is not None:
            return status
    return _ask(control.find_socket(mountpoint, control.own_directories()))


def find_socket(mountpoint: str) -> Path:
    """Return the control socket of a mount; root finds other users', too.

    Raises:
        NobodyThere: there is none.
    """
    mount = mounts().get(mountpoint)
    directories = control.own_directories()
    if mount is not None and mount.uid is not None:
        directories += _directories_of(mount.uid)
    return control.find_socket(mountpoint, directories)


def _directories_of(uid: int) -> list[Path]:
    if uid == os.getuid():
        return []
    try:
        home = pwd.getpwuid(uid).pw_dir
    except KeyError:
        home = "/nonexistent"
    return control.socket_directories({}, uid, home)


def _status_of(path: str, mount: Mounted) -> Status | None:
    """Return what a mount says; None if this user may not ask."""
    try:
        return _ask(find_socket(path))
    except NobodyThere:
        pass
    except ControlError as exc:
        return _unasked(path, mount, "mute", f"its program does not answer: {exc}")
    answer = _read_xattr(path)
    if isinstance(answer, bytes):
        facts: Status = json.loads(answer)
        return facts
    if answer == errno.ENOTCONN:
        return _unasked(path, mount, "dead", f"DEAD: its program is gone; run: mavftpfs umount {path}")
    if answer in (errno.EACCES, errno.EPERM):
        return None
    return _unasked(path, mount, "mute", f"its program does not answer: {os.strerror(answer)}")


def _unasked(path: str, mount: Mounted, state: str, problem: str) -> Status:
    return {"mountpoint": path, "source": mount.source, "state": state, "problem": problem}


def _read_xattr(path: str) -> bytes | int:
    """Return the attribute, or the errno; from a thread, because a program that was stopped answers never."""
    answer: list[bytes | int] = []

    def read() -> None:
        try:
            answer.append(os.getxattr(path, STATUS_XATTR))
        except OSError as exc:
            answer.append(exc.errno or errno.EIO)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(PATIENCE)
    return answer[0] if answer else errno.ETIMEDOUT


def _ask(socket: Path) -> Status:
    facts: Status = control.ask(socket, {"command": "status"}, timeout=PATIENCE)["status"]
    return facts


def _ask_or_remove(socket: Path) -> Status | None:
    try:
        return _ask(socket)
    except NobodyThere:
        socket.unlink(missing_ok=True)
    except ControlError:
        pass  # which mount it is, only it could say
    return None
