"""The directories below which `-o all` mounts vehicles. Layer: mount; only the standard library.

The mountpoint of `-o all` is a plain directory of this computer. A vehicle's directory in it has mode 0300:
nobody but root can list it. So `ls` and `rsync --delete` get "Permission denied" while the vehicle is not
mounted, and never an empty directory. The directory stays until the supervisor ends. The mount of a process
that was killed stays, too, and answers with ENOTCONN, until the next mount of that vehicle is ready.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress

from mavftpfs.client.mountpoint import OUR_TYPE, is_dead, mounts
from mavftpfs.shared.errors import MountFailed

UNREADABLE = 0o300
"""The mode of a vehicle's directory: its owner can mount on it, and not list it."""


def check(place: str) -> None:
    """Check that vehicles can be mounted below a directory.

    Raises:
        MountFailed: vehicles are mounted there, or it has entries that no mount of all vehicles left.
    """
    for name in sorted(os.listdir(place)):
        path = os.path.join(place, name)
        if path in mounts() and not is_dead(path):
            raise MountFailed(f"vehicles are mounted below {place} already; run: mavftpfs umount {place}")
        if not _is_vehicles(path):
            raise MountFailed(
                f"{place} has entries of its own ({name}); give an empty directory, as {place}/drones"
            )


def make(place: str, name: str) -> None:
    """Make a vehicle's directory, if it does not exist.

    Raises:
        MountFailed: the directory cannot be made.
    """
    path = os.path.join(place, name)
    try:
        if path not in mounts():
            with suppress(FileExistsError):
                os.mkdir(path, UNREADABLE)
    except OSError as exc:
        raise MountFailed(f"cannot make {path}: {exc.strerror}") from exc


def remove(place: str) -> None:
    """Remove the directories of vehicles on which nothing is mounted."""
    for name in os.listdir(place):
        path = os.path.join(place, name)
        if path not in mounts() and _is_vehicles(path):
            with suppress(OSError):  # somebody put a file into it
                os.rmdir(path)


def _is_vehicles(path: str) -> bool:
    """Return whether a mount of all vehicles made this directory, which may have a dead mount on it."""
    name = os.path.basename(path)
    if not name.isascii() or not name.isdigit():
        return False
    mount = mounts().get(path)
    if mount is not None:
        return mount.type == OUR_TYPE
    facts = os.lstat(path)
    return stat.S_ISDIR(facts.st_mode) and stat.S_IMODE(facts.st_mode) == UNREADABLE
