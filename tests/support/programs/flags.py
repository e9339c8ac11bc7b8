"""Opens in every way there is, in the working directory, and prints what worked."""

from __future__ import annotations

import errno
import itertools
import os
import stat
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

ACCESS = ("O_RDONLY", "O_WRONLY", "O_RDWR")
MORE = ("O_CREAT", "O_EXCL", "O_TRUNC", "O_APPEND")
PLACE = "flags"


def attempt(call: Callable[[], Any]) -> Any:
    """Return what a call returns, or the name of its errno."""
    try:
        return call()
    except OSError as error:
        return errno.errorcode[error.errno or 0]


def combinations() -> Iterator[tuple[str, ...]]:
    """Yield flags; O_EXCL alone has no defined meaning."""
    for access in ACCESS:
        for count in range(len(MORE) + 1):
            for more in itertools.combinations(MORE, count):
                if "O_EXCL" not in more or "O_CREAT" in more:
                    yield (access, *more)


def use(number: int) -> Iterator[Any]:
    """Yield what each use of an open file says."""
    yield attempt(lambda: os.read(number, 4))
    yield attempt(lambda: os.write(number, b"XY"))
    yield attempt(lambda: os.lseek(number, 0, os.SEEK_CUR))
    if not stat.S_ISDIR(os.fstat(number).st_mode):  # a directory's size is the disk's own affair
        yield attempt(lambda: os.fstat(number).st_size)
    yield attempt(lambda: os.ftruncate(number, 7))
    yield attempt(lambda: os.fsync(number))
    yield attempt(lambda: os.close(number))


def prepare(path: str, what: str) -> None:
    """Put what is to be opened there."""
    if what == "directory":
        os.mkdir(path)
    elif what == "file":
        with open(path, "wb") as file:
            file.write(b"0123456789")


def clear(path: str) -> str:
    """Take away what is there and return its content."""
    if os.path.isdir(path):
        os.rmdir(path)
    elif os.path.exists(path):
        with open(path, "rb") as file:
            content = file.read()
        os.unlink(path)
        return repr(content)
    return "nothing"


def main() -> None:
    """Print a line for each case."""
    os.mkdir(PLACE)
    path = f"{PLACE}/it"
    for names in combinations():
        for what in ("file", "missing", "directory"):
            prepare(path, what)
            number = attempt(partial(os.open, path, sum(getattr(os, name) for name in names)))
            results = [number] if isinstance(number, str) else list(use(number))
            print("|".join(names), what, *results, clear(path))
    os.rmdir(PLACE)


if __name__ == "__main__":
    main()
