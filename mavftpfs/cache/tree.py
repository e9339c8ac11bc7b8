"""The vehicle's files, as mounts, commands and programs see them. Layer: cache.

`Tree` decides which part answers: remembered listings (`directories`), blocks of regular files (`files`),
what is written here (`writeback`), snapshots of `@` files (`virtual`) or names that never reach the vehicle
(`localfiles`). It translates paths: callers name them below the mount's root, the modules behind it name them
as the vehicle does.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

import trio

from mavftpfs.cache.attributes import SECOND, Stat, shown_mtime
from mavftpfs.cache.directories import Directories, Directory, Found
from mavftpfs.cache.draft import Draft, State
from mavftpfs.cache.files import Files
from mavftpfs.cache.localfiles import LocalFiles
from mavftpfs.cache.missions import Missions
from mavftpfs.cache.nodes import Nodes
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.parameters import Parameters
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.remote import VehicleStore
from mavftpfs.cache.reserved import is_reserved
from mavftpfs.cache.texts import Access, Program, Texts
from mavftpfs.cache.versions import BlockCache
from mavftpfs.cache.virtual import VirtualTrees
from mavftpfs.cache.writeback import Writeback
from mavftpfs.shared import readonly
from mavftpfs.shared.errors import (
    CrossDevice,
    DirectoryNotEmpty,
    IsADirectory,
    ListingIncomplete,
    NotADirectory,
    NotDeliveredYet,
    NotFound,
    NotSupported,
    ReadOnly,
)
from mavftpfs.shared.model import ROOT, DirEntry, EntryKind, is_snapshot, is_virtual, join, normalise, split

__all__ = ["OpenFile", "Stat", "Tree"]


class Tree:
    """The vehicle's files below `options.root`, which is `/` in every path given and called back.

    Paths are normalised (shared.model.normalise) before they are used.
    """

    def __init__(
        self,
        store: VehicleStore,
        options: CacheOptions,
        *,
        clock: Callable[[], float],
        invalidate: Callable[[bytes], None],
        nursery: trio.Nursery,
        spool: SpoolDirectory | None = None,
        wall: Callable[[], float] = time.time,
        rng: Random | None = None,
    ) -> None:
        """`invalidate(path)`: copies that the caller (a mount's kernel) keeps of a path's bytes and
        attributes are wrong; must not block.

        `nursery`: listings and snapshots under way survive the cancellation of their callers.
        `spool` keeps what is not delivered; `wall`: seconds since 1970; `rng` numbers our temporary names.
        """
        self._options = options
        self._clock = clock
        self._forget_copies = invalidate
        self._store = store
        self._directories = Directories(
            store, options, clock=clock, nursery=nursery, on_listed=self._on_listed, on_swept=self._on_swept
        )
        self._blocks = BlockCache(options.cache_size, clock=clock, patience=options.op_deadline)
        nodes = Nodes()
        self._files = Files(
            store,
            self._blocks,
            proof_time=options.proof_time,
            directories=self._directories,
            nodes=nodes,
            invalidate=self._invalidate,
        )
        self._virtual = VirtualTrees(
            store, self._directories, options, invalidate=self._invalidate, nursery=nursery
        )
        self._local = LocalFiles(
            options.local_max, lambda: int(wall() * SECOND), used=options.local and not options.read_only
        )
        self._writing = Writeback(
            store=store,
            directories=self._directories,
            files=self._files,
            nodes=nodes,
            options=options,
            wall=wall,
            rng=rng or Random(),
            nursery=nursery,
            spool_directory=spool,
        )
        self._context = self._writing.context
        access = Access(store, self._virtual, wall, self._require_texts_writable)
        self._texts: tuple[Texts[Any], ...] = (Parameters(access), Missions(access))

    # --- asking

    async def stat(self, path: bytes) -> Stat:
        """Return a path's attributes. The root's cost no traffic.

        Raises:
            NotFound, NotADirectory; else as RemoteStore.list_directory.
        """
        remote = self._remote(path)
        if remote == self._options.root:
            return Stat(EntryKind.DIRECTORY, 0, shown_mtime(remote, None), self._options.attributes_hold)
        if is_snapshot(remote):
            texts = self._texts_of(remote)
            return await (self._virtual.stat(remote) if texts is None else texts.stat(split(remote)[1]))
        if self._local.owns(remote):
            return self._local.stat(remote)
        self._require_not_reserved(remote)
        node = self._context.nodes.get(remote)
        if node is not None and node.draft is not None:
            return self._draft_stat(remote, node.draft)
        return self._listed_stat(remote, await self._directories.find(remote))

    def is_only_read(self, path: bytes) -> bool:
        """Return whether nothing can ever be written at a path, whatever the vehicle does: below `@`
        directories all but the texts, the directories of these and local files. No traffic."""
        remote = self._remote(path)
        if not is_virtual(remote) or self._local.owns(remote):
            return False
        return not any(remote in texts.written for texts in self._texts)

    def negative_valid_for(self, path: bytes) -> float:
        """Return for how many seconds a caller may remember that stat(path) raised NotFound.

        0 where the absence is not proven: the listing was incomplete or is not fresh any more.
        """
        remote = self._remote(path)
        left = self._virtual.absent_until(remote) - self._clock()
        parent, name = split(remote)
        directory = self._directories.known(parent)
        if directory is not None and directory.complete and name not in directory.entries:
            left = max(left, self._directories.left(directory))
        return max(0.0, min(self._options.absence_holds, left))

    async def list(self, path: bytes) -> list[tuple[bytes, Stat]]:
        """Return a directory's entries without `.` and `..`.

        Raises:
            ListingIncomplete: it holds what is known. NotFound, NotADirectory; else as
                RemoteStore.list_directory.
        """
        remote = self._remote(path)
        if is_snapshot(remote):
            files = await self._virtual.list(remote)
            for texts in self._texts:
                if texts.directory == remote:
                    files += await texts.list(self._options.probe_time)
            return files
        if self._local.owns(remote) and self._local.find(remote):
            raise NotADirectory(f"{remote!r} is not a directory")
        directory = await self._directories.get(remote)
        founds = {name: Found(entry, directory) for name, entry in directory.entries.items()}
        if remote == ROOT:
            await self._virtual.probe(directory.entries)
            for name in self._virtual.shown_in_root(directory.entries):
                founds[name] = Found(DirEntry(name, EntryKind.DIRECTORY), directory)
        shown = {}
        for name, found in founds.items():
            if self._options.read_only or not is_reserved(name):
                shown[name] = self._listed_stat(join(remote, name), found)
        for node in self._context.nodes:
            parent, name = split(node.path)
            if parent == remote and node.draft is not None:
                shown[name] = self._draft_stat(node.path, node.draft)
        for name in self._local.names(remote):
            shown[name] = self._local.stat(join(remote, name))
        if not directory.complete:
            raise ListingIncomplete(f"{remote!r} was not listed to its end", list(shown.items()))
        return list(shown.items())

    async def open(
        self,
        path: bytes,
        *,
        write: bool = False,
        truncate: bool = False,
        append: bool = False,
        program: Callable[[], Program | None] = lambda: None,
    ) -> OpenFile:
        """Open a file. `truncate` empties it: here at once, on the vehicle later.

        For texts: append: what is written goes to the end. program: the program that opens it.

        Raises:
            NotFound, NotADirectory, IsADirectory, ReadOnly, Armed, FileBusy; else as RemoteStore.open_reader
            and read_whole.
        """
        remote = self._remote(path)
        texts = self._texts_of(remote)
        if texts is not None:
            return await texts.open(
                split(remote)[1],
                write=write or truncate,
                truncate=truncate,
                append=append,
                program=program(),
            )
        if write or truncate:
            self._require_writable(remote)
        if is_snapshot(remote):
            return await self._virtual.open(remote)
        if self._local.owns(remote):
            return self._local.open(remote, write=write or truncate, truncate=truncate)
        if write or truncate:
            return await self._writing.open(remote, truncate=truncate)
        if remote == self._options.root:
            raise IsADirectory("the mount's root is a directory")
        self._require_not_reserved(remote)
        return await self._writing.open_reader(remote)

    async def crc32(self, path: bytes) -> int:
        """Return the vehicle's CRC32 of a file (start value 0, no final xor).

        Of an `@` file it is the CRC32 of the bytes that a reader gets: the vehicle makes them at every open.

        Raises:
            NotFound, NotADirectory, IsADirectory, Armed, NotDeliveredYet; else as RemoteStore.crc32.
        """
        remote = self._remote(path)
        texts = self._texts_of(remote)
        if texts is not None:
            return await texts.crc32(split(remote)[1])
        if is_snapshot(remote):
            return await self._virtual.crc32(remote)
        node = self._context.nodes.get(remote)
        if node is not None and node.undelivered:
            raise NotDeliveredYet(f"{remote!r} is not on the vehicle yet")
        if remote == self._options.root:
            raise IsADirectory("the mount's root is a directory")
        found = await self._directories.find(remote)
        if found.entry.kind is not EntryKind.FILE:
            raise IsADirectory(f"{remote!r} is a directory")
        self._directories.require_heard()
        return await self._store.crc32(remote, size=found.size)

    # --- changing (all raise ReadOnly with `read_only`, and below `@` directories)

    async def create(
        self, path: bytes, *, exclusive: bool, program: Callable[[], Program | None] = lambda: None
    ) -> OpenFile:
        """Make a file, or open (not empty) the one that is there, for writing. program: see open.

        Raises:
            AlreadyExists (exclusive), NotFound (its directory), NotADirectory, IsADirectory, Armed,
                PathTooLong.
        """
        remote = self._remote(path)
        for texts in self._texts:
            if split(remote)[0] == texts.directory:
                texts.note_other_file(program())
        self._require_writable(remote)
        if self._local.owns(remote):
            await self._require_parent(remote)
            return self._local.create(remote, exclusive=exclusive)
        return await self._writing.create(remote, exclusive=exclusive)

    async def truncate(self, path: bytes, size: int) -> None:
        """Cut or extend a file, and deliver it, unless another program has it open for writing.

        Raises:
            NotFound, IsADirectory, Armed, FileBusy, FileTooLarge, NotSupported.
        """
        remote = self._remote(path)
        self._require_writable(remote)
        if self._local.owns(remote):
            self._local.resize(self._local.find(remote), size)
        else:
            await self._writing.truncate(remote, size)

    async def set_times(self, path: bytes, mtime_ns: int) -> None:
        """Show this mtime (nanoseconds since 1970 UTC) until the file changes; no server can keep it.

        Raises:
            NotFound, NotADirectory.
        """
        remote = self._remote(path)
        await self.stat(path)
        if self._texts_of(remote) is not None:
            return  # it shows when the vehicle changed
        self._require_writable(remote)
        if self._local.owns(remote):
            self._local.find(remote).mtime_ns = mtime_ns
        else:
            self._context.times.set(remote, mtime_ns)

    async def mkdir(self, path: bytes) -> None:
        """Make a directory.

        Raises:
            AlreadyExists, NotFound, NotADirectory, NotSupported (a local name), Armed, PathTooLong.
        """
        remote = self._remote(path)
        self._require_writable(remote)
        if self._local.owns(remote):
            raise NotSupported(f"{remote!r} is a name for files that stay in memory")
        await self._writing.namespace.mkdir(remote)

    async def rmdir(self, path: bytes) -> None:
        """Remove an empty directory.

        Raises:
            NotFound, NotADirectory, DirectoryNotEmpty, Armed.
        """
        remote = self._remote(path)
        self._require_writable(remote)
        if self._local.owns(remote) and self._local.find(remote):
            raise NotADirectory(f"{remote!r} is not a directory")
        if self._local.names(remote):
            raise DirectoryNotEmpty(f"{remote!r} holds local files")
        await self._writing.namespace.rmdir(remote)

    async def unlink(self, path: bytes) -> None:
        """Remove a file; programs that have it open go on with what was written here.

        Raises:
            NotFound, IsADirectory, Armed, FileBusy.
        """
        remote = self._remote(path)
        self._require_writable(remote)
        if self._local.owns(remote):
            self._local.unlink(remote)
        else:
            await self._writing.namespace.unlink(remote)

    async def rename(self, old: bytes, new: bytes, *, noreplace: bool = False) -> None:
        """Rename a file or directory, over what is there if the rules of rename(2) allow it.

        Raises:
            NotFound, NotADirectory, IsADirectory, DirectoryNotEmpty, AlreadyExists (noreplace), InvalidMove,
            CrossDevice, PathTooLong, Armed, FileBusy.
        """
        source, target = self._remote(old), self._remote(new)
        self._require_writable(source)
        self._require_writable(target)
        if self._local.owns(source) != self._local.owns(target):
            raise CrossDevice(f"one of {source!r} and {target!r} is not on the vehicle")
        if self._local.owns(source):
            await self._require_parent(target)
            self._local.rename(source, target, noreplace=noreplace)
        else:
            await self._writing.namespace.rename(source, target, noreplace=noreplace)
            self._local.follow_rename(source, target)

    def undelivered(self) -> Sequence[bytes]:
        """Return the paths of files of which the vehicle does not provably have every byte."""
        return [self._below(remote) for remote in self._writing.undelivered()]

    def broken(self) -> Sequence[bytes]:
        """Return the paths of files of which a write failed; the parts that were written are kept."""
        return [self._below(remote) for remote in self._writing.broken()]

    async def break_unfinished(self) -> None:
        """Break the files that programs were writing when the mount was taken away. For the end of a mount.

        These programs get errors from now on, so what they wrote is a part, which never gets the name.
        """
        await self._writing.break_unfinished()

    async def drain(self, timeout: float) -> Sequence[bytes]:
        """Deliver everything, trying again for at most `timeout` seconds; return what remains."""
        await self._writing.drain(timeout)
        return self.undelivered()

    async def tidy_up(self) -> None:
        """Remove the old files of replacements that are left on the vehicle. For the end of a mount."""
        await self._writing.tidy_up()

    def recover_to(self, directory: Path) -> Sequence[Path]:
        """Move undelivered and broken files, each with its description, to a directory, which is made.

        Returns the files, [] if there was nothing. A file that cannot be moved stays in the spool for the
        next mount. Blocks the event loop: only for the end of a mount.

        Raises:
            OSError, NoSpace, SpoolFailed: nothing could be moved.
        """
        return self._writing.recover_to(directory)

    def armed_changed(self, armed: bool) -> None:
        """The vehicle was armed or disarmed: nothing is changed in flight unless when_armed=ok."""
        self._writing.armed_changed(armed)

    # --- news and housekeeping

    async def refresh(self) -> None:
        """As forget_caches; a mount may have to be waited for (client/mountfiles.py)."""
        self.forget_caches()

    def forget_caches(self) -> None:
        """Drop everything that no open file uses."""
        self._directories.forget(ROOT)
        self._files.forget_closed()
        self._forget_virtual()

    def status(self) -> dict[str, object]:
        """Return counters; bytes_... in bytes, rate in bytes per second or None."""
        files, blocks = self._files, self._blocks
        writing: dict[str, Any] = self._writing.status()
        transfers = [one for texts in self._texts for one in texts.transfers()] + writing.pop("transfers")
        return {
            **writing,
            "transfers": transfers,
            **files.status(),
            "bytes_local": self._local.used,
            "bytes_cached": blocks.bytes_cached + self._virtual.bytes_cached,
            "rate": blocks.meter.shown.at(blocks.clock()),
            "listings_cached": len(self._directories),
            "entries_cached": self._directories.entry_count,
            "listings_asked": self._directories.sweeps,
        }

    def link_back(self) -> None:
        """Heartbeats are back."""
        self._writing.retry()

    def rebooted(self) -> None:
        """The vehicle restarted: what was known of it must be asked again."""
        self._directories.rebooted()
        self._forget_virtual()
        self._files.rebooted()
        self._writing.retry()

    # --- inside

    def _forget_virtual(self) -> None:
        self._virtual.forget()
        for texts in self._texts:
            texts.forget()

    def _remote(self, path: bytes) -> bytes:
        return normalise(self._options.root + b"/" + path)

    def _below(self, remote: bytes) -> bytes:
        """Return the mount's name for a path of the vehicle."""
        return remote if self._options.root == ROOT else remote[len(self._options.root) :] or ROOT

    async def _require_parent(self, remote: bytes) -> None:
        """Raise NotFound or NotADirectory unless the directory of a local path exists, here or there."""
        parent = split(remote)[0]
        if (await self.stat(self._below(parent))).kind is not EntryKind.DIRECTORY:
            raise NotADirectory(f"{parent!r} is not a directory")

    def _require_writable(self, remote: bytes) -> None:
        if self._options.read_only:
            raise ReadOnly(readonly.by_option(remote))
        if is_virtual(remote):
            raise ReadOnly(readonly.virtual(remote))

    def _require_texts_writable(self) -> None:
        if self._options.read_only:
            raise ReadOnly(readonly.NOTHING_BY_OPTION)
        self._context.require_disarmed()

    def _texts_of(self, remote: bytes) -> Texts[Any] | None:
        return next((texts for texts in self._texts if texts.owns(remote)), None)

    def _require_not_reserved(self, remote: bytes) -> None:
        if is_reserved(split(remote)[1]) and not self._options.read_only:
            raise NotFound(f"{remote!r} is a name of our own")

    def _invalidate(self, remote: bytes) -> None:
        self._forget_copies(self._below(remote))

    def _on_listed(self, remote: bytes, directory: Directory) -> None:
        """A directory was listed: what is open of it is compared."""
        self._files.on_listed(remote, directory)
        self._context.on_listed(remote, directory)

    async def _on_swept(self, remote: bytes, directory: Directory) -> None:
        """A listing is to be given out: leftovers in it are mended first."""
        if not self._options.read_only:
            await self._writing.repair.on_swept(remote, directory)

    def _listed_stat(self, remote: bytes, found: Found) -> Stat:
        if is_snapshot(remote):
            return self._virtual.listed_stat(remote, found)
        valid_for = max(0.0, min(self._options.attributes_hold, self._directories.left(found.directory)))
        size = found.size
        user_set, node = None, self._context.nodes.get(remote)
        if node is None or node.draft is None:  # else `_draft_stat` shows it: no listing tells of a draft
            user_set = self._context.times.get(remote, size, found.entry.mtime)
        mtime_ns = shown_mtime(remote, found.entry.mtime) if user_set is None else user_set
        return Stat(found.entry.kind, size, mtime_ns, valid_for)

    def _draft_stat(self, remote: bytes, draft: Draft) -> Stat:
        mtime_ns = self._context.times.peek(remote)
        if mtime_ns is None:
            entry = self._directories.entry(remote)
            listed = entry.mtime if entry is not None and draft.state is State.CLEAN else None
            mtime_ns = shown_mtime(remote, listed)
        return Stat(EntryKind.FILE, draft.size, mtime_ns, self._options.attributes_hold)
