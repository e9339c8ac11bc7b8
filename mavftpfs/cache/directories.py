"""The names of each directory: remembered listings, and requests for new ones. Layer: cache.

There is no stat on the wire (servers.md 14.30): everything known of a path comes from its parent's listing. A
listing is fresh for a while. A name that a fresh and complete listing lacks does not exist. Expired listings
are remembered, and served while the vehicle is lost.

A listing takes many requests, and may or may not show a change that this mount makes meanwhile. So a
listing under way is a `Sweep`, which notes each of these changes, and a noted change counts. Entries behind a
changed name may move between the sweep's pages (servers.md 6, "Concurrent change"), so the result expires at
once.

Listing a file ends a MAVSDK server (servers.md 6). So a path is listed only if its parent's listing shows it
as a directory, and each path is walked from the root. The walk costs nothing where listings are fresh.

Callers ask about a directory, or about one name in it, and say how good the answer has to be:

| good enough | a directory | a name |
|---|---|---|
| what is remembered, however old; costs nothing | `known` | `entry` |
| fresh, and any while the vehicle is lost: for programs | `get` | `find` |
| listed since a moment: before something is changed or believed | `ask` | `ask_entry` |
"""

from __future__ import annotations

import errno
import logging
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from math import inf

import trio

from mavftpfs.cache.attributes import tidy
from mavftpfs.cache.items import Directory as Directory
from mavftpfs.cache.items import Folder
from mavftpfs.cache.items import Sweep as Sweep
from mavftpfs.cache.options import DIR_TIMEOUT, CacheOptions
from mavftpfs.cache.remote import RemoteStore
from mavftpfs.cache.singleflight import SingleFlight
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    FtpNak,
    NotADirectory,
    NotFound,
    PathTooLong,
    VehicleLost,
)
from mavftpfs.shared.model import (
    ROOT,
    DirEntry,
    EntryKind,
    Listing,
    join,
    split,
    usable_name,
)

log = logging.getLogger("mavftpfs.cache")

COST_FACTOR = 50
"""A listing that took T seconds is fresh for at least COST_FACTOR * T: it costs at most 2 % of the link."""

LOOK_FACTOR = 5
"""A listing that took T seconds is recent enough to change names by for LOOK_FACTOR * T. Otherwise each mv
and rm over a slow link would list a long directory again."""

STILL_GROWING = 30.0
"""A file that was seen to grow is taken to be open on the vehicle for so many seconds."""

MAX_DEPTH = 256
"""More components than any path that fits a request has."""

LOOK = 1.0
"""Seconds after which a caller that has an older listing checks whether the vehicle is lost."""

SWEEP_TRIES = 3
"""How often a directory is listed at most because this mount changed names in it meanwhile."""


@dataclass(frozen=True, slots=True)
class Found:
    """A directory entry and the listing that shows it."""

    entry: DirEntry
    directory: Directory

    @property
    def size(self) -> int:
        """Best known size in bytes."""
        return self.directory.sizes.get(self.entry.name, self.entry.size)


