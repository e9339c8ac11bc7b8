"""What programs see that no listing shows: drafts, local names, and times that users set. Layer: cache."""

from __future__ import annotations

from collections.abc import Mapping

from mavftpfs.cache.attributes import SECOND, Stat, Times, shown, shown_mtime
from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Draft, State
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.reserved import is_reserved
from mavftpfs.shared.errors import (
    NotFound,
)
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
        """Return what is known better here than by any listing, None if the listing decides.

        Raises:
            NotFound: a reserved name.
        """
        if is_reserved(split(path)[1]):
            raise NotFound(f"{path!r} is a name of our own")
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
            return None  # `overlay` shows it
        known = self.times.get(path, size, mtime)
        return None if known is None else shown(known)

    def overlay(self, directory: bytes, listed: Mapping[bytes, Stat]) -> dict[bytes, Stat]:
        """Return a listing with our own names hidden, and with what the vehicle does not have yet."""
        entries = {name: stat for name, stat in listed.items() if not is_reserved(name)}
        paths = [node.path for node in self._context.nodes if node.draft is not None]
        for path in paths:
            parent, name = split(path)
            stat = self.stat(path) if parent == directory else None
            if stat is not None:
                entries[name] = stat
        return entries

    def on_written(self, path: bytes) -> None:
        """A file's content changed: it is of now, also where no listing tells times."""
        self.times.set(path, int(self._context.wall() * SECOND))

    # --- inside

    def _draft_time(self, node: Node, draft: Draft) -> tuple[int, int]:
        known = self.times.peek(node.path)
        if known is not None:
            return shown(known)
        entry = self._context.dentries.entry(node.path)
        listed = entry.mtime if entry is not None and draft.state is State.CLEAN else None
        return shown_mtime(node.path, listed), 0
