"""One version of a remote file, and how its bytes come from the vehicle. Layer: cache.

A version is a file as it was when it was opened: its size, and its time where listings tell it. Handles of
one version share its blocks and its remote reader. When the file turns out to have become another one the
version is `dead`: its handles get FileChanged, and later opens start a new version. If that was somebody
else's doing it is `lost`, too: who has it open is not to be given what has its path now, whoever wrote that.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import trio

from mavftpfs.cache.blocks import FileBlocks, Gaps
from mavftpfs.cache.kept import Kept
from mavftpfs.cache.pathlocks import PathLocks
from mavftpfs.cache.readahead import Plan
from mavftpfs.cache.remote import Reader, RemoteStore
from mavftpfs.cache.singleflight import SingleFlight
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    DataUnproven,
    FileChanged,
    FtpNak,
    LocalProtocolError,
    MavftpfsError,
)
from mavftpfs.shared.model import DirEntry

MAX_TRIES = 8
"""How often one read starts anew because its bytes were dropped, or the file got another name, meanwhile."""

MAX_DROPS = 4
FIRST_PAUSE = 0.25
"""Bytes of one read may be dropped as doubtful so often. Before they are asked for again it waits so many
seconds, twice as long each time: another client of the vehicle may be about to leave."""


@dataclass(slots=True, eq=False)
class Version:
    """A file as it was when it was opened.

    mtime: None if not known to belong to this size. proven_at: when it was last known to be what the vehicle
    holds. handles: how many are open. shown: whether the kernel may hold pages of it and all of them are
    good. same_at: when the path was last known to be this file. restarted_at: when the vehicle restarted
    while it was open. compare_at: no listing is asked for before, only to compare. epoch: how often it began
    anew with a successor of the file, of which nothing was given out yet. dead: why it is not the path's
    file any more; lost: somebody else changed that. kept: its part on the local disk, if it may have one.
    """

    path: bytes
    mtime: int | None
    blocks: FileBlocks
    proven_at: float
    reader: Reader | None = None
    handles: int = 0
    shown: bool = False
    same_at: float = float("-inf")
    restarted_at: float = float("-inf")
    compare_at: float = float("-inf")
    epoch: int = 0
    dead: MavftpfsError | None = None
    lost: bool = False
    kept: Kept | None = None

    @property
    def size(self) -> int:
        """Size in bytes by the open reply."""
        return self.blocks.size

    @property
    def questioned_at(self) -> float:
        """When the path may have become another file: the server opened it anew, or restarted."""
        return max(self.blocks.opened_at, self.restarted_at)

    @property
    def settled(self) -> bool:
        """Whether it was known to be the same file at that time or later."""
        return self.questioned_at <= self.same_at

    @property
    def history(self) -> tuple[int, int, float]:
        """What is different if bytes that are held, but not given out yet, may be another file's."""
        return self.epoch, self.blocks.drops, self.restarted_at

    def require_alive(self) -> None:
        """Raise FileChanged if the file became another one."""
        if self.dead is not None:
            raise self.dead.with_traceback(None)

    def end(self, why: str) -> None:
        """It is not the path's file any more; who waits for its bytes hears so."""
        self.dead, self.kept = FileChanged(why), None
        self.close_reader()
        self.blocks.on_failed(self.dead)
        self.blocks.clear()

    def start_over(self, mtime: int | None, listed_at: float) -> None:
        """Nothing of it was given out: it is the file that a listing of that time shows."""
        self.epoch += 1
        self.mtime, self.kept = mtime, None
        self.same_at, self.compare_at = listed_at, float("-inf")
        self.close_reader()
        self.blocks.start_over()

    def close_reader(self) -> None:
        """Drop readahead and the remote reader."""
        reader, self.reader = self.reader, None
        if reader is not None:
            reader.drop_readahead()
            reader.close()


class Fetcher:
    """Gets bytes of versions from the vehicle.

    Attributes:
        paths: whose names are being changed by us: nothing is opened meanwhile.
        dropped: reads that ended because their bytes were in doubt again and again.
    """

    def __init__(self, store: RemoteStore, *, patience: float, on_changed: Callable[[Version], None]) -> None:
        """`patience`: seconds to wait for who changes names; `on_changed`: the file became another one."""
        self._store = store
        self._on_changed = on_changed
        self.paths = PathLocks(patience)
        self._opening: SingleFlight[Version, None] = SingleFlight()
        self.dropped = 0

    async def fetch(self, version: Version, start: int, stop: int, plan: Plan) -> bytes | memoryview:
        """Return [start, stop) of a version; `plan` is asked for beside it.

        Raises:
            FileChanged, DataUnproven, RequestTimeout; else as RemoteStore.open_reader.
        """
        blocks, drops = version.blocks, 0
        for _ in range(MAX_TRIES):
            before = blocks.drops
            data = await self._read(version, start, stop, plan)
            if data is not None:
                return data
            if blocks.drops != before:
                version.close_reader()
                drops += 1
                if drops > MAX_DROPS:
                    break
                await trio.sleep(FIRST_PAUSE * 2 ** (drops - 1))
        self.dropped += 1
        raise DataUnproven(f"bytes of {version.path!r} may be another file's, again and again")

    async def _read(self, version: Version, start: int, stop: int, plan: Plan) -> bytes | memoryview | None:
        """Return [start, stop), None if it was dropped, or the reader closed, before all of it came."""
        blocks = version.blocks
        try:
            async with blocks.held(start, stop):
                kept = version.kept
                if kept is not None and blocks.missing(start, stop):
                    await kept.fill(blocks, start, stop, lambda: version.kept is kept)
                    version.require_alive()
                if blocks.missing(start, stop):
                    reader = await self._reader(version)
                    await blocks.fill(start, stop, partial(_want, reader, plan))
                return blocks.get(start, stop)
        except FileChanged:
            self._on_changed(version)
            raise
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
            self._on_changed(version)
            raise FileChanged(f"{version.path!r} was removed from the vehicle") from nak

    async def _reader(self, version: Version) -> Reader:
        """Return the version's reader, opening it if need be; it is good until the caller awaits again.

        Raises:
            FileChanged: the file is smaller now. Else as RemoteStore.open_reader.
        """
        for _ in range(MAX_TRIES):
            version.require_alive()
            if version.reader is not None and not version.blocks.doubted:
                return version.reader
            await self._opening.run(version, partial(self._open, version))
        raise DataUnproven(f"{version.path!r} is doubted again and again")

    async def _open(self, version: Version) -> None:
        """Open a version's file, after a doubt in a new session of the server."""
        async with self.paths.steady(lambda: version.path) as path:
            version.require_alive()
            expected = None if version.blocks.doubted else version.size
            version.close_reader()
            version.blocks.begin_reading()
            reader = await self._store.open_reader(path, version.blocks, expected_size=expected)
        if version.handles == 0:
            reader.close()
            raise LocalProtocolError(f"{version.path!r} was closed while it was read")
        if reader.size < version.size:
            reader.close()
            self._on_changed(version)
            version.require_alive()
        version.reader = reader


def _want(reader: Reader, plan: Plan, gaps: Gaps) -> None:
    for start, stop in gaps:
        reader.want(start, stop, demand=True)
    if plan.start < plan.stop:
        reader.want(plan.start, plan.stop, demand=False)


def became_another(size: int, mtime: int | None, entry: DirEntry) -> bool:
    """Return whether a newer listing contradicts what is known of a file; a larger one only grew."""
    if entry.size is None or entry.size > size:
        return False
    if entry.size < size:
        return True
    return entry.mtime is not None and mtime is not None and entry.mtime != mtime
