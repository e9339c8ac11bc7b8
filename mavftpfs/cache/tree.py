"""The vehicle's files, as mounts, commands and programs see them. Layer: cache.

`Tree` is the facade: it translates paths, which callers name below the mount's root and the sources behind it
name as the vehicle does, and finds the source of a path: the card (`cardfiles`), snapshots of `@` files
(`virtual`), texts that stand for such a file (`texts`), or names that never reach the vehicle (`localfiles`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import trio

from mavftpfs.cache import reading
from mavftpfs.cache.attributes import SECOND, Stat
from mavftpfs.cache.background import Background
from mavftpfs.cache.card import Card
from mavftpfs.cache.cardfiles import CardFiles
from mavftpfs.cache.directories import Directory, Found
from mavftpfs.cache.localfiles import LocalFiles, stays_local
from mavftpfs.cache.missions import Missions
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.parameters import Parameters
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.remote import VehicleStore
from mavftpfs.cache.source import Opening, Source
from mavftpfs.cache.texts import Program, Texts
from mavftpfs.cache.virtual import VirtualTrees
from mavftpfs.shared import readonly
from mavftpfs.shared.errors import (
    CrossDevice,
    DirectoryNotEmpty,
    ListingIncomplete,
    MavftpfsError,
    NotADirectory,
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
        `spool` keeps what is not delivered; `wall`: seconds since 1970; `rng` numbers temporary files.
        """
        self._options = options
        self._forget_copies = invalidate
        self._card = card = Card(
            store,
            options,
            clock=clock,
            wall=wall,
            rng=rng or Random(),
            nursery=nursery,
            spool=spool,
            tell_changed=self._invalidate,
            on_listed=self._on_listed,
            on_swept=self._on_swept,
        )
        self._background = Background(card)
        self._files = CardFiles(card)
        self._virtual = VirtualTrees(
            store, card.directories, options, invalidate=self._invalidate, nursery=nursery
        )
        self._texts: tuple[Texts[Any], ...] = (
            Parameters(card, self._virtual),
            Missions(card, self._virtual),
        )
        self._local = LocalFiles(
            card.root, options.local_max, lambda: int(wall() * SECOND), self._require_directory_of
        )

    # --- asking

    async def stat(self, path: bytes) -> Stat:
        """Return a path's attributes. The root's cost no traffic.

        Raises:
            NotFound, NotADirectory; else as RemoteStore.list_directory.
        """
        remote = self._remote(path)
        return await (await self._source(remote)).stat(remote)

    def is_local(self, path: bytes) -> bool:
        """Return whether a path is that of a file in memory, which never reaches the vehicle."""
        return self._local.has(self._remote(path))

    def is_only_read(self, path: bytes) -> bool:
        """Return whether nothing can ever be written at a path, whatever the vehicle does: below `@`
        directories all but the texts, the directories of these and local files. No traffic."""
        remote = self._remote(path)
        return is_virtual(remote) and not any(texts.may_be_written(remote) for texts in self._texts)

    def negative_valid_for(self, path: bytes) -> float:
        """Return for how many seconds a caller may remember that stat(path) raised NotFound.

        0 where the absence is not proven: the listing was incomplete or is too old.
        """
        remote, directories = self._remote(path), self._card.directories
        left = self._virtual.absent_until(remote) - self._card.clock()
        parent, name = split(remote)
        directory = directories.known(parent)
        if directory is not None and directory.complete and name not in directory.entries:
            left = max(left, directories.left(directory))
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
        if await self._is_local(remote) and self._local.find(remote):
            raise NotADirectory(f"{remote!r} is not a directory")
        directory, shown = await self._files.list(remote)
        if remote == ROOT:
            await self._virtual.probe(directory.entries)
            for name in self._virtual.shown_in_root(directory.entries):
                found = Found(DirEntry(name, EntryKind.DIRECTORY), directory)
                shown[name] = self._virtual.listed_stat(join(ROOT, name), found)
        shown.update(self._local.below(remote))
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
        remote, write = self._remote(path), write or truncate
        how = Opening(write, truncate, append, program)
        changes = write and not self._texts_of(remote)
        source = await (self._changing(remote) if changes else self._source(remote))
        return await source.open(remote, how)

    async def crc32(self, path: bytes) -> int:
        """Return the vehicle's CRC32 of a file (start value 0, no final xor).

        Of an `@` file it is the CRC32 of the bytes that a reader gets: the vehicle makes them at every open.

        Raises:
            NotFound, NotADirectory, IsADirectory, Armed, NotDeliveredYet; else as RemoteStore.crc32.
        """
        remote = self._remote(path)
        return await (await self._source(remote)).crc32(remote)

    # --- changing (all raise ReadOnly with `read_only`, and below `@` directories)
    # on_card: what is new goes to the card, whatever its name is.

    async def create(
        self,
        path: bytes,
        *,
        exclusive: bool,
        program: Callable[[], Program | None] = lambda: None,
        on_card: bool = False,
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
        return await (await self._changing(remote, on_card)).create(remote, exclusive=exclusive)

    async def truncate(self, path: bytes, size: int) -> None:
        """Cut or extend a file, and deliver it, unless another program has it open for writing.

        Raises:
            NotFound, IsADirectory, Armed, FileBusy, FileTooLarge, NotSupported.
        """
        remote = self._remote(path)
        await (await self._changing(remote)).truncate(remote, size)

    async def set_times(self, path: bytes, mtime_ns: int) -> None:
        """Show this mtime (nanoseconds since 1970 UTC) until the file changes; no server can keep it.

        Raises:
            NotFound, NotADirectory.
        """
        remote = self._remote(path)
        await self.stat(path)
        source = self._texts_of(remote) or await self._changing(remote)
        await source.set_times(remote, mtime_ns)

    async def mkdir(self, path: bytes, *, on_card: bool = False) -> None:
        """Make a directory.

        Raises:
            AlreadyExists, NotFound, NotADirectory, NotSupported (a local name), Armed, PathTooLong.
        """
        remote = self._remote(path)
        await (await self._changing(remote, on_card)).mkdir(remote)

    async def rmdir(self, path: bytes) -> None:
        """Remove an empty directory.

        Raises:
            NotFound, NotADirectory, DirectoryNotEmpty, Armed.
        """
        remote = self._remote(path)
        source = await self._changing(remote)
        if self._local.below(remote):
            raise DirectoryNotEmpty(f"{remote!r} holds local files")
        await source.rmdir(remote)

    async def unlink(self, path: bytes) -> None:
        """Remove a file; programs that have it open go on with what was written here.

        Raises:
            NotFound, IsADirectory, Armed, FileBusy.
        """
        remote = self._remote(path)
        await (await self._changing(remote)).unlink(remote)

    async def rename(self, old: bytes, new: bytes, *, noreplace: bool = False, on_card: bool = False) -> None:
        """Rename a file or directory, over what is there if the rules of rename(2) allow it.

        Raises:
            NotFound, NotADirectory, IsADirectory, DirectoryNotEmpty, AlreadyExists (noreplace), InvalidMove,
            CrossDevice, PathTooLong, Armed, FileBusy.
        """
        source, target = self._remote(old), self._remote(new)
        mover = await self._changing(source)
        if await self._changing(target, on_card) is not mover:
            raise CrossDevice(f"one of {source!r} and {target!r} is not on the vehicle")
        await mover.rename(source, target, noreplace=noreplace)

    # --- what is not on the vehicle

    def undelivered(self) -> Sequence[bytes]:
        """Return the paths of files of which the vehicle does not provably have every byte."""
        return [self._below(file.path) for file in self._background.undelivered()]

    def broken(self) -> Sequence[bytes]:
        """Return the paths of files of which a write failed; the parts that were written are kept."""
        return [self._below(file.path) for file in self._card.broken]

    async def break_unfinished(self) -> None:
        """Break the files that programs were writing when the mount was taken away. For the end of a mount.

        These programs get errors from now on, so what they wrote is a part, which never gets the name.
        """
        await self._background.break_unfinished()

    async def drain(self, timeout: float) -> Sequence[bytes]:
        """Deliver everything, trying again for at most `timeout` seconds; return what remains."""
        await self._background.drain(timeout)
        return self.undelivered()

    async def tidy_up(self) -> None:
        """Remove the temporary files of this mount that are left on the vehicle. For the end of a mount."""
        await self._background.tidy_up()

    def recover_to(self, directory: Path) -> Sequence[Path]:
        """Move undelivered and broken files, each with its description, to a directory, which is made.

        Returns the files, [] if there was nothing. A file that cannot be moved stays in the spool for the
        next mount. Blocks the event loop: only for the end of a mount.

        Raises:
            OSError, NoSpace, SpoolFailed: nothing could be moved.
        """
        return self._background.recover_to(directory)

    # --- news and housekeeping

    def armed_changed(self, armed: bool) -> None:
        """The vehicle was armed or disarmed: nothing is changed in flight unless when_armed=ok."""
        self._background.armed_changed(armed)

    def link_back(self) -> None:
        """Heartbeats are back."""
        self._background.retry()

    def rebooted(self) -> None:
        """The vehicle restarted: what was known of it must be asked again."""
        self._card.rebooted()
        self._forget_virtual()
        self._background.retry()

    async def refresh(self) -> None:
        """As forget_caches; a mount may have to be waited for (client/mountfiles.py)."""
        self.forget_caches()

    def forget_caches(self) -> None:
        """Drop everything that no open file uses."""
        self._card.directories.forget(ROOT)
        self._card.forget_closed()
        self._forget_virtual()

    def status(self) -> dict[str, object]:
        """Return counters; bytes_... in bytes, rate in bytes per second or None."""
        card, cache = self._card, self._card.cache
        transfers = [one for texts in self._texts for one in texts.transfers()]
        return {
            **self._background.status(),
            "transfers": [*transfers, *card.throttle.transfers()],
            "reads": reading.status(card),
            "bytes_local": self._local.used,
            "bytes_cached": cache.bytes_cached + self._virtual.bytes_cached,
            "rate": cache.meter.shown.at(card.clock()),
            "listings_asked": card.directories.sweeps,
        }

    # --- inside: which source

    async def _source(self, remote: bytes, on_card: bool = False) -> Source:
        """Return where the file of a path comes from."""
        if is_snapshot(remote):
            return self._texts_of(remote) or self._virtual
        return self._local if await self._is_local(remote, on_card) else self._files

    async def _changing(self, remote: bytes, on_card: bool = False) -> Source:
        """Return the source of a path that is to be changed. Raises ReadOnly."""
        if self._options.read_only:
            raise ReadOnly(readonly.by_option(remote))
        if is_virtual(remote):
            raise ReadOnly(readonly.virtual(remote))
        return await self._source(remote, on_card)

    async def _is_local(self, remote: bytes, on_card: bool = False) -> bool:
        """Return whether a path is, or would be, a local file's. What the card has under such a name, as from
        a computer in which the card was, is the card's."""
        if not self._options.local or self._options.read_only or not stays_local(remote):
            return False
        if not self._local.has(remote):
            if on_card:
                return False
            with suppress(MavftpfsError):
                await self._files.stat(remote)
                return False
        return True

    def _texts_of(self, remote: bytes) -> Texts[Any] | None:
        return next((texts for texts in self._texts if texts.owns(remote)), None)

    async def _require_directory_of(self, remote: bytes) -> None:
        """Raise NotFound or NotADirectory unless the directory of a path exists, here or there."""
        parent = split(remote)[0]
        if (await (await self._source(parent)).stat(parent)).kind is not EntryKind.DIRECTORY:
            raise NotADirectory(f"{parent!r} is not a directory")

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

    def _invalidate(self, remote: bytes) -> None:
        self._forget_copies(self._below(remote))

    def _on_listed(self, remote: bytes, directory: Directory) -> None:
        """A directory was listed: what is open of it is compared."""
        reading.on_listed(self._card, remote, directory)

    async def _on_swept(self, remote: bytes, directory: Directory) -> None:
        """A listing is to be given out: the temporary files in it are repaired first."""
        if not self._options.read_only:
            await self._card.repair.on_swept(remote, directory)
