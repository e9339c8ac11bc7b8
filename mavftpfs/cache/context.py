"""What the parts of the writing half share. Layer: cache."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import trio

from mavftpfs.cache.asides import Namer
from mavftpfs.cache.dentries import Dentries, Directory
from mavftpfs.cache.directories import Directories
from mavftpfs.cache.files import Files
from mavftpfs.cache.nodes import Node, Nodes
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.pathlocks import PathLocks
from mavftpfs.cache.remote import RemoteStore, WriteStore
from mavftpfs.cache.versions import became_another
from mavftpfs.shared.errors import Armed, FileBusy
from mavftpfs.shared.model import split


@dataclass(slots=True)
class Context:
    """The vehicle, what is remembered of it, and what was written.

    clock: seconds, monotonic; wall: seconds since 1970. on_changed(path): a path, and what lies below it,
    was changed by us. live: reserved paths in use right now; hidden: unlinked files by their reserved path.
    garbage: reserved paths that could not be removed yet -> the path they belong to.
    torn: paths that may be missing on the vehicle though nobody removed them -> where their files lie.
    parted: files that are open and whose names are others'. armed: nothing may be changed.
    """

    store: RemoteStore
    writer: WriteStore
    directories: Directories
    dentries: Dentries
    files: Files
    options: CacheOptions
    clock: Callable[[], float]
    wall: Callable[[], float]
    on_changed: Callable[[bytes], None]
    nursery: trio.Nursery | None
    namer: Namer
    nodes: Nodes = field(default_factory=Nodes)
    live: set[bytes] = field(default_factory=set)
    hidden: dict[bytes, Node] = field(default_factory=dict)
    garbage: dict[bytes, bytes] = field(default_factory=dict)
    torn: dict[bytes, bytes] = field(default_factory=dict)
    parted: list[Node] = field(default_factory=list)
    armed: bool = False

    @property
    def paths(self) -> PathLocks:
        """Whose names are being changed, or must not be: files are opened between such changes."""
        return self.files.fetcher.paths

    def require_disarmed(self) -> None:
        """Raise Armed if nothing may be changed now."""
        if self.armed and not self.options.write_armed:
            raise Armed("the vehicle is armed: nothing is written in flight (when_armed=ro)")

    def is_changing(self, path: bytes) -> bool:
        """Return whether we are changing what the vehicle has of a path, or may have done so in part."""
        node = self.nodes.get(path)
        if node is None:
            return False
        draft, begun = node.draft, node.lock.locked() or node.attempt is not None or node.error is not None
        if draft is not None and (draft.touched or draft.ruined or draft.placed):
            return True
        return begun and not node.looked_at

    def part(self, path: bytes) -> None:
        """Who has a file open that somebody else replaced, and changed nothing of it, keeps it to himself:
        the name is the new file's."""
        node = self.nodes.get(path)
        if node is not None and node.base is not None and node.base.lost:
            self._part(node)

    def has_another(self, path: bytes) -> bool:
        """Return whether somebody has a file open that had this path, and is to read nothing of what has."""
        return self.files.was_lost(path) or any(n.path == path and n.handles for n in self.parted)

    def on_listed(self, path: bytes, directory: Directory) -> None:
        """A directory was listed: part with what others replaced since it was opened or delivered."""
        for node in self.nodes:
            parent, name = split(node.path)
            entry = directory.entries.get(name) if parent == path else None
            if entry is None or not float("-inf") < node.known_at < directory.listed_at:
                continue
            size = None if node.draft is None else node.draft.remote_end
            if size is None or self.is_changing(node.path):
                continue
            if became_another(size, node.mtime, entry):
                self._part(node)
            elif node.mtime is None and entry.size == size:
                node.mtime = entry.mtime

    def _part(self, node: Node) -> None:
        if node.undelivered or node.attempt is not None or node.lock.locked():
            return
        node.parted = True
        self.parted = [other for other in self.parted if other.handles] + [node]
        node.lose_name()
        self.nodes.detach(node)
        self.files.distrust(node.path)

    def hide(self, node: Node, path: bytes) -> None:
        """An unlinked file's node is called `path`, a reserved name, from now on."""
        self.hidden.pop(node.path, None)
        node.path, node.hidden = path, True
        self.hidden[path] = node
        self.live.add(path)

    def forget_hidden(self, node: Node) -> None:
        """An unlinked file is gone for good, or is left to the next listing."""
        node.hidden = False
        self.hidden.pop(node.path, None)
        self.live.discard(node.path)

    def follow_rename(self, old: bytes, new: bytes) -> None:
        """The vehicle renamed a file, or a directory with all below it."""
        self.files.on_renamed(old, new)
        self.nodes.rename(old, new)
        for path in [p for p in self.hidden if p.startswith(old + b"/")]:
            node = self.hidden[path]
            self.live.discard(path)
            self.hide(node, new + path[len(old) :])
        for left in (self.garbage, self.torn):
            for path in [p for p in left if p.startswith(old + b"/")]:
                left[_moved(path, old, new)] = _moved(left.pop(path), old, new)
        self.on_changed(old)
        self.on_changed(new)

    def require_idle(self, path: bytes) -> None:
        """Raise FileBusy if somebody on the vehicle seems to write the file."""
        if not self.options.force and self.dentries.is_growing(path, self.clock()):
            raise FileBusy(f"{path!r} grows: somebody on the vehicle is writing it")


def _moved(path: bytes, old: bytes, new: bytes) -> bytes:
    """Return what a path is called after a directory got another name."""
    return new + path[len(old) :] if path.startswith(old + b"/") else path
