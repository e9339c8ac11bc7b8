"""Asks the vehicle for listings and answers from remembered ones. Layer: cache.

Only a path that its parent's listing shows as a directory is listed: listing a file ends a MAVSDK server
(servers.md 6), so a path is walked from the root. A walk costs nothing where listings are fresh.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial

import trio

from mavftpfs.cache.dentries import Dentries, Directory
from mavftpfs.cache.remote import RemoteStore
from mavftpfs.cache.singleflight import SingleFlight
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import FtpNak, NotADirectory, NotFound, PathTooLong, VehicleLost
from mavftpfs.shared.model import ROOT, DirEntry, EntryKind, Listing, join, split

log = logging.getLogger("mavftpfs.cache")

DOT = b"."
"""The working directory of a server that runs as a process (ArduPilot SITL)."""

LOG_ALIAS = b"/@MAV_LOG"
"""The standard's only alias: the directory of logs, which are real files."""

MAX_DEPTH = 256
"""More components than any path that fits a request has."""

SWEEP_TRIES = 3
"""How often a listing is repeated because names came or went meanwhile through us."""


@dataclass(frozen=True, slots=True)
class Found:
    """A directory entry and the listing that shows it."""

    entry: DirEntry
    directory: Directory

    @property
    def size(self) -> int | None:
        """Best known size in bytes."""
        return self.directory.size_of(self.entry.name)


