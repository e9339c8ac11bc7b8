"""A vehicle's files for fsspec: `fsspec.filesystem("mftp", source=SOURCE)`. Layer: api.

fsspec keeps instances for good, one for each thread. So all instances share one connection to each vehicle.
The first call makes the connection, and idle connections are closed.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from typing import Any

from fsspec import AbstractFileSystem

from mavftpfs.api.drone import Drone, Entry, UsageError, connect
from mavftpfs.api.pythonfile import READ_BUFFER
from mavftpfs.protocol.url import is_url, parse_url

IDLE = 60.0
"""Seconds without a call or an open file after which a connection is closed."""


class _Connection:
    """A connection that several file systems share."""

    def __init__(self, source: str, idle: float, options: dict[str, Any]) -> None:
        self._connect = partial(connect, source, **options)
        self._idle = idle
        self._lock = threading.Lock()
        self._drone: Drone | None = None
        self._users = 0
        self._timer: threading.Timer | None = None

    @contextmanager
    def used(self) -> Iterator[Drone]:
        """Give the body the connected drone."""
        with self._lock:
            if self._drone is None or self._drone.closed:
                self._drone = self._connect()
            self._users += 1
        try:
            yield self._drone
        finally:
            with self._lock:
                self._users -= 1
                self._close_later()

    @property
    def open(self) -> bool:
        """Whether there is a connection now."""
        return self._drone is not None

    def _close_later(self) -> None:
        self._call_off()
        self._timer = threading.Timer(self._idle, self.close)
        self._timer.daemon = True
        self._timer.start()

    def _call_off(self) -> None:
        """Stop the thread that waits to close the connection. Otherwise each call, and each closed
        connection, would leave a thread."""
        if self._timer is not None:
            self._timer.cancel()

    def close(self) -> None:
        """Close the connection, unless a call uses it."""
        with self._lock:
            if self._drone is None or self._users:
                return
            if self._drone.has_open_files:
                self._close_later()
                return
            self._call_off()
            self._drone.close()
            self._drone = None


_connections: dict[object, _Connection] = {}
_making = threading.Lock()


def _connection(source: str, idle: float, options: dict[str, Any]) -> _Connection:
    """Return this process's connection to a source with these options."""
    key = (os.getpid(), source, idle, repr(sorted(options.items())))
    with _making:
        return _connections.setdefault(key, _Connection(source, idle, options))


