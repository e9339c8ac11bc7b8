"""Files and directories that only their owner may read. Layer: shared."""

from __future__ import annotations

import errno
import os
import pwd
import stat
from contextlib import suppress
from pathlib import Path

MODE = 0o600
DIRECTORY_MODE = 0o700
_MAX_SOCKET_PATH = 107


def open_private(path: str | Path, flags: int) -> int:
    """Open a file for writing, and make it with mode 0600 if it is missing; return its descriptor.

    flags: of os.open; the function adds O_CREAT and O_CLOEXEC.

    Raises:
        OSError: among others if the path is a symbolic link, which is not followed (ELOOP).
    """
    try:
        return os.open(path, flags | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, MODE)
    except OSError as exc:
        if exc.errno == errno.ELOOP:
            raise OSError(errno.ELOOP, "it is a symbolic link", str(path)) from exc
        raise


def make_private_directory(path: Path) -> None:
    """Make a directory with mode 0700, and the missing ones above it; an existing one keeps its mode.

    Raises:
        OSError.
    """
    if not path.is_dir():
        make_private_directory(path.parent)
        path.mkdir(mode=DIRECTORY_MODE, exist_ok=True)


# -- where sockets are ----------------------------------------------------------------------------


def own_directories() -> list[Path]:
    """Return the directories for this user's sockets, the preferred one first.

    A mount from fstab has no XDG_RUNTIME_DIR, but a shell of the same user has one, so programs search all.
    """
    runtime, home = os.environ.get("XDG_RUNTIME_DIR"), os.environ.get("HOME")
    with suppress(KeyError):
        home = home or pwd.getpwuid(os.getuid()).pw_dir
    given = [Path(runtime) / "mavftpfs"] if runtime else []
    usual = [Path(f"/run/user/{os.getuid()}/mavftpfs"), Path(home or "/tmp") / ".cache" / "mavftpfs"]
    return list(dict.fromkeys([*given, *usual]))


def private_directory(directories: list[Path], *, longest_name: int) -> Path | None:
    """Return the first directory that belongs to this user alone, or can be made so, and that is short enough
    for the path of a socket with such a long name; None if there is none."""
    for directory in directories:
        try:
            # Not parents=True for a runtime directory: only the system creates /run/user/UID.
            directory.parent.mkdir(mode=DIRECTORY_MODE, exist_ok=True)
            directory.mkdir(mode=DIRECTORY_MODE, exist_ok=True)
            facts = directory.lstat()
        except OSError:
            continue
        ours = stat.S_ISDIR(facts.st_mode) and facts.st_uid == os.getuid() and not facts.st_mode & 0o077
        if ours and len(os.fsencode(directory)) + 1 + longest_name <= _MAX_SOCKET_PATH:
            return directory
    return None
