"""Files and directories that only their owner may read. Layer: shared."""

from __future__ import annotations

import errno
import os
import pwd
from contextlib import suppress
from pathlib import Path

MODE = 0o600
DIRECTORY_MODE = 0o700


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


def log_file() -> Path:
    """Return the file for the log of programs in the background, where there is no syslog."""
    home = os.environ.get("HOME")
    with suppress(KeyError):
        home = home or pwd.getpwuid(os.getuid()).pw_dir
    return Path(home or "/tmp") / ".cache" / "mavftpfs" / "mavftpfs.log"
