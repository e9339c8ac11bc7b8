"""The state of a mount: what is known of the vehicle's card, and what is open of it. Layer: cache.

Reading (`reading`), writing (`writing`), sending (`uploads`), delivering (`delivery`) and the changes of
names are functions on it. Paths are the vehicle's.

**When is what was read believed?** A proof that the vehicle's file is still the one that is known has a time.
It is void if it is older than the file's last opening on the vehicle, or than the *epoch*: the last event
that made all that was read suspect, such as a session that another client used, or a restart.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterator
from math import inf
from random import Random

import trio

from mavftpfs.cache.attributes import SECOND
from mavftpfs.cache.blocks import BlockCache
from mavftpfs.cache.directories import Directories, Directory
from mavftpfs.cache.file import Event, File, Replaces, State
from mavftpfs.cache.items import Folder, Item
from mavftpfs.cache.names import Names
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.pathlocks import PathLocks
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.remote import VehicleStore
from mavftpfs.cache.repair import Repair
from mavftpfs.cache.singleflight import SingleFlight
from mavftpfs.cache.spool import Spool
from mavftpfs.cache.temporary import TemporaryNames, new_owner
from mavftpfs.cache.throttle import Throttle
from mavftpfs.shared import readonly
from mavftpfs.shared.errors import Armed, FileBusy, FileChanged
from mavftpfs.shared.model import DirEntry, EntryKind, split
from mavftpfs.shared.sameness import Known

PROVISIONAL = 10.0
"""Seconds for which read bytes stay provisional, because another client is noticed late: servers answer it on
its own link, and a router may pass on only some of that."""

MAX_CLOSED = 2048
"""How many closed files are remembered, with the bytes that are here."""


class Card:
    """All that is known of the vehicle's card.

    Attributes:
        clock: seconds, monotonic; wall: seconds since 1970. paths: see pathlocks.
        live: the files that are open, also those without a name, or of which the vehicle lacks something.
        closed: others of which bytes are here, the least recently used first.
        broken: the last file of each path of which a write failed, the oldest first.
        own: names of temporary files. names: changes names. repair: see there.
        restarted_at: when the vehicle restarted, by the clock.
        blocked: nothing may be changed, because the vehicle is armed.
        opening, fetching: work on a file that all who need it share. fetchers: the files that are
            fetched once their programs pause.
        counts: comparisons by CRC32 and by size alone, and requests for a CRC32 that were not answered.
        retry_later(): is called when something was not delivered; it is tried again.
        tell_changed(path): is called when the copies that callers keep of a file are wrong.
    """

    def __init__(
        self,
        store: VehicleStore,
        options: CacheOptions,
        *,
        clock: Callable[[], float],
        wall: Callable[[], float],
        rng: Random,
        nursery: trio.Nursery,
        spool: SpoolDirectory | None,
        tell_changed: Callable[[bytes], None],
        on_listed: Callable[[bytes, Directory], None],
        on_swept: Callable[[bytes, Directory], Awaitable[None]],
    ) -> None:
        """Without a spool directory, bytes that wait are in one that does not outlive the process. on_listed
        and on_swept: see Directories."""
        self.store = store
        self.options = options
        self.clock = clock
        self.wall = wall
        self.nursery = nursery
        self.tell_changed = tell_changed
        self.retry_later: Callable[[], None] = lambda: None
        self.directories = Directories(
            store, options, clock=clock, nursery=nursery, on_listed=on_listed, on_swept=on_swept
        )
        self.root = self.directories.root
        self.cache = BlockCache(options.cache_size, clock=clock, patience=options.op_deadline)
        self.paths = PathLocks(options.op_deadline)
        self.own = TemporaryNames(new_owner(rng), rng)
        self.spool = Spool(
            None if spool is None else spool.path,
            vehicle=lambda: {"system": store.address()[0], "uid": store.board()},
        )
        self.live: dict[File, None] = {}
        self.closed: OrderedDict[File, None] = OrderedDict()
        self.broken: list[File] = []
        self.opening: SingleFlight[File, bool | None] = SingleFlight()
        self.fetching: SingleFlight[File, None] = SingleFlight(nursery)
        self.fetchers: set[File] = set()
        self.throttle = Throttle(self.live, self.cache.meter, options.link_rate, clock)
        self.counts = {"verified_by_crc": 0, "verified_by_size": 0, "checksums_unanswered": 0}
        self.repair = Repair(
            store,
            self.directories,
            self.own,
            self.paths,
            nursery,
            lambda: self.blocked,
            self._is_used,
            clock,
        )
        self.names = Names(store, self.directories, self.own, self.live, self.repair, clock)
        self.repair.names = self.names
        self.restarted_at = -inf
        self.blocked = False
        store.on_distrust(self.on_distrust)

    # --- files

    def find(self, path: bytes) -> File | None:
        """Return the file of a path, if anything is remembered of it."""
        entry = self.root.find(path)
        return entry if isinstance(entry, File) else None

    def need(self, path: bytes) -> File:
        """Return the file of a path, made if there is none."""
        file = self.find(path)
        if file is None:
            folder, name = self.root.home(path)
            file = folder.children[name] = File(folder, name, self.cache)
        return file

    def files_below(self, path: bytes) -> Iterator[File]:
        """Yield the file of a path, or all files below it."""
        entry = self.root.find(path)
        below: list[Item] = [] if entry is None else [entry]
        if isinstance(entry, Folder):
            below += entry.walk()
        for one in below:
            if isinstance(one, File):
                yield one

    def keep(self, file: File) -> None:
        """Note that a file is open, or that the vehicle lacks some of it."""
        self.closed.pop(file, None)
        self.live[file] = None

    def _is_used(self, path: bytes) -> bool:
        """Return whether a call uses a name, or a program has a file that is to get it."""
        file = self.find(path)
        is_new = file is not None and file.undelivered and file.replaces is Replaces.NOTHING
        return is_new or not self.paths.is_free(path)

    def maybe_forget(self, file: File) -> None:
        """Let a file go that no program has open and of which the vehicle lacks nothing: the bytes read of it
        are kept as long as there is room, those written here are forgotten."""
        if file.handles or file.undelivered or file.unsure or file.lock.locked() or file.attempt:
            return
        self.live.pop(file, None)
        if file.is_local or not file.has_name:
            file.forget_content()
        file.blocks.close_reader()
        file.error, file.start_after = None, -inf
        if file.base is None:
            self.forget(file)
        elif file.has_name:
            file.content.on_opened(file.base.size)
            self.closed[file] = None
            if len(self.closed) > MAX_CLOSED:
                self.forget(next(iter(self.closed)))

    def forget(self, file: File) -> None:
        """Forget a closed file."""
        self.closed.pop(file, None)
        file.forget_content()
        file.leave_tree()
        if file.folder is not None:
            file.folder.prune()

    def forget_closed(self) -> None:
        """Forget every file that is not open."""
        for file in list(self.closed):
            self.forget(file)

    def on_delivered(self, file: File, sent: Known) -> None:
        """Note that the vehicle has all of a file, verified: update what is remembered of it."""
        self.directories.put(file.path, DirEntry(b"", EntryKind.FILE, file.size))
        crc32 = sent.crc32
        if crc32 is None and file.size <= self.options.verify_max:
            crc32 = file.crc32()
        file.on(Event.COMMITTED)
        file.base, file.has_part = Known(file.size, crc32=crc32), False
        file.fresh_at = self.clock()
        file.prove(file.fresh_at)
        file.error, file.start_after = None, -inf
        file.content.on_delivered()
        file.blocks.close_reader()
        file.blocks.drop()
        file.blocks.size = file.size
        file.changers.clear()
        file.delivered_since_open = True
        self.forget_broken(file.path)

    def lose_name(self, file: File) -> None:
        """Take the name from a file that was removed, renamed over, or replaced by others: open handles keep
        it, and read only bytes that programs wrote."""
        self.closed.pop(file, None)
        file.leave_tree()
        if file.state is State.STALE:
            file.on(Event.DROPPED)
        self.names.settle(file)  # nothing of it is to be committed
        file.has_part = False
        file.content.on_unneeded()
        file.blocks.end(FileChanged(f"what was {file.path!r} is gone from the vehicle"))
        self.throttle.waiting.unpark_all()
        if not file.handles:
            self.live.pop(file, None)
            file.forget_content()

    # --- broken files

    def find_broken(self, path: bytes) -> File | None:
        """Return the last broken file of a path."""
        return next((file for file in self.broken if file.path == path), None)

    @property
    def parts(self) -> list[File]:
        """The broken files of which the card, which cannot rename, may have a part under their own names."""
        return [file for file in self.broken if file.has_part and file.base is None]

    def forget_broken(self, path: bytes) -> None:
        """Forget what was written to a path before a write failed. Programs that have it open read on."""
        file = self.find_broken(path)
        if file is not None:
            self.broken.remove(file)
            file.content.on_unneeded()
            if not file.handles:
                file.forget_content()

    @property
    def epoch(self) -> float:
        """When all that was read before became suspect, by the clock."""
        return self.store.epoch

    # --- what may be done

    def require_disarmed(self) -> None:
        """Raise Armed if nothing may be changed now."""
        if self.blocked:
            raise Armed(readonly.ARMED)

    def require_changeable(self) -> None:
        """Raise Armed if nothing may be changed now, VehicleLost if nothing can be."""
        self.require_disarmed()
        self.directories.require_heard()

    def require_idle(self, path: bytes) -> None:
        """Raise FileBusy if the vehicle, or another client, seems to write the file."""
        if self.directories.is_growing(path):
            raise FileBusy(f"{path!r} grows: somebody on the vehicle is writing it")

    # --- what is shown

    def touch(self, file: File) -> None:
        """Give a file that changed the present time, also where no listing tells times."""
        if file.folder is not None:
            file.folder.times.set(file.name, int(self.wall() * SECOND))

    def forget_time(self, path: bytes) -> None:
        """Forget the mtime that a user set of a path: what has it now is another file."""
        parent, name = split(path)
        folder = self.root.find_folder(parent)
        if folder is not None:
            folder.times.forget(name)

    async def shown_entry(self, path: bytes) -> DirEntry | None:
        """Return what a path is, pending changes included; None if it does not exist though its directory
        does.

        Raises:
            NotFound, NotADirectory: its directory. Otherwise as RemoteStore.list_directory.
        """
        file, (parent, name) = self.find(path), split(path)
        if file is not None and file.is_local:
            return DirEntry(name, EntryKind.FILE, file.size)
        return (await self.directories.get(parent)).entries.get(name)

    # --- news

    def rebooted(self) -> None:
        """The vehicle restarted: nothing that was read before is proven."""
        self.restarted_at = self.clock()
        self.directories.rebooted()

    def on_distrust(self) -> None:
        """Drop the bytes of files that are being read, or were read lately: they are suspect, and so are the
        kernel's copies."""
        since = self.clock() - PROVISIONAL
        for file in [*self.live, *self.closed]:
            if file.blocks.reader is None and file.blocks.received_at < since:
                continue
            file.blocks.close_reader()
            file.blocks.drop()
            file.in_kernel = False
            if file.has_name:
                self.tell_changed(file.path)
            if file in self.closed:
                self.forget(file)  # opening it again costs less than comparing it with a listing
