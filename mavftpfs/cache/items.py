"""The vehicle's directories and files as a tree of objects. Layer: cache; pure.

An item knows its folder and its name, and computes its path from them. A rename moves one object, and all
that is below it moves with it, so no table has to follow. An item exists while there is something to
remember of it: a listing, an open file, cached bytes.

A file that was removed, or that another one was renamed over, keeps its folder and its last name, for
messages; its `has_name` is false then.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from mavftpfs.cache.attributes import Times
from mavftpfs.shared.errors import ListingIncomplete
from mavftpfs.shared.model import DirEntry, join, split


@dataclass(slots=True)
class Directory:
    """A remembered listing of a directory.

    entries: by name. listed_at: when the sweep began, ended_at: when it was done, by the caches' clock;
    fresh_until: after that it proves nothing. complete: the vehicle listed it to its end. end: see
    ListDirectory. sizes: sizes in bytes that replies to opens told since; they beat the listing. growing:
    when a file was last seen to be larger than before, though this mount did not write it.
    seen: of temporary names, how each looks, and since when.
    """

    entries: dict[bytes, DirEntry]
    listed_at: float
    ended_at: float
    fresh_until: float
    complete: bool
    end: int | None = None
    sizes: dict[bytes, int] = field(default_factory=dict)
    growing: dict[bytes, float] = field(default_factory=dict)
    seen: dict[bytes, tuple[tuple[int, bool], float]] = field(default_factory=dict)

    def size_of(self, name: bytes) -> int:
        """Return the best known size of a listed name in bytes."""
        return self.sizes.get(name, self.entries[name].size)

    def has(self, path: bytes) -> DirEntry | None:
        """Return the entry of a path that lies in the directory, None if there is none.

        Raises:
            ListingIncomplete: the listing shows none, and proves nothing.
        """
        entry = self.entries.get(split(path)[1])
        if entry is None and not self.complete:
            raise ListingIncomplete(f"{path!r} is not in what is known of its directory", [])
        return entry

    def put(self, name: bytes, entry: DirEntry | None) -> None:
        """Note that this mount gave the name a file or directory, or (None) removed it."""
        for facts in (self.entries, self.sizes, self.growing):
            facts.pop(name, None)
        if entry is not None:
            self.entries[name] = entry


@dataclass(slots=True, eq=False)
class Sweep:
    """A listing that is under way.

    began: by the caches' clock. changes: what this mount changed in the directory since then. void: its
    result is not to be remembered.
    """

    folder: Folder
    began: float
    changes: dict[bytes, DirEntry | None] = field(default_factory=dict)
    void: bool = False


class Item:
    """A name in a folder: a Folder, or one of the kinds of files."""

    __slots__ = ("folder", "name")

    def __init__(self, folder: Folder | None, name: bytes) -> None:
        self.folder = folder
        self.name = name

    @property
    def path(self) -> bytes:
        """The vehicle's path; the last one, if the item lost its name."""
        return self.name if self.folder is None else join(self.folder.path, self.name)

    @property
    def has_name(self) -> bool:
        """Whether the item is what its folder knows by this name."""
        return self.folder is None or self.folder.children.get(self.name) is self

    @property
    def is_local(self) -> bool:
        """Whether programs are answered from here, whatever a listing says."""
        return False

    def leave_tree(self) -> None:
        """Leave the tree; twice is harmless."""
        if self.folder is not None and self.has_name:
            del self.folder.children[self.name]

    def move(self, folder: Folder, name: bytes) -> None:
        """Get another name; an item that has it loses it."""
        self.leave_tree()
        self.folder, self.name = folder, name
        folder.children[name] = self


class Folder(Item):
    """A directory.

    Attributes:
        children: the items in it, by name. listing: what it remembered of it, None if it was not
        listed, or that was forgotten. sweep: the listing that is under way. times: mtimes that users
        set.
    """

    __slots__ = ("children", "listing", "sweep", "times")

    def __init__(self, folder: Folder | None = None, name: bytes = b"/") -> None:
        super().__init__(folder, name)
        self.children: dict[bytes, Item] = {}
        self.listing: Directory | None = None
        self.sweep: Sweep | None = None
        self.times = Times()

    def find(self, path: bytes) -> Item | None:
        """Return what a path below this folder, which is the root, names."""
        item: Item = self
        for part in path.split(b"/"):
            if part:
                child = item.children.get(part) if isinstance(item, Folder) else None
                if child is None:
                    return None
                item = child
        return item

    def find_folder(self, path: bytes) -> Folder | None:
        """As find, but None for a file."""
        entry = self.find(path)
        return entry if isinstance(entry, Folder) else None

    def need(self, path: bytes) -> Folder:
        """Return the folder of a path below this one, which is the root, made if there is none. A file in the
        way loses its name, because a listing shows a directory there, or this mount made one."""
        folder = self
        for part in path.split(b"/"):
            if part:
                child = folder.children.get(part)
                if not isinstance(child, Folder):
                    child = Folder(folder, part)
                    folder.children[part] = child
                folder = child
        return folder

    def home(self, path: bytes) -> tuple[Folder, bytes]:
        """Return the folder that a path lies in, made if there is none, and its name there."""
        parent, name = split(path)
        return self.need(parent), name

    def walk(self) -> Iterator[Item]:
        """Yield all items below this one; changing the tree meanwhile is harmless."""
        for child in list(self.children.values()):
            yield child
            if isinstance(child, Folder):
                yield from child.walk()

    def prune(self) -> None:
        """Leave the tree if there is nothing to remember, and so do the folders above."""
        known = self.children or self.listing or self.sweep or self.times
        if self.folder is not None and not known:
            self.leave_tree()
            self.folder.prune()