class DroneFileSystem(AbstractFileSystem):  # type: ignore[misc]
    """The file system of a vehicle.

    Arguments: source, use_mount and options are those of `mavftpfs.connect`. auto_mkdir: writing a file also
    makes its missing directories. idle: seconds after which an unused connection is closed. The connection
    caches listings and data, as a mount does; changes by others become visible after `invalidate_cache`, or
    after dir_timeout (20 s).

    Paths may be `mftp://` URLs: `mftp://[comp=ID:]path`.
    """

    protocol = "mftp"
    root_marker = "/"
    blocksize = 1 << 20

    def __init__(
        self, source: str = "", auto_mkdir: bool = False, idle: float = IDLE, **options: Any
    ) -> None:
        if not source:
            raise UsageError("which vehicle? Give its SOURCE, such as source='udpin:0.0.0.0:14550'")
        own = {name: options.pop(name) for name in list(options) if name in _FSSPEC_OPTIONS}
        super().__init__(**own)
        self.source = source
        self.auto_mkdir = auto_mkdir
        self._connection = _connection(source, idle, options)

    @classmethod
    def _strip_protocol(cls, path: Any) -> Any:
        if isinstance(path, list):
            return [cls._strip_protocol(one) for one in path]
        text = os.fspath(path)
        if is_url(text):
            return os.fsdecode(parse_url(text).path)
        return "/" + text.strip("/")

    @staticmethod
    def _get_kwargs_from_urls(path: str) -> dict[str, Any]:
        component = parse_url(path).component if is_url(path) else None
        return {} if component is None else {"target_component": component}

    @property
    def fsid(self) -> str:
        """The vehicle's SOURCE."""
        return f"mftp {self.source}"

    # --- looking

    def ls(self, path: str, detail: bool = True, **kwargs: Any) -> list[Any]:
        """List a directory, or one file."""
        path = self._strip_protocol(path)
        with self._connection.used() as drone:
            try:
                found = list(drone.scandir(path))
            except NotADirectoryError:
                found = [drone.stat(path)]
        return [_info(entry) if detail else entry.path for entry in found]

    def info(self, path: str, **kwargs: Any) -> dict[str, Any]:
        """Return the facts of a path."""
        with self._connection.used() as drone:
            return _info(drone.stat(self._strip_protocol(path)))

    def exists(self, path: str, **kwargs: Any) -> bool:
        """Return whether the path exists; raise every error that leaves the answer open."""
        with self._connection.used() as drone:
            return drone.exists(self._strip_protocol(path))

    def isdir(self, path: str) -> bool:
        """Return whether the path is a directory."""
        with self._connection.used() as drone:
            return drone.is_dir(self._strip_protocol(path))

    def isfile(self, path: str) -> bool:
        """Return whether the path is a file."""
        with self._connection.used() as drone:
            return drone.is_file(self._strip_protocol(path))

    def walk(
        self,
        path: str,
        maxdepth: int | None = None,
        topdown: bool = True,
        on_error: Any = None,
        **kwargs: Any,
    ) -> Any:
        """As fsspec's, except that a directory that cannot be listed is an error."""
        return super().walk(path, maxdepth, topdown, on_error=on_error or _unless_missing, **kwargs)

    def modified(self, path: str) -> datetime:
        """Return the time of a file's last change.

        Raises:
            OSError: the vehicle reports no times.
        """
        with self._connection.used() as drone:
            mtime = drone.stat(self._strip_protocol(path)).mtime
        if mtime is None:
            raise OSError(f"{path}: the vehicle does not report when it was changed")
        return datetime.fromtimestamp(mtime, UTC)

    def checksum(self, path: str) -> int:
        """Have the vehicle compute a file's CRC32."""
        with self._connection.used() as drone:
            return drone.crc32(self._strip_protocol(path))

    def close(self) -> None:
        """Close the connection now, if no call uses it."""
        self._connection.close()

    def invalidate_cache(self, path: str | None = None) -> None:
        """Drop the cached listings and data."""
        super().invalidate_cache(path)
        if self._connection.open:
            with self._connection.used() as drone:
                drone.refresh()

    # --- changing

    def mkdir(self, path: str, create_parents: bool = True, **kwargs: Any) -> None:
        """Make a directory."""
        with self._connection.used() as drone:
            drone.mkdir(self._strip_protocol(path), parents=create_parents)

    def makedirs(self, path: str, exist_ok: bool = False) -> None:
        """Make a directory and those above it."""
        with self._connection.used() as drone:
            drone.mkdir(self._strip_protocol(path), parents=True, exist_ok=exist_ok)

    def rmdir(self, path: str) -> None:
        """Remove an empty directory."""
        with self._connection.used() as drone:
            drone.rmdir(self._strip_protocol(path))

    def _rm(self, path: str) -> None:
        path = self._strip_protocol(path)
        with self._connection.used() as drone:
            if drone.is_dir(path):
                drone.rmdir(path)
            else:
                drone.remove(path)

    def mv(
        self, path1: str, path2: str, recursive: bool = False, maxdepth: int | None = None, **kwargs: Any
    ) -> None:
        """Rename on the vehicle, or move into `path2` if that is a directory."""
        old, new = self._strip_protocol(path1), self._strip_protocol(path2)
        with self._connection.used() as drone:
            if drone.is_dir(new):
                new = f"{new}/{old.rpartition('/')[2]}"
            if old != new:
                drone.rename(old, new)

    def cp_file(self, path1: str, path2: str, **kwargs: Any) -> None:
        """Copy a file through this computer; of a directory only make a new one."""
        old, new = self._strip_protocol(path1), self._strip_protocol(path2)
        with self._connection.used() as drone:
            if drone.is_dir(old):
                drone.mkdir(new, parents=True, exist_ok=True)
            else:
                drone.mkdir(self._parent(new), parents=True, exist_ok=True)
                drone.copy(old, new)

    # --- files

    def open(self, path: str, mode: str = "rb", block_size: int | None = None, **kwargs: Any) -> Any:
        """As fsspec's; text is UTF-8 unless `encoding` says otherwise."""
        if "b" in mode or kwargs.get("compression") is not None or self._intrans:
            return super().open(path, mode, block_size, **kwargs)
        text = {name: kwargs.get(name) for name in ("encoding", "errors", "newline")}
        return self._opened(self._strip_protocol(path), mode, block_size or -1, **text)

    def _open(
        self, path: str, mode: str = "rb", block_size: Any = None, autocommit: bool = True, **kwargs: Any
    ) -> Any:
        if not autocommit and "r" not in mode:
            raise NotImplementedError(
                "a vehicle has no transactions: close() puts each whole file in place; "
                "write without fs.transaction"
            )
        size = block_size if isinstance(block_size, int) and block_size > 1 else READ_BUFFER
        file = self._opened(path, mode, size)
        if "r" in mode:
            file.size = file.raw.size
        return file

    def _opened(self, path: str, mode: str, *args: Any, **text: Any) -> Any:
        with self._connection.used() as drone:
            if self.auto_mkdir and "r" not in mode:
                drone.mkdir(self._parent(path), parents=True, exist_ok=True)
            return drone.open(path, mode, *args, **text)


_FSSPEC_OPTIONS = {
    *("use_listings_cache", "listings_expiry_time", "max_paths", "skip_instance_cache"),
    *("asynchronous", "loop", "batch_size", "add_docs", "add_aliases"),
}
"""Options of every fsspec file system, which a connection does not take."""


def _info(entry: Entry) -> dict[str, Any]:
    kind = "directory" if entry.is_dir() else "file"
    return {"name": entry.path, "size": entry.size, "type": kind, "mtime": entry.mtime}


def _unless_missing(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError | NotADirectoryError):
        raise error
