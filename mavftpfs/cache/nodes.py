"""Files that are open or not delivered yet, by path. Layer: cache.

A node is one file of this mount, whatever its name: handles follow it when it is renamed, and keep it when
it is unlinked. Nodes without handles and without anything to deliver are forgotten.

Locks: see `pathlocks`. A node's lock is taken before the path lock.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import trio

from mavftpfs.cache.draft import Draft, State
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.remote import Upload
from mavftpfs.cache.spool import Spool, SpoolContent
from mavftpfs.cache.unsure import Unsure
from mavftpfs.shared.errors import FileBusy, FileChanged, MavftpfsError, WriteFailed
from mavftpfs.shared.model import rename_keys
from mavftpfs.shared.sameness import Known
from mavftpfs.shared.sending import SendBuffer


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """One try to deliver a draft.

    path: where its bytes go: a reserved name, or the file's own if it is sent `in_place`. begun_at: when it
    began, by the caches' clock.
    """

    path: bytes
    in_place: bool
    sending: SendBuffer
    upload: Upload
    begun_at: float

    def fits(self, draft: Draft, *, in_place: bool) -> bool:
        """Return whether the bytes that it sent are still right, and the place that they go to."""
        if self.sending is not draft.sending or self.sending.overtaken:
            return False
        return in_place == self.in_place


@dataclass(slots=True, eq=False)
class Node:
    """One file.

    path: its name, or its last one. draft: its content here, if it was written. handles: how many are open;
    writers: how many of them are for writing. generation: counts how often it was delivered;
    delivered_since_open: since its first writer opened it. removed: it has no name any more. error: why the
    last delivery failed, or the write that broke the file. unsure: what was being placed when that was
    interrupted. attempt: the present attempt to deliver it.
    base_handle: on the vehicle's file below the draft. start_after: no upload begins by itself before that
    time (infinite: only a close sends the file). proven_at: when the vehicle was last proven to have what the
    draft says it has. lock: a program writes the file, a delivery is under way, or a call takes its name
    away. delivery: the scope of the delivery under way. claims: how many calls wait for the lock to take its
    name or content away; they go before deliveries.
    """

    path: bytes
    draft: Draft | None = None
    handles: int = 0
    writers: int = 0
    generation: int = 0
    delivered_since_open: bool = False
    removed: bool = False
    error: MavftpfsError | None = None
    unsure: Unsure | None = None
    attempt: Attempt | None = None
    base_handle: OpenFile | None = None
    start_after: float = float("-inf")
    proven_at: float = float("-inf")
    lock: trio.Lock = field(default_factory=trio.Lock)
    delivery: trio.CancelScope | None = None
    claims: int = 0

    @property
    def undelivered(self) -> bool:
        """Whether the vehicle lacks something of it that it should have."""
        return self.draft is not None and not self.removed and self.draft.state is not State.CLEAN

    @property
    def is_new_and_empty(self) -> bool:
        """Whether the vehicle has no file of it yet, and nothing was written to it."""
        return self.draft is not None and self.draft.base is None and not self.draft.size

    @property
    def broken(self) -> bool:
        """Whether a write of it failed, so that nothing of it reaches the card."""
        return self.draft is not None and self.draft.state is State.BROKEN

    @property
    def changing(self) -> bool:
        """Whether we are changing the file that has its name on the vehicle (see Nodes.is_changing)."""
        draft, attempt = self.draft, self.attempt
        if self.unsure is not None or (attempt is not None and attempt.in_place):
            return True
        return draft is not None and draft.sent_in_place

    # --- as cache.unsure.Placeable

    @property
    def base(self) -> Known | None:
        """The vehicle's file that it changes, None if it is a new one."""
        return None if self.draft is None else self.draft.base

    @base.setter
    def base(self, known: Known | None) -> None:
        if self.draft is not None:
            self.draft.base = known
            if known is None:
                self.draft.base_limit = 0

    @property
    def changes(self) -> int:
        """How often its content changed."""
        return 0 if self.draft is None else self.draft.changes

    def crc32(self) -> int:
        """Return the CRC32 of its content, all of which is here. Raises SpoolFailed."""
        return 0 if self.draft is None else self.draft.crc32()

    @asynccontextmanager
    async def claim(self, patience: float) -> AsyncIterator[None]:
        """Hold the lock for a body that takes the name or the content away.

        A delivery under way is cancelled, and its caller begins it again later. Exception: once the delivery
        has begun to change the name, it is waited for.

        Raises:
            FileBusy: it did not end within `patience` seconds.
        """
        self.claims += 1
        try:
            if self.delivery is not None:
                self.delivery.cancel()
            with trio.move_on_after(patience) as scope:
                await self.lock.acquire()
            if scope.cancelled_caught:
                raise FileBusy(f"{self.path!r} is just getting its name on the vehicle")
        finally:
            self.claims -= 1
        try:
            yield
        finally:
            self.lock.release()

    def require_reachable(self) -> None:
        """Raise FileChanged if the file was replaced or removed: its path may be another file's."""
        if self.removed:
            raise FileChanged(f"what was {self.path!r} is not on the vehicle any more")

    def require_not_stale(self) -> None:
        """Raise FileChanged if its draft is stale: others replaced the base."""
        if self.draft is not None and self.draft.state is State.STALE:
            raise FileChanged(f"{self.path!r} is another file by now")

    def require_not_broken(self) -> None:
        """Raise WriteFailed if a write of it failed."""
        if self.broken:
            raise WriteFailed(
                f"nothing written to {self.path!r} reaches the card, because a write failed: {self.error}"
            )

    def close_base(self) -> None:
        """Close the handle on the vehicle's file: that is another file now, or is not needed."""
        handle, self.base_handle = self.base_handle, None
        if handle is not None:
            handle.close()

    def lose_name(self) -> None:
        """Note that it has no name any more. Only programs that have it open need its bytes."""
        self.removed = True
        if self.draft is not None:
            self.draft.content.name = None
            self.draft.content.mark_unneeded()

    def begin_draft(self, spool: Spool, base: Known | None, now: float) -> Draft:
        """Make a draft, because the file is going to be changed. base: the vehicle's file, None for a new
        one."""
        self.draft = Draft(SpoolContent(spool, self.path), base)
        self.proven_at = now
        return self.draft

    def forget_draft(self) -> None:
        """Forget the draft: the vehicle has all of it, or no program wants it."""
        self.close_base()
        if self.draft is not None:
            self.draft.content.close()
        self.draft = self.attempt = self.error = None
        self.start_after = self.proven_at = float("-inf")