class Directories:
    """Listings of the vehicle's directories. All paths are the vehicle's, normalised. The least recently used
    ones are dropped when they have more than `max_entries` names.

    Attributes:
        root: the tree of all that is remembered. tells_times: whether any listing told an mtime. sweeps: how
            many listings were asked for.
    """

    def __init__(
        self,
        store: RemoteStore,
        options: CacheOptions,
        *,
        clock: Callable[[], float],
        nursery: trio.Nursery,
        on_listed: Callable[[bytes, Directory], None] = lambda path, directory: None,
        on_swept: Callable[[bytes, Directory], Awaitable[None]] | None = None,
    ) -> None:
        """`clock`: seconds, monotonic. In `nursery` a listing outlives its caller.

        `on_listed` is called with each new listing, and `on_swept` is awaited before one is returned.
        """
        self._store = store
        self._options = options
        self.clock = clock
        self.root = Folder()
        self._recent: OrderedDict[Folder, None] = OrderedDict()  # those that have a listing
        self._sweeping: SingleFlight[Folder, Directory] = SingleFlight(nursery)
        self._on_listed, self._on_swept = on_listed, on_swept
        self.sweeps = 0
        self._forget_server()

    @property
    def entry_count(self) -> int:
        """Names remembered over all listings."""
        count = 0
        for folder in self._recent:
            count += len(folder.listing.entries) if folder.listing else 0
        return count

    # --- what is remembered

    def known(self, path: bytes) -> Directory | None:
        """Return the directory's listing, expired or not."""
        folder = self.root.find_folder(path)
        if folder is None or folder.listing is None:
            return None
        self._recent.move_to_end(folder)
        return folder.listing

    def _is_fresh(self, directory: Directory) -> bool:
        """Return whether a listing still proves something."""
        return self.clock() < directory.fresh_until

    def left(self, directory: Directory) -> float:
        """Return for how many seconds a listing stays fresh; without end while the vehicle is lost, because
        no newer one can be had."""
        return directory.fresh_until - self.clock() if self._store.why_lost() is None else inf

    def entry(self, path: bytes) -> DirEntry | None:
        """Return what a path was last known to be."""
        directory, name = self._peek(path)
        return None if directory is None else directory.entries.get(name)

    def _peek(self, path: bytes) -> tuple[Directory | None, bytes]:
        """Return the listing of a path's directory, if there is one, and the path's name in it."""
        parent, name = split(path)
        folder = self.root.find_folder(parent)
        return None if folder is None else folder.listing, name

    def is_growing(self, path: bytes) -> bool:
        """Return whether somebody on the vehicle seems to write the file."""
        directory, name = self._peek(path)
        return directory is not None and self.clock() - directory.growing.get(name, -inf) < STILL_GROWING

    def learn_size(self, path: bytes, size: int) -> None:
        """Note the size that an open reply told. It beats the listing until the next one. If it is larger,
        the file grows."""
        directory, name = self._peek(path)
        if directory is None or name not in directory.entries:
            return
        before = directory.size_of(name)
        directory.sizes[name] = size
        if size > before:
            directory.growing[name] = self.clock()

    def put(self, path: bytes, entry: DirEntry | None) -> None:
        """Note that this mount made, wrote, renamed or removed (None) this name. Directories below it are
        listed again."""
        self.forget(path)
        parent, name = split(path)
        if entry is not None and entry.name != name:
            entry = replace(entry, name=name)
        folder = self.root.find_folder(parent)
        if folder is not None and folder.sweep is not None:
            folder.sweep.changes[name] = entry
        if folder is not None and folder.listing is not None:
            folder.listing.put(name, entry)

    @contextmanager
    def changing(self, *paths: bytes) -> Iterator[None]:
        """Have these names change in the body. A listing that ends meanwhile proves nothing: servers count
        names, and when one is taken away, the next one moves up, past the place where the listing goes on."""
        began = self.clock()
        try:
            yield
        finally:
            for path in paths:
                directory, _ = self._peek(path)
                if directory is not None and directory.ended_at > began:
                    self.expire(split(path)[0])

    def rename(self, old: bytes, new: bytes) -> None:
        """Note a rename, perhaps over another file, that the vehicle has just confirmed."""
        entry = self.entry(old)
        self.put(old, None)
        self.put(new, entry)
        if entry is None:
            self.expire(split(new)[0])

    def expire(self, path: bytes) -> None:
        """Make a listing prove nothing from now on. It may still be served while the vehicle is lost."""
        folder = self.root.find_folder(path)
        if folder is not None:
            self._expire(folder)

    def _expire(self, folder: Folder) -> None:
        if folder.sweep is not None:
            folder.sweep.void = True
        if folder.listing is not None:
            folder.listing.fresh_until = min(folder.listing.fresh_until, self.clock())

    def forget(self, path: bytes) -> None:
        """Drop the listings of `path` and of all below it."""
        top = self.root.find_folder(path)
        if top is None:
            return
        for folder in [top, *top.walk()]:
            if isinstance(folder, Folder):
                if folder.sweep is not None:
                    folder.sweep.void = True
                self._forget_listing(folder)

    def _forget_listing(self, folder: Folder) -> None:
        folder.listing = None
        self._recent.pop(folder, None)
        folder.prune()

    def rebooted(self) -> None:
        """Expire all listings, and forget what was learnt of the server."""
        for folder in [self.root, *self.root.walk()]:
            if isinstance(folder, Folder):
                self._expire(folder)
        self._forget_server()

    def _forget_server(self) -> None:
        self.tells_times = False
        self._root_proven = self._options.root == ROOT

    # --- asking

    async def find(self, path: bytes) -> Found:
        """Return what is known of a path below the root.

        Raises:
            NotFound: its parent's listing does not show it. ListingIncomplete: nor does it prove anything.
            NotADirectory: a part of the path is a file. Otherwise as RemoteStore.list_directory.
        """
        if path.count(b"/") > MAX_DEPTH:
            raise PathTooLong(f"path of {len(path)} bytes has more parts than a vehicle takes")
        directory = await self.get(split(path)[0])
        entry = directory.has(path)
        if entry is None:
            raise NotFound(f"{path!r} does not exist")
        return Found(entry, directory)

    async def ask_entry(self, path: bytes, *, within: float = 0.0) -> DirEntry | None:
        """Return what the vehicle has at a path, without pending changes. Its directory is listed now, or was
        listed at most `within` seconds ago; longer where listings take long (LOOK_FACTOR).

        Raises:
            As ask, but None where its directory is gone. ListingIncomplete: see Directory.has.
        """
        parent, _ = split(path)
        known, not_before = self.known(parent), None
        if known is not None and within:
            not_before = self.clock() - max(within, LOOK_FACTOR * (known.ended_at - known.listed_at))
        try:
            return (await self.ask(parent, not_before=not_before)).has(path)
        except (NotFound, NotADirectory):
            return None

    async def ask(self, path: bytes, *, not_before: float | None = None) -> Directory:
        """Return a directory's listing that begins now, or that did not begin before a time.

        Raises:
            NotFound, NotADirectory, VehicleLost; otherwise as RemoteStore.list_directory.
        """
        since = self.clock() if not_before is None else not_before
        for _ in range(SWEEP_TRIES):
            folder = self.root.find_folder(path)
            sweep = None if folder is None else folder.sweep
            if sweep is None or sweep.void or sweep.began < since:
                known = None if not_before is None else self.known(path)
                if known is not None and known.listed_at >= since and self._is_fresh(known):
                    return known
                self.expire(path)
            directory = await self._list(path)
            if directory.listed_at >= since:
                return directory
        raise VehicleLost("the vehicle does not answer")

    async def get(self, path: bytes) -> Directory:
        """Return a directory's listing: a fresh one, else a new one. While the vehicle is lost, return the
        known one at once.

        Raises:
            NotFound, NotADirectory, VehicleLost; otherwise as RemoteStore.list_directory.
        """
        directory = self.known(path)
        if directory is None:
            self.require_heard()
            return await self._list(path)
        if self._is_fresh(directory) or self._store.why_lost() is not None:
            return directory
        try:
            return await self._list(path, until_lost=True)
        except VehicleLost:
            return directory

    def require_heard(self) -> None:
        """Raise VehicleLost if the vehicle is lost: a request that begins now would wait in vain."""
        why = self._store.why_lost()
        if why is not None:
            raise VehicleLost(why)

    # --- listing

    async def _list(self, path: bytes, *, until_lost: bool = False) -> Directory:
        """Check that a path is a directory, list it, and have temporary files in it repaired.

        until_lost: wait for the listing only until the vehicle is lost. The listing goes on for the next
        caller.

        Raises:
            NotFound, NotADirectory, VehicleLost; otherwise as RemoteStore.list_directory.
        """
        if path == self._options.root:
            await self._walk_to_root()
        elif path != ROOT:
            found, item = await self.find(path), self.root.find(path)
            if found.entry.kind is not EntryKind.DIRECTORY or (item is not None and item.is_local):
                raise NotADirectory(f"{path!r} is not a directory")
        while True:
            with trio.move_on_after(LOOK if until_lost else inf):
                directory = await self._swept(path)
                break
            self.require_heard()
        if self._on_swept is not None:
            await self._on_swept(path, directory)
        return directory

    async def _walk_to_root(self) -> None:
        """Check, once, that no part of the mount's root is a file.

        A part that no listing shows may still be listed, because PX4 hides symlinked directories
        (MavlinkFTP::_workList sends them as skip entries) and some trees are not announced.
        """
        path = ROOT
        for part in () if self._root_proven else self._options.root.split(b"/")[1:]:
            directory = self.known(path)
            if directory is None or not self._is_fresh(directory):
                directory = await self._swept(path)
            entry = directory.entries.get(part)
            path = join(path, part)
            if entry is not None and entry.kind is not EntryKind.DIRECTORY:
                raise NotADirectory(f"{path!r} is not a directory")
        self._root_proven = True

    async def _swept(self, path: bytes) -> Directory:
        """List a directory, or wait for the listing of it that is under way."""
        folder = self.root.need(path)
        return await self._sweeping.run(folder, partial(self._sweep, folder))

    async def _sweep(self, folder: Folder) -> Directory:
        """List a directory; again if this mount changed it meanwhile, SWEEP_TRIES times at most."""
        tries, path = 0, folder.path
        while True:
            sweep = self.begin(path)
            self.sweeps += 1
            tries += 1
            try:
                known = sweep.folder.listing
                listing = await self._store.list_directory(
                    path, known_end=None if known is None else known.end
                )
            except FtpNak as nak:  # perhaps the directory is gone: its parent is listed again
                self.forget(path)
                if path != ROOT:
                    self.expire(split(path)[0])
                if path == self._options.root and errno_for(nak) == errno.ENOENT:  # it has no parent to list
                    raise NotFound(f"{path!r} does not exist") from nak
                raise
            finally:
                self.end(sweep)
            directory = self.remember(sweep, listing)
            if not sweep.void:
                self._on_listed(path, directory)
            if not sweep.changes or tries == SWEEP_TRIES:
                return directory

    def begin(self, path: bytes) -> Sweep:
        """Note that a listing of `path` begins. Each directory has one at a time."""
        folder = self.root.need(path)
        sweep = folder.sweep = Sweep(folder, self.clock())
        return sweep

    def end(self, sweep: Sweep) -> None:
        """Note that a listing ended."""
        sweep.folder.sweep = None
        sweep.folder.prune()

    def remember(self, sweep: Sweep, listing: Listing) -> Directory:
        """Remember a listing and return it, with this mount's changes."""
        now, old = self.clock(), sweep.folder.listing
        if not (listing.complete or (old is not None and not old.complete)):
            count = len(listing.entries)
            log.warning(
                "%r was not listed to its end: %d names of it are known, and reading it is an error",
                sweep.folder.path,
                count,
            )
        entries = {}
        for entry in listing.entries:
            self.tells_times |= entry.mtime is not None
            if usable_name(entry.name):
                entries[entry.name] = tidy(entry)
        for name, changed in sweep.changes.items():
            entries.pop(name, None)
            if changed is not None:
                entries[name] = changed
        life = self._options.dir_timeout
        if life is None:
            life = max(DIR_TIMEOUT, COST_FACTOR * listing.took)
        if sweep.changes or sweep.void:
            life = 0.0
        new = Directory(entries, sweep.began, now, now + life, listing.complete, listing.end)
        if old is not None:
            new.seen = old.seen
            _see_growth(old, new, sweep)
        if not sweep.void:
            folder = self.root.need(sweep.folder.path)  # it may have been forgotten meanwhile
            folder.listing = new
            self._recent[folder] = None
            self._recent.move_to_end(folder)
            weight = len(self._recent) + self.entry_count
            while weight > self._options.max_entries and len(self._recent) > 1:
                oldest = next(iter(self._recent))
                weight -= 1 + (len(oldest.listing.entries) if oldest.listing else 0)
                self._forget_listing(oldest)
        return new


def _see_growth(old: Directory, new: Directory, sweep: Sweep) -> None:
    """Note which files grew since the last listing without writes of this mount, and keep earlier notes."""
    for name in new.entries.keys() & old.entries.keys() - sweep.changes.keys():
        if new.size_of(name) > old.size_of(name):
            new.growing[name] = new.ended_at
        elif name in old.growing:
            new.growing[name] = old.growing[name]
