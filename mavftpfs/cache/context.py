"""What the parts of the writing half share. Layer: cache."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

from mavftpfs.cache.attributes import SECOND, Times
from mavftpfs.cache.directories import Directories, Directory
from mavftpfs.cache.draft import State
from mavftpfs.cache.files import Files
from mavftpfs.cache.nodes import Nodes
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.pathlocks import PathLocks
from mavftpfs.cache.remote import VehicleStore
from mavftpfs.cache.reserved import OwnNames
from mavftpfs.cache.spool import Spool
from mavftpfs.shared import readonly
from mavftpfs.shared.errors import Armed, FileBusy
from mavftpfs.shared.model import DirEntry, EntryKind, split
from mavftpfs.shared.sameness import Listed, Sameness, compare


class ListLater(Protocol):
    """See repair.Repair.list_later."""

    def __call__(self, directory: bytes, seconds: float = 0.0, *, only_in_doubt: bool = False) -> None: ...


@dataclass(slots=True)
class Context:
    """The vehicle, what is remembered of it, and the files that are open or not delivered.

    clock: seconds, monotonic; wall: seconds since 1970. paths: see pathlocks. times: mtimes that the vehicle
    cannot be told. blocked: nothing may be changed, because the vehicle is armed (only
    Writeback.armed_changed sets it). retry_later(): to be called when something was not delivered; it is
    tried again. list_later(directory), look_later(): see repair.Repair.
    """

    store: VehicleStore
    directories: Directories
    files: Files
    nodes: Nodes
    options: CacheOptions
    clock: Callable[[], float]
    wall: Callable[[], float]
    own: OwnNames
    paths: PathLocks
    spool: Spool
    retry_later: Callable[[], None]
    list_later: ListLater
    look_later: Callable[[], None]
    times: Times = field(default_factory=Times)
    blocked: bool = False

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

    def touch(self, path: bytes) -> None:
        """Give a file that changed the present time, also where no listing tells times."""
        self.times.set(path, int(self.wall() * SECOND))

    async def entry(self, path: bytes) -> DirEntry | None:
        """Return what a path is, drafts included; None if it does not exist though its directory does.

        Raises:
            NotFound, NotADirectory: its directory. Else as RemoteStore.list_directory.
        """
        node, (parent, name) = self.nodes.get(path), split(path)
        if node is not None and node.draft is not None and node.draft.state is not State.STALE:
            return DirEntry(name, EntryKind.FILE, node.draft.size)
        return (await self.directories.get(parent)).entries.get(name)

    def on_listed(self, path: bytes, directory: Directory) -> None:
        """Find in a new listing which files others replaced since they were opened or delivered here."""
        for node in self.nodes:
            parent, name = split(node.path)
            entry = directory.entries.get(name) if parent == path else None
            draft = node.draft
            if entry is None or draft is None or draft.base is None or directory.listed_at <= node.proven_at:
                continue
            if self.nodes.is_changing(node.path) or draft.state not in (State.CLEAN, State.DIRTY):
                continue
            if compare(draft.base, Listed(entry)) is Sameness.OTHER:
                self.files.on_replaced(node.path)
            elif draft.base.mtime is None and entry.size == draft.base.size:
                draft.base = replace(draft.base, mtime=entry.mtime)