class Nodes:
    """All nodes that have a name.

    Attributes:
        broken: the last broken file of each path, until
            the path gets a good file, or loses the one that it has.
    """

    def __init__(self) -> None:
        self._by_path: dict[bytes, Node] = {}
        self.broken: dict[bytes, Node] = {}
        self._stale: list[Node] = []

    def __iter__(self) -> Iterator[Node]:
        """Yield every node that has a name; changing paths meanwhile is fine."""
        return iter(list(self._by_path.values()))

    def get(self, path: bytes) -> Node | None:
        """Return the node of a path."""
        return self._by_path.get(path)

    def need(self, path: bytes) -> Node:
        """Return the node of a path, new if there is none."""
        node = self._by_path.get(path)
        if node is None:
            node = self._by_path[path] = Node(path)
        return node

    def below(self, path: bytes) -> list[Node]:
        """Return the nodes at a path and below it."""
        return [n for p, n in self._by_path.items() if p == path or p.startswith(path + b"/")]

    def maybe_forget(self, node: Node) -> None:
        """Forget a node if no program has it open and nothing of it is undelivered."""
        if not (node.handles or node.undelivered or node.lock.locked() or node.attempt):
            node.forget_draft()
            self.detach(node)

    def detach(self, node: Node) -> None:
        """Take a node away from its path."""
        if self._by_path.get(node.path) is node:
            del self._by_path[node.path]

    def unnamed(self, node: Node) -> None:
        """Note that the node's file was removed, or that another one was renamed over it."""
        node.lose_name()
        self.detach(node)
        if not node.handles:
            node.forget_draft()

    def on_broken(self, node: Node) -> None:
        """Take the name from a file of which a write failed: the file on the vehicle has it again. What was
        written is kept."""
        self.detach(node)
        node.removed = True
        self.forget_broken(node.path)
        self.broken[node.path] = node

    def forget_broken(self, path: bytes) -> None:
        """Forget what was written to a path before a write failed. Programs that have it open read on."""
        node = self.broken.pop(path, None)
        if node is not None:
            node.lose_name()
            if not node.handles:
                node.forget_draft()

    def is_changing(self, path: bytes) -> bool:
        """Return whether we are changing what the vehicle has under a path, or a change may have happened in
        part."""
        node = self._by_path.get(path)
        return node is not None and node.changing

    def on_replaced(self, path: bytes) -> bool:
        """Note that another file has the path now, or may have. Handles that are open never read that one. A
        draft that needs no byte of the old file goes on. Returns whether this took the node away."""
        node = self._by_path.get(path)
        if node is None or node.delivery is not None or node.unsure is not None:
            return False  # a delivery compares the base itself
        draft, lacks = node.draft, node.undelivered
        if draft is not None:
            draft.lose_base()
        gone = draft is None or (draft.state is State.STALE and not lacks)
        if gone:
            self.on_name_taken(node)
        return gone

    def on_name_taken(self, node: Node) -> None:
        """Note that another file has the node's name. Open handles keep the node; later opens get a new
        one."""
        self._stale = [other for other in self._stale if other.handles] + [node]
        node.lose_name()
        self.detach(node)

    def has_another(self, path: bytes) -> bool:
        """Return whether a file is still open that had this path before another file got it."""
        return any(node.path == path and node.handles for node in self._stale)

    def rename(self, old: bytes, new: bytes) -> None:
        """Move the nodes at `old` and below it to `new`, which must have no nodes."""
        rename_keys(self._by_path, old, new)
        for path, node in self._by_path.items():
            node.path = path
            if node.draft is not None:
                node.draft.content.name = path