class Directories:
    """Listings of the vehicle's directories. All paths are the vehicle's, normalised.

    Attributes:
        tells_times: whether any listing told an mtime.
    """

    def __init__(
        self,
        store: RemoteStore,
        dentries: Dentries,
        root: bytes,
        *,
        clock: Callable[[], float],
        nursery: trio.Nursery | None = None,
        ask_size: Callable[[bytes], Awaitable[int]],
    ) -> None:
        """`ask_size` opens a file and returns its size."""
        self.ask_size = ask_size
        self._store = store
        self._dentries = dentries
        self._root = root
        self._clock = clock
        self._sweeping: SingleFlight[bytes, Directory] = SingleFlight(nursery)
        self._root_proven = root == ROOT
        self._dot_refused = False
        self.on_swept: Callable[[bytes, Directory], Awaitable[None]] | None = None
        self.on_listed: Callable[[bytes, Directory], None] = lambda path, directory: None
        self.lost = False
        self.tells_times = False
        self.sweeps = 0
        self.served_stale = 0

    async def find(self, path: bytes) -> Found:
        """Return what is known of a path below the root.

        A name that an incomplete listing lacks is asked for by opening it as a file: there is no other way.

        Raises:
            NotFound: its parent's listing does not show it.
            NotADirectory: a part of it is a file. Else as RemoteStore.list_directory and open_reader.
        """
        if path.count(b"/") > MAX_DEPTH:
            raise PathTooLong(f"path of {len(path)} bytes has more parts than a vehicle takes")
        parent, name = split(path)
        directory = await self.get(parent)
        entry = directory.entries.get(name)
        if entry is None and directory.cut_short and name:
            entry = await self._ask_for(path)
            self._dentries.note_found(path, entry)
        if entry is None and path == LOG_ALIAS and _announces_trees(directory):
            entry = await self._find_log_alias()
        if entry is None:
            raise NotFound(f"{path!r} does not exist")
        return Found(entry, directory)

    async def _find_log_alias(self) -> DirEntry | None:
        """List `@MAV_LOG`, which newer ArduPilot has without showing it in `/` (servers.md 11)."""
        if self._dentries.fresh(LOG_ALIAS, self._clock()) is None:
            try:
                await self._sweeping.run(LOG_ALIAS, partial(self._sweep, LOG_ALIAS))
            except FtpNak as nak:
                if errno_for(nak) != errno.ENOENT:
                    raise
                return None
        return DirEntry(split(LOG_ALIAS)[1], EntryKind.DIRECTORY)

    async def _ask_for(self, path: bytes) -> DirEntry:
        """Open a file that an incomplete listing lacks.

        Raises:
            NotFound: the vehicle says that there is none. Else as RemoteStore.open_reader.
        """
        try:
            size = await self.ask_size(path)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
            raise NotFound(f"{path!r} does not exist") from nak
        return DirEntry(split(path)[1], EntryKind.FILE, size)

    async def get(self, path: bytes) -> Directory:
        """Return a directory's listing: fresh, else swept, else (the vehicle being lost) expired.

        Raises:
            NotFound, NotADirectory; else as RemoteStore.list_directory.
        """
        fresh = self._dentries.fresh(path, self._clock())
        if fresh is not None:
            return fresh
        stale = self._dentries.known(path)
        if self.lost and stale is not None:
            self.served_stale += 1
            return stale
        try:
            await self._require_directory(path)
            directory = await self._sweeping.run(path, partial(self._sweep, path))
        except VehicleLost:
            if stale is None:
                raise
            self.served_stale += 1
            return stale
        if self.on_swept is not None:
            await self.on_swept(path, directory)
        return directory

    async def ask(self, path: bytes) -> Directory:
        """Return a directory's listing asked for just now.

        Raises:
            As get; VehicleLost instead of an old listing.
        """
        asked = self._clock()
        self._dentries.expire(path, asked)
        for _ in range(SWEEP_TRIES):
            directory = await self.get(path)
            if directory.listed_at >= asked:
                return directory
        raise VehicleLost("the vehicle does not answer")

    async def recent(
        self, path: bytes, *, began: float | None = None, ended: float | None = None
    ) -> Directory:
        """Return a listing that began, or ended, at the given time or later; asks for one if there is none.

        Raises:
            As ask.
        """
        known = self._dentries.fresh(path, self._clock())
        if known is not None and known.listed_at >= (began or 0.0) and known.ended_at >= (ended or 0.0):
            return known
        return await self.ask(path)

    def rebooted(self) -> None:
        """What was learnt of the server's ways may no longer hold."""
        self.tells_times = False
        self._root_proven = self._root == ROOT
        self._dot_refused = False

    async def _require_directory(self, path: bytes) -> None:
        if path == self._root:
            await self._require_root()
        elif path != ROOT and (await self.find(path)).entry.kind is not EntryKind.DIRECTORY:
            raise NotADirectory(f"{path!r} is not a directory")

    async def _require_root(self) -> None:
        """Walk to the mount's root once.

        A part that no listing shows may still be listed, because PX4 hides symlinked directories
        (MavlinkFTP::_workList sends them as skip entries) and some trees are not announced; a part shown
        as a file may not.
        """
        if self._root_proven:
            return
        path = ROOT
        for part in self._root.split(b"/")[1:]:
            directory = await self._listed(path)
            entry = directory.entries.get(part)
            path = join(path, part)
            if entry is not None and entry.kind is not EntryKind.DIRECTORY:
                raise NotADirectory(f"{path!r} is not a directory")
        self._root_proven = True

    async def _listed(self, path: bytes) -> Directory:
        """Return the listing of a directory on the way to the root."""
        fresh = self._dentries.fresh(path, self._clock())
        return fresh or await self._sweeping.run(path, partial(self._sweep, path))

    async def _sweep(self, path: bytes) -> Directory:
        """List until no change of ours came between."""
        for _ in range(SWEEP_TRIES - 1):
            directory, raced = await self._sweep_once(path)
            if not raced:
                return directory
        return (await self._sweep_once(path))[0]

    async def _sweep_once(self, path: bytes) -> tuple[Directory, bool]:
        sweep = self._dentries.begin(path, self._clock())
        self.sweeps += 1
        try:
            listing = await self._list(path)
        except FtpNak:
            self._dentries.abandon(sweep)
            self._doubt(path)
            raise
        except BaseException:
            self._dentries.abandon(sweep)
            raise
        known = self._dentries.known(path)
        if not (listing.complete or (known is not None and known.cut_short)):
            log.warning(
                "%r was not listed to its end: %d names of it are known, and reading it is an error",
                path,
                len(listing.entries),
            )
        self.tells_times |= any(entry.mtime is not None for entry in listing.entries)
        directory = self._dentries.finish(sweep, listing, self._clock())
        if not sweep.void:
            self.on_listed(path, directory)
        return directory, sweep.reshaped

    def _doubt(self, path: bytes) -> None:
        """The server refused to list it: perhaps it is gone, so the parent is asked again."""
        self._dentries.forget(path)
        if path != ROOT:
            self._dentries.expire(split(path)[0], self._clock())

    async def _list(self, path: bytes) -> Listing:
        listing = await self._store.list_directory(path)
        if path == ROOT and not self._dot_refused and _hides_files(listing):
            return await self._with_dot(listing)
        return listing

    async def _with_dot(self, listing: Listing) -> Listing:
        """Add what only `.` shows: ArduPilot on SITL omits every plain file of `/` (servers.md 14.32)."""
        try:
            dot = await self._store.list_directory(DOT)
        except FtpNak:
            self._dot_refused = True
            return listing
        if not any(entry.kind is EntryKind.FILE for entry in dot.entries):
            return listing  # proves nothing: the first file may come later, and must not seem to be gone
        shown = {entry.name for entry in listing.entries}
        more = tuple(entry for entry in dot.entries if entry.name not in shown)
        return Listing(
            listing.entries + more,
            listing.took + dot.took,
            listing.complete and dot.complete,
            listing.hidden + dot.hidden,
        )


def _announces_trees(root: Directory) -> bool:
    """Return whether `/` shows other `@` trees: what shows none may not survive being asked for a list."""
    return any(name.startswith(b"@") for name in root.entries)


def _hides_files(listing: Listing) -> bool:
    """Return whether this looks like ArduPilot's `/` with its files left out."""
    names = {entry.name for entry in listing.entries}
    plain = any(entry.kind is EntryKind.FILE for entry in listing.entries)
    return not plain and not names.isdisjoint((b"@SYS", b"@ROMFS"))
