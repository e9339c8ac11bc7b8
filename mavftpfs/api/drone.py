"""A vehicle's files for ordinary programs and notebooks: `mavftpfs.connect`. Layer: api.

Every method is that of `api.vehicle.Drone`, which explains it, called in the event loop's thread.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from mavftpfs.api import vehicle
from mavftpfs.api.errors import NotDelivered, UsageError
from mavftpfs.api.opened import Opened
from mavftpfs.api.params import Params
from mavftpfs.api.portal import LoopThread
from mavftpfs.api.pythonfile import Mode, python_file
from mavftpfs.api.vehicle import Entry, PathLike
from mavftpfs.client.proof import Verify

__all__ = ["Drone", "Entry", "NotDelivered", "UsageError", "connect"]


def connect(source: str, *, use_mount: bool = True, **options: object) -> Drone:
    """Return a vehicle's files; close it at the end, or use it in a `with` statement.

    source: as for `mavftpfs`: a link (`udpin:0.0.0.0:14550`, `/dev/ttyACM0`), or where it is mounted. A mount
    of that vehicle that is up is used, unless `use_mount` is False. options: those of a mount, by name:
    `target_system=2, signing_key="key", ro=True`.

    Raises:
        TimeoutError: no vehicle, or none that answers, within `connect_timeout`. OSError: the link cannot be
        opened. UsageError (a ValueError): source or an option is wrong; the text names it.
    """
    return Drone(source, LoopThread(lambda: vehicle.connect(source, use_mount=use_mount, **options), source))


class Drone:
    """A vehicle's files. Made by `connect`; every call may be made by several threads at once.

    Paths are text, bytes or path-like; relative ones begin at the root. Errors are OSErrors of the right kind
    (FileNotFoundError, PermissionError, TimeoutError ...), whose text is a sentence for people. After a fork
    every call raises RuntimeError, and after `close` ValueError.
    """

    def __init__(self, source: str, loop: LoopThread[vehicle.Drone]) -> None:
        self.source = source
        self._loop = loop
        self._drone = loop.value

    @property
    def mountpoint(self) -> str | None:
        """The mount whose files these are; None for a connection of its own."""
        return self._drone.mountpoint

    @property
    def closed(self) -> bool:
        """Whether nothing can be called any more."""
        return self._loop.closed

    @property
    def has_open_files(self) -> bool:
        """Whether a file of it is open."""
        return self._drone.has_open_files

    def close(self) -> None:
        """Close the vehicle's session. Files that were written and are still open are withdrawn, and named in
        the log."""
        self._loop.close()

    def __enter__(self) -> Drone:
        """Return the drone."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        """Close it."""
        self.close()

    def __del__(self) -> None:
        """Have it closed, and do not wait."""
        loop = getattr(self, "_loop", None)
        if loop is not None and not loop.closed:
            loop.stop()
            warnings.warn(f"{self!r} was not closed", ResourceWarning, stacklevel=2, source=self)

    def __repr__(self) -> str:
        return f"<Drone {self.source}>"

    # --- looking

    def stat(self, path: PathLike) -> Entry:
        """Return what a path is."""
        return self._loop.call(self._drone.stat, path)

    def scandir(self, path: PathLike = "/") -> Iterator[Entry]:
        """Yield what is in a directory. An incomplete listing is an error."""
        return iter(self._loop.call(self._drone.scandir, path))

    def listdir(self, path: PathLike = "/") -> list[str]:
        """Return the names in a directory."""
        return self._loop.call(self._drone.listdir, path)

    def walk(self, path: PathLike = "/") -> Iterator[Entry]:
        """Yield all that is below a directory, parents first."""
        return iter(self._loop.call(self._drone.walk, path))

    def exists(self, path: PathLike) -> bool:
        """Return whether there is something of that name."""
        return self._loop.call(self._drone.exists, path)

    def is_dir(self, path: PathLike) -> bool:
        """Return whether there is a directory of that name."""
        return self._loop.call(self._drone.is_dir, path)

    def is_file(self, path: PathLike) -> bool:
        """Return whether there is a file of that name."""
        return self._loop.call(self._drone.is_file, path)

    def crc32(self, path: PathLike) -> int:
        """Have the vehicle compute a file's CRC32."""
        return self._loop.call(self._drone.crc32, path)

    def status(self) -> dict[str, Any]:
        """Return what `mavftpfs status --json` tells of vehicle, link and transfers."""
        return self._loop.call(self._drone.status)

    def refresh(self) -> None:
        """Forget what is remembered of the vehicle, so that it is asked again; others may have changed it."""
        self._loop.call(self._drone.refresh)

    # --- parameters

    @property
    def params(self) -> Params:
        """The vehicle's parameters, a mapping: `drone.params["MPC_XY_CRUISE"] = 4.5`."""
        call, drone = self._loop.call, self._drone
        return Params(partial(call, drone.get_params), partial(call, drone.set_params))

    # --- changing names

    def mkdir(self, path: PathLike, *, parents: bool = False, exist_ok: bool = False) -> None:
        """Make a directory, and with `parents` those above it."""
        self._loop.call(partial(self._drone.mkdir, path, parents=parents, exist_ok=exist_ok))

    def rmdir(self, path: PathLike) -> None:
        """Remove an empty directory."""
        self._loop.call(self._drone.rmdir, path)

    def remove(self, path: PathLike, *, recursive: bool = False) -> None:
        """Remove a file; with `recursive` a directory with all below, too."""
        self._loop.call(partial(self._drone.remove, path, recursive=recursive))

    unlink = remove

    def rename(self, old: PathLike, new: PathLike) -> None:
        """Rename, over a file that is there. Where the card cannot rename it is copied, then removed."""
        self._loop.call(self._drone.rename, old, new)

    def copy(self, old: PathLike, new: PathLike) -> None:
        """Copy a file, by way of this computer."""
        self._loop.call(self._drone.copy, old, new)

    def truncate(self, path: PathLike, size: int) -> None:
        """Cut a file, or extend it by zeros."""
        self._loop.call(self._drone.truncate, path, size)

    # --- files

    def open(
        self,
        path: PathLike,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
    ) -> IO[Any]:
        """Open a file as the builtin does; text is UTF-8 unless `encoding` says otherwise.

        What was written is on the card, checked, when `close` returns.

        Raises:
            FileNotFoundError, FileExistsError, IsADirectoryError ... ValueError: of the mode.
        """
        how = Mode(mode, buffering, encoding, errors, newline)
        opened: list[Opened] = []

        async def work() -> None:
            opened.append(await self._drone.open_raw(path, how.plain))

        try:
            self._loop.call(work)
        except BaseException:  # Ctrl-C may come after it was opened
            for one in opened:
                self._loop.post(one.abandon)
            raise
        return python_file(opened[0], self._loop, how, owner=self)

    def read_bytes(self, path: PathLike) -> bytes:
        """Return a file's content."""
        return self._loop.call(self._drone.read_bytes, path)

    def write_bytes(self, path: PathLike, data: bytes) -> None:
        """Make a file or replace its content; back when it is on the card, checked."""
        self._loop.call(self._drone.write_bytes, path, data)

    def read_text(self, path: PathLike, encoding: str = "utf-8") -> str:
        """Return a file's content as text, each end of a line as `\\n`."""
        return self._loop.call(self._drone.read_text, path, encoding)

    def write_text(self, path: PathLike, text: str, encoding: str = "utf-8") -> None:
        """Make a file or replace its content by a text."""
        self._loop.call(self._drone.write_text, path, text, encoding)

    # --- many files

    def get(
        self,
        path: PathLike,
        local: str | os.PathLike[str] = ".",
        *,
        recursive: bool = False,
        verify: Verify = "auto",
    ) -> list[Path]:
        """Fetch a file, or with `recursive` a directory, proven; return the local files."""
        return self._loop.call(partial(self._drone.get, path, local, recursive=recursive, verify=verify))

    def put(self, local: str | os.PathLike[str], path: PathLike, *, recursive: bool = False) -> list[str]:
        """Put a file, or with `recursive` a directory, on the vehicle; return the paths that are there."""
        return self._loop.call(partial(self._drone.put, local, path, recursive=recursive))

    def sync(
        self,
        local: str | os.PathLike[str],
        *,
        place: PathLike | None = None,
        newest: int | None = None,
        since: float | None = None,
        verify: Verify = "auto",
    ) -> list[Path]:
        """Bring the vehicle's logs as `mavftpfs sync` does, and return those that are new here."""
        call = partial(self._drone.sync, local, place=place, newest=newest, since=since, verify=verify)
        return self._loop.call(call)
