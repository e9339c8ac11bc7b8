"""The `@` trees: files whose listed sizes lie and which must be read whole. Layer: cache.

ArduPilot announces `@SYS` and `@ROMFS` in the listing of `/` and keeps `@PARAM` and `@MISSION` to itself,
because they cannot be listed (AP_Filesystem::opendir has no backend entry for them; servers.md 11); newer
PX4 has `@PARAM/param.pck`. `@SYS` claims 100000 bytes for most files, generates them at open, and refuses
some that it lists. So every such file is read whole into a snapshot: a stat takes one, for the true size,
and the open that follows reuses it, so that stat, open and read agree and rsync, tar and cp work.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import trio

from mavftpfs.cache.attributes import Stat, shown_mtime
from mavftpfs.cache.directories import Directories, Directory, Found
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.remote import RemoteStore
from mavftpfs.cache.singleflight import SingleFlight
from mavftpfs.cache.source import Opening, Source
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import (
    DataUnproven,
    FtpNak,
    IsADirectory,
    LinkError,
    ListingIncomplete,
    LocalProtocolError,
    NotADirectory,
    NotFound,
    RemoteProtocolError,
    RequestTimeout,
    SessionBusy,
)
from mavftpfs.shared.model import ROOT, DirEntry, EntryKind, join, split

UNLISTABLE: dict[bytes, tuple[bytes, ...]] = {
    b"@PARAM": (b"param.pck",),
    b"@MISSION": (b"mission.dat", b"fence.dat", b"rally.dat"),
}
"""Trees that no listing shows, and what is shown in them; other names (`param.pck?start=1`) may be opened."""

PARAM_FILE = b"/@PARAM/param.pck"
ANNOUNCERS = frozenset({b"@SYS", b"@ROMFS"})
LIVE_TIME = 1.0
"""Seconds for which a snapshot of parameters or of a mission is good: one `ls -l` and its opens."""

COST_FACTOR = 10
"""A snapshot that took T seconds to read is good for at least COST_FACTOR * T."""

PROBE_PAUSE = 15.0
"""Seconds between two probes for which no program asked. A session that a killed program left may be in the
way, and PX4 ends that only after 10 s without requests."""

MAX_SEEN = 4096
"""Of so many files it is remembered what reading them showed."""


def tree_of(path: bytes) -> bytes:
    """Return the first part of an absolute path."""
    return path[1:].partition(b"/")[0]


@dataclass(frozen=True, slots=True)
class Seen:
    """The result of the last try to read an `@` file, and the time until which it is valid.

    data: the whole file; its size is shown even later. None: the file did not open.
    """

    data: bytes | None
    until: float


UNSEEN = Seen(None, -math.inf)


class SnapshotHandle(OpenFile):
    """One open() of an `@` file that is only read."""

    size = 0
    direct_io = True

    def __init__(self, data: bytes) -> None:
        self._data: memoryview | None = memoryview(data)
        self.size = len(data)

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return `size` bytes at `offset`, fewer only at the end.

        Raises:
            LocalProtocolError: the handle was closed.
        """
        if self._data is None:
            raise LocalProtocolError("read of a closed handle")
        return self._data[offset : offset + size]

    def close(self) -> None:
        """Release the handle."""
        self._data = None


