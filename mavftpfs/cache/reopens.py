"""Whether an open file is still the same after the server's session on it was opened anew. Layer: cache.

A session is closed when nobody wants bytes for a while, or another file needs it, and by losses; in between
others may replace the file by one of the same size. So where listings tell mtimes, a listing that began
after the reopening is compared before more of the file is given out, also what came meanwhile:
- the size and mtime are those it was opened with, or it only grew: it goes on;
- nothing of it was given out yet: all is read from what is there now;
- no listing since it was opened showed the time it should have, because it had just replaced another file:
  the vehicle's CRC32 must be that of the bytes held and the rest;
- else old handles get FileChanged.
Where readers take turns, each turn is a reopening: then the comparison is put off (`openings`), but for the
read that reaches the end of the file. Without mtimes the size in the open ACK alone decides.

What was opened without a known mtime (we had changed it, or it had another size than in the last listing)
could not be told from a successor of its size: the first read has it listed, and opened anew behind that.

Any listing that shows another mtime has the open versions of that file end, too, reopened or not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

from mavftpfs.cache.dentries import Directory
from mavftpfs.cache.directories import Directories
from mavftpfs.cache.flights import Flights
from mavftpfs.cache.versions import Fetcher, Version, became_another
from mavftpfs.shared.model import DirEntry, EntryKind, join, split


class Reopens:
    """Compares versions with listings."""

    def __init__(
        self,
        fetcher: Fetcher,
        directories: Directories,
        *,
        clock: Callable[[], float],
        opened: Callable[[], Iterable[Version]],
        is_changing: Callable[[bytes], bool],
        on_changed: Callable[[Version], None],
    ) -> None:
        """`opened` tells what is open; `is_changing` whether we are changing what the vehicle has of a path,
        which says nothing of others; `on_changed` hears that a file became another."""
        self._fetcher = fetcher
        self._directories = directories
        self._clock = clock
        self._opened = opened
        self._is_changing = is_changing
        self._on_changed = on_changed
        self._comparing: Flights[Version, None] = Flights()
        directories.on_listed = self._on_listed

    def due(self, version: Version, *, now: bool) -> bool:
        """Return whether a version has to be compared before more of it is given out; `now`: if ever."""
        if not is_unsettled(version) or self._is_changing(version.path):
            return False
        return now or self._clock() >= version.blocks.openings.look_at

    def is_undated(self, version: Version) -> bool:
        """Return whether a version lacks the mtime that a listing would tell; nothing was given out yet."""
        if version.mtime is not None or version.dated or version.blocks.given:
            return False
        return self._directories.tells_times and not self._is_changing(version.path)

    async def date(self, version: Version) -> None:
        """Find out the mtime of a version of which nothing was given out, and open its file behind that.

        Raises:
            As compare.
        """
        await self._comparing.run(version, partial(self._date_once, version))
        version.require_alive()

    async def _date_once(self, version: Version) -> None:
        version.dated = True
        parent, name = split(version.path)
        directory = await self._directories.recent(parent)
        if not _dates(directory.entries.get(name), version):
            directory = await self._directories.ask(parent)
        async with self._fetcher.paths.steady(lambda: version.path) as path:
            entry = directory.entries.get(name)
            if path != join(parent, name) or self._is_changing(path) or version.blocks.given:
                version.dated = False
                return
        if entry is not None and _dates(entry, version):
            await self._start_over(version, entry)

    async def compare(self, version: Version) -> None:
        """Compare an open version with a listing that begins after its file was opened on the vehicle.

        Raises:
            FileChanged: it is another. Else as RemoteStore.list_directory and open_reader.
        """
        await self._comparing.run(version, partial(self._compare_once, version))
        version.require_alive()

    async def _compare_once(self, version: Version) -> None:
        openings, path = version.blocks.openings, version.path
        count, (parent, name) = openings.count, split(path)
        directory = await self._directories.recent(parent, began=openings.latest)
        async with self._fetcher.paths.steady(lambda: version.path) as present:
            entry = directory.entries.get(name)
            if present != path or self._is_changing(path):
                return  # who reads on has it compared under its new name
        if entry is None:
            another = directory.complete
        else:
            another = entry.kind is not EntryKind.FILE or became_another(version.size, version.mtime, entry)
        if not another:
            version.sure |= entry is not None and entry.mtime == version.mtime
            openings.on_compared(count, directory.ended_at - directory.listed_at, self._clock())
        elif entry is None or entry.size != version.size or entry.kind is not EntryKind.FILE:
            self._on_changed(version)
        elif not version.blocks.given:
            await self._start_over(version, entry)
        elif not version.sure and await self._fetcher.prove(version):
            version.mtime, version.kept = entry.mtime, None
        else:
            self._on_changed(version)

    async def _start_over(self, version: Version, entry: DirEntry) -> None:
        """Nothing was given out: the version is of the file that is there now, opened once more for that."""
        version.boot += 1  # reads under way hold bytes of the old one
        version.proven_boot += 1
        version.kept = None
        version.close_reader()
        version.blocks.start_over()
        version.mtime, version.sure = entry.mtime, False
        reader = await self._fetcher.reopen(version)
        if reader.size != version.size:
            version.mtime = None

    def _on_listed(self, path: bytes, directory: Directory) -> None:
        """A directory was listed."""
        for version in list(self._opened()):
            parent, name = split(version.path)
            entry = directory.entries.get(name) if parent == path else None
            if entry is None or version.mtime is None or directory.listed_at <= version.proven_at:
                continue
            if entry.mtime == version.mtime and entry.size == version.size:
                version.sure = True
            elif became_another(version.size, version.mtime, entry) and not self._is_changing(version.path):
                if version.blocks.given and (version.sure or entry.size != version.size):
                    self._on_changed(version)
                else:
                    version.blocks.openings.on_doubted()
                    self._fetcher.on_distrust(version)


def _dates(entry: DirEntry | None, version: Version) -> bool:
    """Return whether an entry tells the mtime of a file of that size."""
    return entry is not None and entry.size == version.size and entry.mtime is not None


def is_unsettled(version: Version) -> bool:
    """Return whether what is held of a version may be of two files, which a listing could tell."""
    return version.mtime is not None and not version.blocks.openings.settled
