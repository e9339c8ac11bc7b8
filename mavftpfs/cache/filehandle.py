"""One open() of a regular file, as it was when it was opened. Layer: cache."""

from __future__ import annotations

from typing import Protocol

from mavftpfs.cache.readahead import Pace, Readahead
from mavftpfs.cache.readonly import ReadOnlyHandle
from mavftpfs.cache.reopens import Reopens
from mavftpfs.cache.restarts import Restarts
from mavftpfs.cache.versions import MAX_RESTARTS, Fetcher, Version
from mavftpfs.shared.errors import DataUnproven, LocalProtocolError


class Shelf(Protocol):
    """What a handle asks of files.Files. piece: bytes of a read that are served at once. hits, misses: reads
    that found all they wanted in the cache, and others."""

    fetcher: Fetcher
    restarts: Restarts
    reopens: Reopens
    piece: int
    hits: int
    misses: int

    def pace(self) -> Pace: ...
    def on_read(self, version: Version) -> None: ...
    def release(self, version: Version) -> None: ...


class FileHandle(ReadOnlyHandle):
    """One open() of a regular file (see cache.openfile.OpenFile)."""

    def __init__(self, files: Shelf, version: Version, *, keep_cache: bool, direct_io: bool) -> None:
        self._files = files
        self._version = version
        self._readahead = Readahead(version.size)
        self._closed = False
        self.size = version.size
        self.keep_cache = keep_cache
        self.direct_io = direct_io

    async def read(self, offset: int, size: int, *, sure: bool = False) -> bytes | memoryview:
        """Return `size` bytes at `offset`, fewer only at the end of the opened size; sure: a comparison with
        what the vehicle has is not put off.

        Raises:
            FileChanged, DataUnproven, RequestTimeout, VehicleLost, FtpNak.
        """
        if self._closed:
            raise LocalProtocolError("read of a closed handle")
        stop = min(offset + size, self.size)
        if offset >= stop:
            return b""
        version, reopens = self._version, self._files.reopens
        for _ in range(MAX_RESTARTS):
            await self._files.restarts.recheck(version)
            if reopens.is_undated(version):
                await reopens.date(version)
            boot = version.boot
            data = await self._read_range(offset, stop)
            if boot != version.boot or version.recheck:
                continue
            if not reopens.due(version, now=sure or stop == self.size):
                version.blocks.on_given(offset, stop)
                return data
            await reopens.compare(version)
        raise DataUnproven(f"{version.path!r} is opened anew again and again while it is read")

    async def require_same(self) -> None:
        """Compare what was read of the file with what is there, if that is in doubt.

        Raises:
            FileChanged: it became another one. Else as Restarts.recheck and Reopens.compare.
        """
        await self._files.restarts.recheck(self._version)
        if self._files.reopens.due(self._version, now=True):
            await self._files.reopens.compare(self._version)

    @property
    def mtime(self) -> int | None:
        """The file's mtime, if a listing told it since it was opened on the vehicle."""
        return self._version.mtime if self._version.sure else None

    @property
    def comparable(self) -> bool:
        """Whether bytes of it were given out, and a listing can tell whether they are of another file."""
        return self._version.mtime is not None and self._version.blocks.given

    @property
    def lost(self) -> bool:
        """Whether the file became another one by somebody else's doing."""
        return self._version.lost

    def require_not_lost(self) -> None:
        """Raise FileChanged if the file became another one by somebody else's doing."""
        if self._version.lost:
            self._version.require_alive()

    async def _read_range(self, offset: int, stop: int) -> bytes | memoryview:
        if stop - offset <= self._files.piece:
            return await self._read_piece(offset, stop)
        step = self._files.piece
        pieces = [await self._read_piece(at, min(at + step, stop)) for at in range(offset, stop, step)]
        return b"".join(pieces)

    def close(self) -> None:
        """Release the handle."""
        if not self._closed:
            self._closed = True
            self._files.release(self._version)

    async def _read_piece(self, start: int, stop: int) -> bytes | memoryview:
        files, version = self._files, self._version
        files.on_read(version)
        pace = files.pace()
        plan = self._readahead.on_read(start, stop, limit=pace.limit, small=pace.small)
        if plan.seeked and version.reader is not None:
            version.reader.drop_readahead()
        data = version.blocks.get(start, stop)
        if data is None:
            files.misses += 1
            return await files.fetcher.fetch(version, start, stop, plan)
        files.hits += 1
        if version.reader is not None and plan.start < plan.stop:
            version.reader.want(plan.start, plan.stop, demand=False)
        return data
