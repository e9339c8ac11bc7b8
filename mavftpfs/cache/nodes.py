"""Files that are open or not delivered yet, by path. Layer: cache.

A node is one file of this mount, whatever its name: handles follow it when it is renamed, and keep it when
it is unlinked. Nodes without handles and without anything to deliver are forgotten.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field

import trio

from mavftpfs.cache.asides import Places
from mavftpfs.cache.draft import Draft
from mavftpfs.cache.files import FileHandle
from mavftpfs.cache.plan import Plan
from mavftpfs.cache.remote import Upload
from mavftpfs.cache.sending import Sending
from mavftpfs.cache.spool import SpoolContent
from mavftpfs.shared.errors import FileChanged, MavftpfsError


@dataclass(slots=True, eq=False)
class Attempt:
    """One try to deliver a draft.

    path: where its bytes go. places: the reserved names, for a replacement. ended: verified, and the upload
    is over, or nobody waits for that. committing: the renames may have begun, too. begun_at: when that was
    known of which a part is to stay.
    """

    plan: Plan
    path: bytes
    sending: Sending
    upload: Upload
    places: Places | None = None
    ended: bool = False
    committing: bool = False
    begun_at: float = float("-inf")

    def fits(self, plan: Plan, draft: Draft) -> bool:
        """Return whether going on ends with the draft's content on the vehicle, by that plan."""
        sending = self.sending
        if self.ended and sending.unacked:
            return False
        return (
            self.plan is plan
            and draft.sending is sending
            and not sending.emptied
            and sending.reached <= draft.size
        )


