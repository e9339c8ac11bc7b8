"""Open regular files: close-to-open consistency over cached blocks. Layer: cache.

At open it is decided whether the version in the cache is still the vehicle's file:
- It is if a fresh listing shows its size and mtime.
- It is if that was proven (by an open reply or a listing) less than `dir_timeout` ago, and no later listing
  contradicts. Then the vehicle is not asked.
- Else the file is opened on the vehicle, and a new version starts with the size in the reply: equal sizes
  without an mtime prove nothing.

While a program has a file open, its session is closed and opened again: after losses, restarts, and turns of
other users. Then size and mtime are compared (`Files.require_same`). A file that is equal, or larger, is the
same, because logs grow. For another file readers get FileChanged. The open reply tells the size. Where
listings tell mtimes, a listing that began after the reopening tells the mtime. After a restart of the vehicle
nothing is proven.

The kernel has one page cache for all handles of a path, so a new version bypasses it (direct_io) while
handles of an older one are open.
"""

from __future__ import annotations

import errno
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import trio

from mavftpfs.cache.directories import COST_FACTOR, Directories, Directory, Found
from mavftpfs.cache.nodes import Nodes
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.pathlocks import PathLocks
from mavftpfs.cache.readahead import Readahead
from mavftpfs.cache.remote import RemoteStore
from mavftpfs.cache.singleflight import SingleFlight
from mavftpfs.cache.versions import NEVER, BlockCache, Version
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    DataUnproven,
    FileChanged,
    FtpNak,
    IsADirectory,
    LocalProtocolError,
    NotADirectory,
    NotFound,
)
from mavftpfs.shared.model import DirEntry, EntryKind, split
from mavftpfs.shared.sameness import Listed, Opened, Sameness, compare

MAX_CLOSED = 4096
"""How many closed files are remembered, with their blocks."""

READING = 3.0
"""Seconds for which a file of which bytes came counts as being read."""

