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
from math import inf

import trio

from mavftpfs.cache.dentries import Dentries, Directory, Sweep
from mavftpfs.cache.remote import RemoteStore
from mavftpfs.cache.singleflight import SingleFlight
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import FtpNak, NotADirectory, NotFound, PathTooLong, VehicleLost
from mavftpfs.shared.model import DOT, ROOT, DirEntry, EntryKind, Listing, hides_files, join, split

log = logging.getLogger("mavftpfs.cache")

MAX_DEPTH = 256
"""More components than any path that fits a request has."""

LOOK = 1.0
"""Seconds after which who waits for a listing, and knows an older one, looks whether the vehicle is heard."""

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
        ask_size: opens a file and returns its size. on_listed: called with each listing as it is made;
            on_swept: before it is given out. lost: the vehicle is out of reach.
        tells_times: whether any listing told an mtime. sweeps: how many listings were asked for.
    """

    ask_size: Callable[[bytes], Awaitable[int]]

    def __init__(
        self, store: RemoteStore, dentries: Dentries, root: bytes, *, nursery: trio.Nursery | None = None
    ) -> None:
        self._store = store
        self.dentries = dentries
        self._root = root
        self.clock = dentries.clock
        self._sweeping: SingleFlight[bytes, Directory] = SingleFlight(nursery)
        self._root_proven = root == ROOT
        self._dot_refused = False
        self.on_swept: Callable[[bytes, Directory], Awaitable[None]] | None = None
        self.on_listed: list[Callable[[bytes, Directory], None]] = []
        self.lost = False
        self.tells_times = False
        self.sweeps = 0

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
            try:
                entry = DirEntry(name, EntryKind.FILE, await self.ask_size(path))
            except FtpNak as nak:
                if errno_for(nak) != errno.ENOENT:
                    raise
            else:
                self.dentries.learn_found(path, entry)
        if entry is None:
            raise NotFound(f"{path!r} does not exist")
        return Found(entry, directory)

    async def get(self, path: bytes) -> Directory:
        """Return a directory's listing: fresh, else swept, else (the vehicle being silent) expired.

        Raises:
            NotFound, NotADirectory; else as RemoteStore.list_directory.
        """
        directory = self.dentries.known(path)
        if directory is not None and self.clock() < directory.fresh_until:
            return directory
        try:
            if self.lost and directory is not None:
                raise VehicleLost("no heartbeats")
            if path == self._root:
                await self._walk_to_root()
            elif path != ROOT and (await self.find(path)).entry.kind is not EntryKind.DIRECTORY:
                raise NotADirectory(f"{path!r} is not a directory")
            swept = await self._swept(path, older=directory is not None)
        except VehicleLost:
            if directory is None:
                raise
            return directory
        if self.on_swept is not None:
            await self.on_swept(path, swept)
        return swept

    async def _swept(self, path: bytes, *, older: bool) -> Directory:
        """Return a new listing. older: one is known that will do while the vehicle is silent.

        Raises:
            VehicleLost: it is silent. The listing goes on, for whoever asks next.
        """
        patience = LOOK if older and self._sweeping.outlives_callers else inf
        while True:
            with trio.move_on_after(patience):
                return await self._sweeping.run(path, partial(self._sweep, path))
            if self._store.is_silent():
                raise VehicleLost("no heartbeats")

    async def ask(self, path: bytes) -> Directory:
        """Return a directory's listing asked for just now.

        Raises:
            As get; VehicleLost instead of an old listing.
        """
        asked = self.clock()
        self.dentries.expire(path)
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
        known = self.dentries.fresh(path)
        if known is not None and known.listed_at >= (began or 0.0) and known.ended_at >= (ended or 0.0):
            return known
        return await self.ask(path)

    def rebooted(self) -> None:
        """What was learnt of the server's ways may no longer hold."""
        self.tells_times = False
        self._root_proven = self._root == ROOT
        self._dot_refused = False

    async def _walk_to_root(self) -> None:
        """See once that no part of the mount's root is a file.

        A part that no listing shows may still be listed, because PX4 hides symlinked directories
        (MavlinkFTP::_workList sends them as skip entries) and some trees are not announced.
        """
        path = ROOT
        for part in () if self._root_proven else self._root.split(b"/")[1:]:
            directory = self.dentries.fresh(path)
            if directory is None:
                directory = await self._sweeping.run(path, partial(self._sweep, path))
            entry = directory.entries.get(part)
            path = join(path, part)
            if entry is not None and entry.kind is not EntryKind.DIRECTORY:
                raise NotADirectory(f"{path!r} is not a directory")
        self._root_proven = True

    async def _sweep(self, path: bytes) -> Directory:
        """List until no change of ours came between, or SWEEP_TRIES times."""
        tries = 0
        while True:
            sweep = self.dentries.begin(path)
            self.sweeps += 1
            tries += 1
            try:
                listing = await self._list(path)
            except FtpNak:  # perhaps it is gone, so the parent is asked again
                self.dentries.forget(path)
                if path != ROOT:
                    self.dentries.expire(split(path)[0])
                raise
            finally:
                self.dentries.end(sweep)
            directory = self._remember(path, sweep, listing)
            if not sweep.changes or tries == SWEEP_TRIES:
                return directory

    def _remember(self, path: bytes, sweep: Sweep, listing: Listing) -> Directory:
        known = self.dentries.known(path)
        if not (listing.complete or (known is not None and known.cut_short)):
            log.warning(
                "%r was not listed to its end: %d names of it are known, and reading it is an error",
                path,
                len(listing.entries),
            )
        for entry in listing.entries:
            self.tells_times |= entry.mtime is not None
        directory = self.dentries.remember(sweep, listing)
        if not sweep.void:
            for hear in self.on_listed:
                hear(path, directory)
        return directory

    async def _list(self, path: bytes) -> Listing:
        listing = await self._store.list_directory(path)
        if not self._dot_refused and hides_files(path, listing.entries):
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