@dataclass(slots=True, eq=False)
class Node:
    """One file.

    path: its name, or the reserved name it was hidden under. draft: what the vehicle does not have of it;
    content: the draft's bytes. copied: the draft is only a copy, made because the name was to go. handles:
    how many are open, writers: those for writing. generation: counts how often its content on the vehicle was
    changed by us. removed: it has no name any more. hidden: it is still on the vehicle under a reserved name.
    error: why it could not be delivered. quiet: no delivery is under way, so it may be written. lock: held to
    deliver it and to change its path. starting: a background upload is about to begin. background: whether
    it may begin by itself; start_after: not before.
    base: reads the vehicle's file. known_at: when the vehicle was last known to have it all. doomed: how
    many changes that take its name away have the lock, or are about to, or empty it: no delivery begins or
    goes on.
    looked_at: who has the lock changes nothing on the vehicle just now. parted: its name is another file's.
    mtime: what a listing since then told, None before there is one. dating: somebody sees to that.
    may_be_cut: we may have cut it since then. written_at: when a program changed it last. resting: delivers
    what was sent so far while no program writes; who writes cancels it.
    """

    path: bytes
    draft: Draft | None = None
    content: SpoolContent | None = None
    copied: bool = False
    handles: int = 0
    writers: int = 0
    generation: int = 0
    removed: bool = False
    hidden: bool = False
    error: MavftpfsError | None = None
    attempt: Attempt | None = None
    base: FileHandle | None = None
    starting: bool = False
    background: bool = True
    start_after: float = float("-inf")
    known_at: float = float("-inf")
    lock: trio.Lock = field(default_factory=trio.Lock)
    quiet: trio.Event = field(default_factory=trio.Event)
    doomed: int = 0
    looked_at: int = 0
    parted: bool = False
    mtime: int | None = None
    dating: bool = False
    may_be_cut: bool = False
    written_at: float = float("-inf")
    resting: trio.CancelScope | None = None
    _delivery: trio.CancelScope | None = None
    _firm: int = 0

    def __post_init__(self) -> None:
        self.quiet.set()

    @property
    def undelivered(self) -> bool:
        """Whether the vehicle lacks something of it that it should have."""
        return self.draft is not None and not self.removed and not self.draft.clean

    @property
    def needless(self) -> bool:
        """Whether nobody has it open, and the vehicle has it."""
        return not self.handles and not self.undelivered

    @property
    def overtaken(self) -> bool:
        """Whether its attempt may not go on, since the draft took another way."""
        return (
            self.attempt is not None
            and self.draft is not None
            and self.draft.sending is not self.attempt.sending
        )

    @contextmanager
    def delivering(self) -> Iterator[trio.CancelScope]:
        """The body brings it to the vehicle, unless it is cancelled because the name goes (`dooming`), or
        the content (`call_off`)."""
        with trio.CancelScope() as scope:
            self._delivery = scope
            self._heed()
            try:
                yield scope
            finally:
                self._delivery = None

    @asynccontextmanager
    async def firmly(self) -> AsyncIterator[None]:
        """The body is short, and nobody would find what it leaves half done: it is called off before it, or
        not at all."""
        await trio.lowlevel.checkpoint_if_cancelled()  # else the body would be, at its first wait
        self._firm += 1
        try:
            yield
        finally:
            self._firm -= 1
            self._heed()

    @contextmanager
    def looking(self) -> Iterator[None]:
        """The body has the lock and changes nothing on the vehicle: what is found there is as others left it,
        or as it was changed by us before."""
        self.looked_at += 1
        try:
            yield
        finally:
            self.looked_at -= 1

    def end_rest(self) -> None:
        """Its program goes on: what delivers it for nobody is called off, unless it is all but done."""
        if self.resting is not None and not self._firm:
            self.resting.cancel()

    @contextmanager
    def dooming(self) -> Iterator[None]:
        """The body takes the lock, and then the name away: what is being delivered of it is called off."""
        self.doomed += 1
        self._heed()
        try:
            yield
        finally:
            self.doomed -= 1

    async def call_off(self) -> None:
        """Have what is being delivered of it called off, since its content is about to go: who waits for the
        delivery has it begin again then. When this returns nothing is delivered before the next wait."""
        with self.dooming():
            while not self.quiet.is_set():  # the next one may have begun while we woke up
                await self.quiet.wait()

    def _heed(self) -> None:
        if self.doomed and not self._firm and self._delivery is not None:
            self._delivery.cancel()

    def require_reachable(self) -> None:
        """Raise FileChanged if its path may be another file's: it was replaced or removed, not hidden."""
        if self.removed and not self.hidden:
            raise FileChanged(f"what was {self.path!r} is not on the vehicle any more")

    def require_not_parted(self) -> None:
        """Raise FileChanged if its name is another file's: what is written would not come to the vehicle, and
        what is read would get among the kernel's pages of that."""
        if self.parted:
            raise FileChanged(f"{self.path!r} is another file by now")

    def close_base(self) -> None:
        """The vehicle's file is another one, or is not needed."""
        base, self.base = self.base, None
        if base is not None:
            base.close()

    def spool_name(self) -> str | None:
        """Return what the local disk is told of it: its path, or None if nobody would miss it."""
        return None if self.removed else self.path.decode(errors="surrogateescape")

    def lose_name(self) -> None:
        """It has no name any more; only who has it open needs its bytes."""
        self.removed = True
        if self.content is not None:
            self.content.restate()

    def drop_draft(self) -> None:
        """The vehicle has it all, or nobody wants it."""
        self.close_base()
        if self.content is not None:
            self.content.close()
        self.draft = self.content = self.attempt = self.error = None
        self.background, self.copied = True, False
        self.known_at, self.mtime, self.may_be_cut = float("-inf"), None, False


class Nodes:
    """All nodes that have a name."""

    def __init__(self) -> None:
        self._by_path: dict[bytes, Node] = {}

    def __iter__(self) -> Iterator[Node]:
        """Yield every node; changing paths meanwhile is fine."""
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
        """Forget a node that nobody needs; an attempt has to be called off first."""
        if node.needless and not node.lock.locked() and node.attempt is None:
            node.drop_draft()
            if self._by_path.get(node.path) is node:
                del self._by_path[node.path]

    def detach(self, node: Node) -> None:
        """The node's path is not its name any more."""
        if self._by_path.get(node.path) is node:
            del self._by_path[node.path]

    def rename(self, old: bytes, new: bytes) -> None:
        """Nodes at `old` and below it have another path; `new` must have no nodes."""
        for node in self.below(old):
            del self._by_path[node.path]
            node.path = new + node.path[len(old) :]
            self._by_path[node.path] = node