PAUSES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Seconds that a read waits before it tries again after its bytes were dropped in doubt. Together they are
longer than it takes to notice that another client used our session."""

COMPARE_PAUSE = 2.0
"""Seconds between two listings that only compare one file, or 50 times what the last one took if that is
more. A read that reaches the end of the file does not wait for that."""


class Files:
    """All regular files that are open or cached. Paths are the vehicle's.

    Attributes:
        open_versions: those with open handles.
        reopening: the versions that are given a reader now, see `open_reader`.
    """

    def __init__(
        self,
        store: RemoteStore,
        cache: BlockCache,
        *,
        proof_time: float,
        directories: Directories,
        nodes: Nodes,
        invalidate: Callable[[bytes], None],
    ) -> None:
        """`invalidate(path)`: the kernel's copies of a file are wrong.

        `proof_time`: seconds for which a proof that a version is the vehicle's file holds.
        """
        self._nodes = nodes
        self._store = store
        self.cache = cache
        self._clock = cache.clock
        self._proof_time = proof_time
        self._directories = directories
        self._invalidate = invalidate
        self.paths = PathLocks(cache.patience)
        self._newest: OrderedDict[bytes, Version] = OrderedDict()  # by path
        self.open_versions: dict[Version, None] = {}
        self._opening: SingleFlight[bytes, tuple[Version, bool]] = SingleFlight()
        self.reopening: SingleFlight[Version, None] = SingleFlight()

    # --- opening

    async def open(self, path: bytes) -> VersionHandle:
        """Open the vehicle's file of a path.

        Raises:
            NotFound, NotADirectory, IsADirectory. DataUnproven: the size in the reply is smaller than listed.
            Else as RemoteStore.open_reader.
        """
        found = await self._directories.find(path)
        if found.entry.kind is not EntryKind.FILE:
            raise IsADirectory(f"{path!r} is a directory")
        version, same = await self._opening.run(path, partial(self._open_version, path, found))
        keep_cache, direct_io = same and version.in_kernel, False
        for other in self.open_versions:
            direct_io |= other.path == path and other is not version
        # Else the kernel may fetch pages for programs that read an older version.
        version.in_kernel = not direct_io
        version.handles += 1
        self.open_versions[version] = None
        return VersionHandle(self, version, keep_cache=keep_cache, direct_io=direct_io)

    async def _open_version(self, path: bytes, found: Found) -> tuple[Version, bool]:
        """Return the version to serve, and whether it was served before."""
        fresh = self._clock() < found.directory.fresh_until
        version = self._newest.get(path)
        if version is not None and self._may_serve(version, found, fresh):
            self._newest.move_to_end(path)
            return version, True
        return await self._start_version(path, found.entry), False

    def _version(self, path: bytes, size: int = 0, mtime: int | None = None) -> Version:
        return Version(self.cache, path, size, mtime, on_doubt=self._on_doubt)

    def _may_serve(self, version: Version, found: Found, fresh: bool) -> bool:
        """Return whether a version is proven to be the vehicle's file now. If a listing shows another one,
        the version is killed."""
        listed_at = found.directory.listed_at
        answer = compare(replace(version.known, at_open=True), Listed(found.entry))
        if answer is Sameness.OTHER and listed_at > version.proven_at:
            self.kill(version)
        if version.replaced or found.size != version.size:
            return False
        if fresh and answer is Sameness.SAME:
            version.prove(listed_at)
            return True
        return self._clock() - version.proven_at < self._proof_time

    async def _start_version(self, path: bytes, entry: DirEntry) -> Version:
        self._directories.require_heard()
        version = self._version(path)
        reader = await self._store.open_reader(path, version)
        try:
            if reader.size < entry.size and not self._nodes.is_changing(path):
                entry = await self._require_listed(path, reader.size)
        except BaseException:
            reader.close()
            raise
        version.reader, version.size = reader, reader.size
        version.prove(self._clock())
        if entry.size == reader.size:
            version.mtime = entry.mtime
        old = self._newest.get(path)
        if old is not None and compare(old.known, Opened(reader.size)) is Sameness.OTHER:
            self.kill(old)
        self._set_newest(version)
        if entry.size != reader.size:  # what the kernel was told is wrong
            self._directories.learn_size(path, reader.size)
            self._invalidate(path)
        return version

    async def _require_listed(self, path: bytes, size: int) -> DirEntry:
        """Return what a new listing shows of a file, if it agrees with the size in an open reply.

        A size that is too small would make a copy too short, without an error.

        Raises:
            DataUnproven: it shows another size. NotFound; else as RemoteStore.list_directory.
        """
        entry = await self._directories.ask_entry(path)
        if entry is None:
            raise NotFound(f"{path!r} does not exist any more")
        if entry.size != size:
            raise DataUnproven(f"{path!r} has {entry.size} bytes as listed, and {size} as opened")
        return entry

    async def open_reader(self, version: Version) -> None:
        """Give a version a reader; run by `reopening`, once for all handles.

        The file is opened when bytes are wanted. Only after a doubt it is opened now, and its size compared.

        Raises:
            FileChanged: it is smaller now. Else as RemoteStore.open_reader.
        """
        async with self.paths.steady(version) as path:
            version.require_not_replaced()
            expected = None if version.ignores_data else version.size
            version.close_reader()
            version.ignores_data = False
            reader = await self._store.open_reader(path, version, expected_size=expected)
        if version.handles == 0:
            reader.close()
            raise LocalProtocolError(f"{version.path!r} was closed while it was read")
        if compare(version.known, Opened(reader.size)) is Sameness.OTHER:
            reader.close()
            self.kill(version)
            version.require_not_replaced()
        version.reader = reader

    def _set_newest(self, version: Version) -> None:
        old = self._newest.pop(version.path, None)
        if old is not None and not old.handles:
            old.clear()
        self._newest[version.path] = version
        if len(self._newest) > MAX_CLOSED:
            surplus = next((v for v in self._newest.values() if not v.handles and v is not version), None)
            if surplus is not None:
                self._forget(surplus)

    def status(self) -> dict[str, object]:
        """Return counters; `reads`: the files that are being fetched, with path, size and done in bytes."""
        recent = self._clock() - READING
        reads = [
            {"path": v.path.decode(errors="replace"), "size": v.size, "done": v.progress}
            for v in self.open_versions
            if v.waited_for or (v.received_at > recent and v.progress < v.size)
        ]
        return {"reads": reads}

    # --- is it the same file?

    async def require_same(self, version: Version, *, skip_pause: bool) -> None:
        """Check that the path still has this version. A listing is asked for only if it can tell more.

        skip_pause: do not wait for the pause between two listings that only compare.

        Raises:
            FileChanged: another file has the path. Else as RemoteStore.list_directory.
        """
        soon = not skip_pause and self._clock() < version.compare_after
        if not (soon or self._is_sure(version) or self._nodes.is_changing(version.path)):
            await self._ask_and_compare(version)
        version.require_not_replaced()

    def _is_sure(self, version: Version) -> bool:
        """Return whether a listing would tell nothing more of a version. It is CURRENT. Or no times are told,
        the vehicle did not restart, and so the open reply was enough: the file did not become smaller."""
        timed = self._directories.tells_times or version.mtime is not None
        return version.current or not (timed or version.known.restarted)

    async def _ask_and_compare(self, version: Version) -> None:
        """Compare a version with a listing that began after its file was opened on the vehicle."""
        path = version.path
        try:
            directory = await self._directories.ask(split(path)[0], not_before=version.opened_at)
        except (NotFound, NotADirectory):
            self.kill(version)
            return
        async with self.paths.steady(version) as present:
            if present != path or self._nodes.is_changing(path):
                return  # it is compared under its new name, by the next read
        took = directory.ended_at - directory.listed_at
        version.compare_after = self._clock() + max(COMPARE_PAUSE, COST_FACTOR * took)
        self._compare_with(version, directory)

    def _compare_with(self, version: Version, directory: Directory) -> None:
        """Compare a version with a listing that began after its last proof."""
        entry = directory.entries.get(split(version.path)[1])
        answer = compare(version.known, Listed(entry, directory.complete))
        if answer is Sameness.OTHER:
            self.kill(version)
        elif entry is None:
            return  # the listing is incomplete, and does not tell
        else:
            if version.opened_at <= directory.listed_at and not version.current:
                version.prove(directory.listed_at)
            if version.mtime is None and entry.size == version.size:
                version.mtime = entry.mtime

    def on_listed(self, path: bytes, directory: Directory) -> None:
        """Compare the open versions of a directory with a new listing that began after their last proof."""
        for version in list(self.open_versions):
            parent, name = split(version.path)
            known = parent == path and name in directory.entries and not version.replaced
            if (
                known
                and directory.listed_at > version.proven_at
                and not self._nodes.is_changing(version.path)
            ):
                self._compare_with(version, directory)

    def kill(self, version: Version) -> None:
        """Make a version REPLACED. If it is the newest of its path, the older ones that are open are, too."""
        path = version.path
        newest = self._newest.get(path) in (version, None)
        older = [v for v in self.open_versions if newest and v.path == path]
        for one in dict.fromkeys((version, *older)):
            if not one.replaced:
                one.mark_replaced(f"{path!r} changed on the vehicle after it was opened")
                self._invalidate(path)
        if newest and not self._nodes.is_changing(path):
            self.on_replaced(path)

    def on_replaced(self, path: bytes) -> None:
        """Note that another file has the path now, or may have: others replaced it, or it is not known what
        a change of ours did."""
        if self._nodes.on_replaced(path):
            self.forget_pages(path)

    def forget_pages(self, path: bytes) -> None:
        """Drop the kernel's pages of a path: they may be of a file that had it before."""
        newest = self._newest.get(path)
        if newest is not None:
            newest.in_kernel = False
        self._invalidate(path)

    def _on_doubt(self, version: Version) -> None:
        """Drop the kernel's pages of a version whose bytes were dropped."""
        version.in_kernel = False
        newest = self._newest.get(version.path) is version
        if newest or version in self.open_versions:
            self._invalidate(version.path)
        if newest and not version.handles:
            self._forget(version)  # opening it again costs less than comparing it with a listing

    def rebooted(self) -> None:
        """Forget all proofs. Open files are compared before more of their bytes are given out."""
        now = self._clock()
        for version in dict.fromkeys((*self._newest.values(), *self.open_versions)):
            version.on_restart(now)

    # --- we changed the file ourselves

    def kill_all(self, path: bytes) -> None:
        """Make all open versions of a path REPLACED: their handles must not read what we are about to write
        there."""
        for version in [v for v in self.open_versions if v.path == path and not v.replaced]:
            self.kill(version)

    def close_readers(self, path: bytes) -> None:
        """Close what is open on the vehicle of a path that the caller holds alone, and is about to change in
        several steps. Reads that wait open it again after that."""
        for version in self._at_or_below(path):
            version.close_reader()
            version.ask_again()

    def on_changed(self, path: bytes) -> None:
        """Note that we wrote or removed the file of a path and those below it, or may have. Handles of
        the old file open the path again."""
        for version in self._at_or_below(path):
            if self._newest.get(version.path) is version:
                del self._newest[version.path]
            version.mark_replaced(f"{version.path!r} was changed here")
        for node in self._nodes.below(path):
            node.close_base()

    def on_renamed(self, old: bytes, new: bytes) -> None:
        """Note that a file, or a directory with all below it, has another path now; open files follow."""
        self.on_changed(new)
        for version in self._at_or_below(old):
            newest = self._newest.get(version.path) is version
            if newest:
                del self._newest[version.path]
            version.close_reader()
            version.path = new + version.path[len(old) :]
            version.ask_again()
            if newest:
                self._newest[version.path] = version

    def _at_or_below(self, path: bytes) -> list[Version]:
        """Return the versions, older ones too, of a path and of all paths below it."""
        found, below = [], path + b"/"
        for version in dict.fromkeys((*self._newest.values(), *self.open_versions)):
            if version.path == path or version.path.startswith(below):
                found.append(version)
        return found

    # --- closing

    def release(self, version: Version) -> None:
        """A handle of the version was closed."""
        version.handles -= 1
        if version.handles:
            return
        del self.open_versions[version]
        version.close_reader()
        version.on_failed(LocalProtocolError(f"{version.path!r} was closed while it was read"))
        if self._newest.get(version.path) is not version:
            version.clear()
        elif version.replaced or version.proven_at == NEVER:
            self._forget(version)

    def forget_closed(self) -> None:
        """Drop everything that is not open."""
        for version in list(self._newest.values()):
            if not version.handles:
                self._forget(version)

    def _forget(self, version: Version) -> None:
        version.clear()
        del self._newest[version.path]