class VirtualTrees(Source):
    """stat, list and open below `/@...`. Paths are the vehicle's."""

    def __init__(
        self,
        store: RemoteStore,
        directories: Directories,
        options: CacheOptions,
        *,
        invalidate: Callable[[bytes], None],
        nursery: trio.Nursery,
    ) -> None:
        self._store = store
        self._directories = directories
        self._options = options
        self._clock = directories.clock
        self._invalidate = invalidate
        self._reading: SingleFlight[bytes, bytes] = SingleFlight(nursery)
        self._seen: OrderedDict[bytes, Seen] = OrderedDict()
        self._probing: SingleFlight[None, None] = SingleFlight()  # it ends with the caller's patience
        self._probe_at = -math.inf
        self._has_parameters: bool | None = None

    @property
    def bytes_cached(self) -> int:
        """Bytes of remembered snapshots."""
        return sum(len(seen.data or b"") for seen in self._seen.values())

    # --- what the tree asks

    def shown_in_root(self, names: Iterable[bytes]) -> tuple[bytes, ...]:
        """Return the directories that appear beside the listed `names` of `/`; costs no traffic."""
        if not ANNOUNCERS.isdisjoint(names):
            return tuple(UNLISTABLE)
        return (tree_of(PARAM_FILE),) if self._has_parameters else ()

    async def probe(self, names: Iterable[bytes], *, asked_for: bool = False) -> None:
        """Find out, once, whether a server that announces no trees opens its parameters. asked_for: a program
        wants them, so they are asked for even beside another client.

        Raises:
            As RemoteStore.stat_size, but for a refusal; only if asked_for.
        """
        if self._has_parameters is not None or not ANNOUNCERS.isdisjoint(names):
            return
        if asked_for:
            await self._probing.run(None, self._probe_once)
        elif not self._store.another_client_heard() and self._clock() >= self._probe_at:
            self._probe_at = self._clock() + PROBE_PAUSE
            with (
                suppress(RequestTimeout, LinkError, SessionBusy),
                trio.move_on_after(self._options.probe_time),
            ):
                await self._probing.run(None, self._probe_once)

    async def _probe_once(self) -> None:
        self._directories.require_heard()
        try:
            await self._store.stat_size(PARAM_FILE)
        except (FtpNak, RemoteProtocolError):
            self._has_parameters = False
        else:
            self._has_parameters = True

    def absent_until(self, path: bytes) -> float:
        """Return until when a path, listed or not, is not shown because it did not open."""
        seen = self._look(path)
        return seen.until if seen.data is None else -math.inf

    async def stat(self, path: bytes) -> Stat:
        """Return attributes. A file whose listed size lies is read to know its true size.

        Raises:
            NotFound, NotADirectory; otherwise as RemoteStore.list_directory and read_whole.
        """
        found = await self._find(path)
        seen = self._look(path)
        # In these trees the size of the last read stays, until the file is opened again.
        stays = seen.data is not None and tree_of(path) in UNLISTABLE
        if self._clock() >= seen.until and not stays and self._is_read_to_know(found.entry):
            try:
                await self._read(path)
            except (FtpNak, DataUnproven, LinkError, SessionBusy):
                if tree_of(path) in UNLISTABLE and seen.data is None:
                    raise
        return self.listed_stat(path, found)

    def listed_stat(self, path: bytes, found: Found) -> Stat:
        """Return what is known without traffic; valid_for is 0 where asking again tells more."""
        entry, seen = found.entry, self._look(path)
        size, left = entry.size, -math.inf
        if entry.kind is EntryKind.DIRECTORY:
            left = self._directories.left(found.directory)
        elif seen.data is not None:
            size, left = len(seen.data), seen.until - self._clock()
        valid_for = max(0.0, min(self._options.attributes_hold, left))
        return Stat(entry.kind, size, shown_mtime(path, entry.mtime), valid_for)

    async def list(self, path: bytes) -> list[tuple[bytes, Stat]]:
        """Return the entries that can be opened, with true sizes as far as they are known in time.

        Raises:
            As Tree.list.
        """
        tree = tree_of(path)
        if tree not in UNLISTABLE:
            directory = await self._directories.get(path)
        elif path != b"/" + tree:
            raise NotADirectory(f"{path!r} is not a directory")
        else:
            entries = {name: DirEntry(name, EntryKind.FILE) for name in UNLISTABLE[tree]}
            directory = replace(await self._shown(tree), entries=entries, complete=True)
        founds = {join(path, name): Found(entry, directory) for name, entry in directory.entries.items()}
        await self._read_unread(founds)
        now = self._clock()
        shown = [
            (split(child)[1], self.listed_stat(child, found))
            for child, found in founds.items()
            if self.absent_until(child) <= now
        ]
        if not directory.complete:
            raise ListingIncomplete(f"{path!r} was not listed to its end", shown)
        return shown

    async def open(self, path: bytes, how: Opening) -> SnapshotHandle:
        """Read the file whole, unless that was just done.

        Raises:
            ReadOnly, NotFound, NotADirectory, IsADirectory; otherwise as RemoteStore.read_whole.
        """
        if how.write:
            self._refuse(path)
        found = await self._find(path)
        if found.entry.kind is not EntryKind.FILE:
            raise IsADirectory(f"{path!r} is a directory")
        seen = self._look(path)
        if seen.data is not None and self._clock() < seen.until:
            return SnapshotHandle(seen.data)
        return SnapshotHandle(await self._read(path))

    async def content(self, path: bytes, *, reread: bool) -> bytes:
        """Return a file of a tree that no listing shows. reread: read it now, unless that was done within
        LIVE_TIME; else what was read last will do, if anything was.

        Raises:
            NotFound; otherwise as RemoteStore.read_whole.
        """
        await self._find(path)
        seen = self._look(path)
        if seen.data is not None and (not reread or self._clock() < seen.until):
            return seen.data
        return await self._read(path)

    def outdate(self, path: bytes) -> None:
        """Make later reads ask the vehicle, because a file is about to change."""
        seen = self._look(path)
        if seen.data is not None:
            self._seen[path] = Seen(seen.data, -math.inf)

    def forget(self) -> None:
        """Forget all snapshots, and what opened or did not."""
        self._seen.clear()
        self._has_parameters, self._probe_at = None, -math.inf

    # --- finding

    def _look(self, path: bytes) -> Seen:
        return self._seen.get(path, UNSEEN)

    async def _find(self, path: bytes) -> Found:
        """Return the listed entry; in a tree that no listing shows, the entry of a file.

        Raises:
            NotFound: also for a listed file that was seen not to open. Otherwise as Directories.find.
        """
        tree = tree_of(path)
        if tree not in UNLISTABLE:
            found = await self._directories.find(path)
        else:
            root, name = await self._shown(tree), path[len(tree) + 2 :]
            if not name:
                return Found(DirEntry(tree, EntryKind.DIRECTORY), root)
            # No such file starts with a dot, but file managers ask for many that do.
            if b"/" in name or name.startswith(b"."):
                raise NotFound(f"{path!r} does not exist")
            found = Found(DirEntry(name, EntryKind.FILE), root)
        if self._clock() < self.absent_until(path):
            raise NotFound(f"the vehicle does not open {path!r}")
        return found

    async def _shown(self, tree: bytes) -> Directory:
        """Return the listing of `/`, beside which a tree is shown.

        Raises:
            NotFound: this server has no such trees. One that does not announce any is asked.
        """
        root = await self._directories.get(ROOT)
        if tree == tree_of(PARAM_FILE):
            await self.probe(root.entries, asked_for=True)
        if tree not in self.shown_in_root(root.entries):
            raise NotFound(f"this vehicle has no {tree.decode()}")
        return root

    # --- reading

    def _is_read_to_know(self, entry: DirEntry) -> bool:
        """Return whether a file has to be read to know its size, and whether it opens."""
        return entry.kind is EntryKind.FILE and entry.size <= self._options.at_stat_limit

    async def _read_unread(self, founds: Mapping[bytes, Found]) -> None:
        """Read what was not read yet, until `probe_time` is over or the link is too bad."""
        with trio.move_on_after(self._options.probe_time), suppress(LinkError, RequestTimeout, SessionBusy):
            for path, found in founds.items():
                if path not in self._seen and self._is_read_to_know(found.entry):
                    with suppress(FtpNak, DataUnproven, NotFound):  # it has its listed size, or is not shown
                        await self._read(path)

    async def _read(self, path: bytes) -> bytes:
        """Take a snapshot; concurrent callers share it.

        Raises:
            NotFound: the vehicle does not know the file, listed or not. Otherwise as RemoteStore.read_whole.
        """
        return await self._reading.run(path, partial(self._read_once, path))

    async def _read_once(self, path: bytes) -> bytes:
        self._directories.require_heard()
        began = self._clock()
        try:
            data = await self._store.read_whole(path, self._options.at_file_limit)
        except FtpNak as nak:
            unlistable = tree_of(path) in UNLISTABLE
            if nak.opcode != Opcode.OPEN_FILE_RO or not (unlistable or nak.code == NakCode.FILE_NOT_FOUND):
                raise
            # A listed file that does not open is not shown until the vehicle restarts.
            self._note(path, Seen(None, self._clock() + self._options.proof_time if unlistable else math.inf))
            raise NotFound(f"the vehicle does not open {path!r}") from nak
        now, before = self._clock(), self._look(path).data
        lasts = max(self._options.proof_time, COST_FACTOR * (now - began))
        if tree_of(path) in UNLISTABLE:
            lasts = LIVE_TIME
        self._note(path, Seen(data, now + lasts))
        if before is not None and len(before) != len(data):
            self._invalidate(path)
        return data

    def _note(self, path: bytes, seen: Seen) -> None:
        """Remember what reading a file showed, for as many files as the budget allows."""
        self._seen.pop(path, None)
        self._seen[path] = seen
        while self.bytes_cached > self._options.at_cache_size or len(self._seen) > MAX_SEEN:
            self._seen.popitem(last=False)
