"""What programs see that no listing shows: drafts, local names, and times that users set. Layer: cache."""

from __future__ import annotations

from mavftpfs.cache.attributes import SECOND, Stat, Times, shown, shown_mtime
from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Draft, State
from mavftpfs.cache.nodes import Node
from mavftpfs.shared.model import EntryKind, split


class Overlay:
    """Lies over the vehicle's listings. Paths are the vehicle's.

    Attributes:
        times: mtimes that the vehicle cannot be told.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self.times = Times()

    def stat(self, path: bytes) -> Stat | None:
        """Return what is known better here than by any listing, None if the listing decides."""
        node = self._context.nodes.get(path)
        if node is None or node.draft is None:
            return None
        seconds, nanoseconds = self._draft_time(node, node.draft)
        return Stat(EntryKind.FILE, node.draft.size, seconds, self._context.options.attr_timeout, nanoseconds)

    def shown_time(self, path: bytes, size: int, mtime: int | None) -> tuple[int, int] | None:
        """Return the (seconds, nanoseconds) that a user set for a listed path, None if there are none.

        A listing says nothing of a file that is being written: not which size and mtime go with what was set.
        """
        node = self._context.nodes.get(path)
        if node is not None and node.draft is not None:
            return None  # `stat` shows it
        known = self.times.get(path, size, mtime)
        return None if known is None else shown(known)

    def lay_over(self, directory: bytes, entries: dict[bytes, Stat]) -> None:
        """Add to a listing what the vehicle does not have yet."""
        for node in self._context.nodes:
            parent, name = split(node.path)
            stat = self.stat(node.path) if parent == directory else None
            if stat is not None:
                entries[name] = stat

    def on_written(self, path: bytes) -> None:
        """A file's content changed: it is of now, also where no listing tells times."""
        self.times.set(path, int(self._context.wall() * SECOND))

    # --- inside

    def _draft_time(self, node: Node, draft: Draft) -> tuple[int, int]:
        known = self.times.peek(node.path)
        if known is not None:
            return shown(known)
        entry = self._context.directories.entry(node.path)
        listed = entry.mtime if entry is not None and draft.state is State.CLEAN else None
        return shown_mtime(node.path, listed), 0