class VersionHandle(OpenFile):
    """One open() of a regular file."""

    size = 0
    direct_io = keep_cache = False

    def __init__(self, files: Files, version: Version, *, keep_cache: bool, direct_io: bool) -> None:
        self._files = files
        self._version = version
        self._readahead = Readahead(version.size)
        self._closed = False
        self.size = version.size
        self.keep_cache = keep_cache
        self.direct_io = direct_io

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return `size` bytes at `offset`, fewer only at the end of the opened size.

        Raises:
            FileChanged, DataUnproven, RequestTimeout, VehicleLost, FtpNak.
        """
        if self._closed:
            raise LocalProtocolError("read of a closed handle")
        stop = min(offset + size, self.size)
        if offset >= stop:
            return b""
        files, version = self._files, self._version
        for pause in (*PAUSES, 0.0):
            version.require_not_replaced()
            doubts = version.doubts
            pieces: list[bytes | memoryview] = []
            for start in range(offset, stop, files.cache.piece):
                piece = await self._read_piece(start, min(start + files.cache.piece, stop))
                if piece is None:  # some of it was dropped meanwhile, or the file got another name
                    break
                pieces.append(piece)
            else:
                await files.require_same(version, skip_pause=stop == self.size)
                if version.doubts == doubts:
                    return pieces[0] if len(pieces) == 1 else b"".join(pieces)
            if version.doubts != doubts:
                if version.ignores_data:  # else another read opened the file anew, and waits for its bytes
                    version.close_reader()
                await trio.sleep(pause)
        raise DataUnproven(f"bytes of {version.path!r} may be another file's, again and again")

    def close(self) -> None:
        """Release the handle."""
        if not self._closed:
            self._closed = True
            self._files.release(self._version)

    async def _read_piece(self, start: int, stop: int) -> bytes | memoryview | None:
        """Return [start, stop), at most a piece. None: it was renamed, or bytes were dropped, meanwhile."""
        files, version = self._files, self._version
        limit, small = files.cache.readahead_limits(len(files.open_versions))
        ahead = self._readahead.on_read(start, stop, limit=limit, small=small)
        if ahead.seeked and version.reader is not None:
            version.reader.drop(demand=False)
        data = version.get(start, stop)
        if data is not None:
            if version.reader is not None and ahead.start < ahead.stop:
                version.reader.want(ahead.start, ahead.stop, demand=False)
            return data
        try:
            async with files.cache.reads:
                if version.missing(start, stop):
                    if version.reader is None or version.ignores_data:
                        await files.reopening.run(version, partial(files.open_reader, version))
                    if version.reader is None or version.ignores_data:
                        return None
                    version.reader.want(start, stop, demand=True)
                    if ahead.start < ahead.stop:
                        version.reader.want(ahead.start, ahead.stop, demand=False)
                    await version.wait_for(start, stop)
                return version.get(start, stop)
        except (FileChanged, FtpNak) as error:
            if not isinstance(error, FileChanged) and errno_for(error) != errno.ENOENT:
                raise
            files.kill(version)
            version.require_not_replaced()
            raise
