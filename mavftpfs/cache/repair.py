"""Removal or renaming of temporary files that an interruption left on the card. Layer: cache.

Each listing of a directory shows them, and `due_in` says in how many seconds which one is repaired:

| whose, and what | then | when |
|---|---|---|
| this mount's old file, its name missing | gets its name back | at once, in flight, too |
| this mount's, anything else | is removed | at once |
| another mount's old file, its name missing | gets its name back | after 60 s |
| another mount's, anything else | is removed | when it stayed the same for 600 s |

Files that this mount still needs stay. An old file whose name is unknown becomes `recovered-oSSS`; so does a
directory that another client had put in the place of the file before it was moved aside. Another
computer's upload to a FAT card shows a size of 0 until its file is closed, which each upload does at least
once a minute where the server keeps the content: so 600 s without a change say that nobody uploads.

The mount lists these directories by itself (`Repair.list_later`), so that no program has to.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from math import inf

import trio

from mavftpfs.cache.directories import Directories, Directory
from mavftpfs.cache.names import Names
from mavftpfs.cache.pathlocks import PathLocks
from mavftpfs.cache.remote import VehicleStore
from mavftpfs.cache.temporary import Kind, TemporaryName, TemporaryNames, parse
from mavftpfs.shared.errors import MavftpfsError, NotADirectory, NotFound
from mavftpfs.shared.model import EntryKind, join, renamed, split

log = logging.getLogger("mavftpfs.cache")

MOST_AT_ONCE = 128
"""Temporary names that are repaired after one listing."""

NAMELESS_FOR = 60.0
"""Seconds after which another mount that moved an old file aside is taken to have ended."""

SAME_FOR = 600.0
"""Seconds for which another mount's temporary name stayed the same, after which its mount is taken to have
ended."""

AGAIN_AFTER = 2.0
"""Seconds before a directory is listed again if that failed."""

LOST_FOR = 0.5
"""Seconds between two looks whether a lost vehicle is heard again."""

IN_FLIGHT = 60.0
"""Seconds before a directory is listed again in which something waits for the end of a flight."""


def due_in(name: TemporaryName, owner: bytes, *, target_there: bool, age: float) -> float:
    """Return in how many seconds a temporary name is to be repaired; 0 or less: now.

    owner: this mount's token. target_there: whether the name that it belongs to has a file. age: seconds
    since it was first seen as it is.
    """
    if name.owner == owner:
        return 0.0
    waits = name.kind is Kind.OLD and not target_there
    return (NAMELESS_FOR if waits else SAME_FOR) - age


class Repair:
    """Repairs what is due in each listing. Lists by itself the directories in which something is to be
    repaired, as soon as the vehicle is heard.

    Attributes:
        names: changes names.
    """

    names: Names

    def __init__(
        self,
        store: VehicleStore,
        directories: Directories,
        own: TemporaryNames,
        paths: PathLocks,
        nursery: trio.Nursery,
        is_blocked: Callable[[], bool],
        is_used: Callable[[bytes], bool],
        clock: Callable[[], float],
    ) -> None:
        """is_blocked(): whether nothing may be changed, because the vehicle is armed. is_used(path): whether
        a call of this mount uses a name, or a program of it has a new file of that name."""
        self._store = store
        self._directories = directories
        self._own = own
        self._paths = paths
        self._nursery = nursery
        self._is_blocked = is_blocked
        self._is_used = is_used
        self._clock = clock
        self._due: dict[tuple[bytes, bool], float] = {}
        self._running = False
        self._news = trio.Event()

    def list_later(self, directory: bytes, seconds: float = 0.0, *, only_in_doubt: bool = False) -> None:
        """List a directory in so many seconds, or before. only_in_doubt: only if replies are suspect by
        then."""
        key, at = (directory, only_in_doubt), self._clock() + seconds
        if only_in_doubt:
            self._due[key] = max(at, self._due.get(key, at))
        else:
            self._due[key] = min(at, self._due.get(key, at))
        self._start()

    def follow_rename(self, old: bytes, new: bytes) -> None:
        """Note that a directory has another name: what is to be listed, and the old files of this mount."""
        self._due = {(renamed(path, old, new), doubt): at for (path, doubt), at in self._due.items()}
        for directory in self._own.follow_rename(old, new):
            self.list_later(directory)

    def retry(self) -> None:
        """Do at once what waits for the vehicle or for the end of a flight: there is news of the vehicle."""
        now = self._clock()
        self._due = {key: at if key[1] else now for key, at in self._due.items()}
        self._news.set()

    async def finish(self) -> None:
        """Repair everything of this mount: it ends. A directory that cannot be listed is left alone."""
        doubt = self._store.in_doubt()
        ours = self._own.needed.keys() | self._own.targets.keys()
        directories = {split(path)[0] for path in ours}
        directories |= {directory for directory, only_in_doubt in self._due if doubt or not only_in_doubt}
        self._own.needed.clear()
        self._due.clear()
        for directory in directories:
            await self._list(directory)

    async def on_swept(self, path: bytes, directory: Directory) -> None:
        """Repair what a listing shows. Raises no MavftpfsError: the listing is valid even if this fails."""
        if directory is not self._directories.known(path):
            # The listing began before an interrupted change of this mount, and proves nothing.
            self.list_later(path, AGAIN_AFTER)
            return
        found = self._see(path, directory)
        waits = [seconds for _, _, seconds in found if seconds > 0.0]
        if waits:
            self.list_later(path, min(waits))
        for left, name, seconds in found[:MOST_AT_ONCE]:
            is_gone = split(left)[1] not in directory.entries  # a program removed it, or moved over it
            if seconds > 0.0 or is_gone or self._own.is_needed(left, self._clock()):
                continue
            self._own.needed[left] = inf  # by this call: those for other listings leave it alone
            try:
                again = await self._repair(left, name, directory)
            except MavftpfsError as error:
                log.info("%r is cleaned up at a later listing: %s", path, error)
                self.list_later(path, AGAIN_AFTER)
                return
            finally:
                self._own.release(left)
            if again:
                self.list_later(path, again)

    # --- inside

    def _see(self, path: bytes, directory: Directory) -> list[tuple[bytes, TemporaryName, float]]:
        """Return the temporary names in a listing, those of old files first, each with the seconds until it
        is to be repaired."""
        own, now, seen, found = self._own, self._clock(), directory.seen, []
        for entry in directory.entries.values():
            name, left = parse(entry.name), join(path, entry.name)
            if name is None or (entry.kind is EntryKind.DIRECTORY and name.kind is Kind.NEW):
                continue
            there = split(self._target(left, name))[1] in directory.entries
            looks = (entry.size, there)
            if seen.get(entry.name, (None, 0.0))[0] != looks:
                seen[entry.name] = looks, now
            seconds = due_in(name, own.owner, target_there=there, age=now - seen[entry.name][1])
            seconds = max(seconds, own.needed.get(left, now) - now)
            if seconds < inf and (there or directory.complete or name.kind is Kind.NEW):
                found.append((left, name, seconds))
        for gone in seen.keys() - directory.entries.keys():
            del seen[gone]
        return sorted(found, key=lambda one: one[1].kind is not Kind.OLD)

    def _target(self, left: bytes, name: TemporaryName) -> bytes:
        """Return the path that an old file is to get."""
        told = self._own.target_of(left, name)
        return told or join(split(left)[0], _recovered(name))

    async def _repair(self, left: bytes, name: TemporaryName, directory: Directory) -> float:
        """Remove what is left, or give it its name; return 0.0, or in how many seconds that is to be tried,
        because it waits for the end of a flight, or for a program that is using its name, or because a newer
        listing was remembered: this one lacks what changed since."""
        if directory is not self._directories.known(split(left)[0]):
            return AGAIN_AFTER
        target, ours = self._target(left, name), name.owner == self._own.owner
        waits = name.kind is Kind.OLD and split(target)[1] not in directory.entries
        if self._is_blocked() and not (ours and waits):
            return IN_FLIGHT
        if directory.entries[split(left)[1]].kind is EntryKind.DIRECTORY and not waits:
            target, waits = join(split(left)[0], _recovered(name)), True
        if not waits:
            await self.names.remove_if_there(left)
        elif self._is_used(target):
            return AGAIN_AFTER
        else:
            async with self._paths.hold(target):  # or a delivery could give a new file the name first
                log.warning("%r was left by an interruption: renaming it to %r", left, target)
                await self.names.rename(left, target, completes=ours)
        return 0.0

    def _start(self) -> None:
        self._news.set()
        if not self._running:
            self._running = True
            self._nursery.start_soon(self._run)

    async def _run(self) -> None:
        """List, as long as there is something to."""
        try:
            while self._due:
                self._news, lost = trio.Event(), self._store.why_lost() is not None
                left = min(self._due.values()) - self._clock()
                with trio.move_on_after(LOST_FOR if lost else max(0.0, left)):
                    await self._news.wait()
                if self._store.why_lost() is None:
                    await self._do_due(self._clock())
        finally:
            self._running = False

    async def _do_due(self, now: float) -> None:
        for key in [key for key, at in self._due.items() if at <= now]:
            directory, only_in_doubt = key
            if self._due.pop(key, None) is not None and (not only_in_doubt or self._store.in_doubt()):
                await self._list(directory)

    async def _list(self, directory: bytes) -> None:
        try:
            await self._directories.ask(directory)
        except (NotFound, NotADirectory):
            pass
        except MavftpfsError as error:
            log.info("%r is repaired at a later listing: %s", directory, error)
            self.list_later(directory, AGAIN_AFTER)


def _recovered(name: TemporaryName) -> bytes:
    return b"recovered-o" + name.serial
