"""The remote tree as the FUSE layer sees it. Layer: cache."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.remote import RemoteStore
from mavftpfs.shared.model import EntryKind


@dataclass(frozen=True, slots=True)
class Stat:
    """What is known of one path.

    size: bytes, 0 <= size < 2**63. mtime: seconds UTC, never unknown. valid_for: seconds the kernel
    may keep these attributes; 0 means ask again.
    """

    kind: EntryKind
    size: int
    mtime: int
    valid_for: float


class OpenFile(Protocol):
    """One open() of a file.

    size: bytes, fixed for the life of the handle. direct_io: the kernel must not cache its pages.
    keep_cache: pages the kernel holds from the last open are still right.
    """

    @property
    def size(self) -> int: ...

    @property
    def direct_io(self) -> bool: ...

    @property
    def keep_cache(self) -> bool: ...

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return `size` bytes at `offset`, fewer only at the end of the handle's size.

        Raises:
            FileChanged, DataUnproven, RequestTimeout, VehicleLost, FtpNak.
        """
        ...

    def close(self) -> None:
        """Release the handle; the last one of a file drops its readahead. Closing twice is harmless."""
        ...


class Tree:
    """The vehicle's files below `options.root`, which is `/` in every path given and called back."""

    def __init__(
        self,
        store: RemoteStore,
        options: CacheOptions,
        *,
        clock: Callable[[], float],
        invalidate: Callable[[bytes], None],
    ) -> None:
        self._store = store
        self._options = options
        self._clock = clock
        self._invalidate = invalidate

    async def stat(self, path: bytes) -> Stat:
        """Return a path's attributes.

        Raises:
            NotFound, NotADirectory; else as RemoteStore.list_directory.
        """
        raise NotImplementedError

    def negative_valid_for(self, path: bytes) -> float:
        """Return for how many seconds the kernel may remember that stat(path) raised NotFound."""
        raise NotImplementedError

    async def list(self, path: bytes) -> list[tuple[bytes, Stat]]:
        """Return a directory's entries without `.` and `..`.

        Raises:
            NotFound, NotADirectory; else as RemoteStore.list_directory.
        """
        raise NotImplementedError

    async def open(self, path: bytes) -> OpenFile:
        """Open a file for reading.

        Raises:
            NotFound, NotADirectory, IsADirectory; else as RemoteStore.open_reader and read_whole.
        """
        raise NotImplementedError

    async def crc32(self, path: bytes) -> int:
        """Return the vehicle's CRC32 of a file, remembered by size and mtime.

        Raises:
            NotFound, NotADirectory, IsADirectory, Armed; else as RemoteStore.crc32.
        """
        raise NotImplementedError

    def forget_caches(self) -> None:
        """Drop everything that is not in use by an open file."""
        raise NotImplementedError

    def status(self) -> dict[str, object]:
        """Return counters: hits, misses, bytes_cached, listings_cached, open_files, ..."""
        raise NotImplementedError

    def link_lost(self) -> None:
        """Heartbeats stopped: expired listings are served until link_back."""
        raise NotImplementedError

    def link_back(self) -> None:
        """Heartbeats are back."""
        raise NotImplementedError

    def rebooted(self) -> None:
        """The vehicle restarted: what was known of it must be asked again."""
        raise NotImplementedError
