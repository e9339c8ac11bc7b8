"""Files and directories that only their owner may read. Layer: shared."""

from __future__ import annotations

import errno
import os
from pathlib import Path

MODE = 0o600
DIRECTORY_MODE = 0o700


def open_private(path: str | Path, flags: int) -> int:
    """Open a file for writing, made 0600 if it is not there, and return its descriptor.

    flags: of os.open, O_CREAT and O_CLOEXEC are added.

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
    """Make a directory 0700, and those above it that are missing; one that is there stays as it is.

    Raises:
        OSError.
    """
    if not path.is_dir():
        make_private_directory(path.parent)
        path.mkdir(mode=DIRECTORY_MODE, exist_ok=True)
