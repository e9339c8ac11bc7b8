"""A file of this mount is an object: handles keep it when it is renamed, or removed. Layer: cache.

A file has one content, a state, and a base: what the vehicle is known to have under its name. All
handles of a file share them. TRANSITIONS is the table of the states.

    CLEAN    the vehicle has the content
    DIRTY    the vehicle lacks some of the content: the changes are pending
    STALE    others replaced the vehicle's file below pending changes, which cannot be delivered; the file
             keeps its name here until a program empties or removes it
    DEAD     the name is another file's, and nothing is pending: handles get FileChanged
    BROKEN   a program was told that a write failed, so no byte of the file is committed

A file that is DEAD or BROKEN has no name, and no event mends it. A file that is CLEAN or DIRTY has none if
this mount removed it, or put another one in its place: its handles go on with what was written here.

What a delivery may replace under the file's name follows from the base, and from how many bytes of it are to
stay; see Replaces.

Two facts stand beside the state. `unsure`: what this mount was committing under the name when an interruption
hid the outcome; `looking` finds it out. `proven_at`: when the vehicle last proved that it has the base. That
proof is void if it is older than the file's last opening on the vehicle, or than the mount's epoch (`card`).

Locks: see `pathlocks`. A file's lock is taken before the path lock.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from enum import Enum
from math import inf

import trio

from mavftpfs.cache.blocks import NEVER, BlockCache, Blocks
from mavftpfs.cache.content import Content
from mavftpfs.cache.items import Folder, Item
from mavftpfs.cache.remote import Upload
from mavftpfs.cache.unsure import Unsure
from mavftpfs.shared.errors import FileBusy, FileChanged, LocalProtocolError, MavftpfsError, WriteFailed
from mavftpfs.shared.sameness import Known
from mavftpfs.shared.sending import SendBuffer


class State(Enum):
    """The state of a file on the vehicle; see the module."""

    CLEAN = "clean"
    DIRTY = "dirty"
    STALE = "stale"
    DEAD = "dead"
    BROKEN = "broken"


class Event(Enum):
    """An event in the life of a file.

    CHANGED: a program made it, wrote or truncated it. EMPTIED: a program truncated it to nothing, so the base
    does not matter. COMMITTED: the vehicle has all of it under its name, verified. REPLACED: others replaced
    the vehicle's file, and bytes of that matter. DROPPED: the pending changes were forgotten. FAILED: a write
    was answered with an error after others had been taken.
    """

    CHANGED = "changed"
    EMPTIED = "emptied"
    COMMITTED = "committed"
    REPLACED = "replaced"
    DROPPED = "dropped"
    FAILED = "failed"


TRANSITIONS: dict[State, dict[Event, State]] = {
    State.CLEAN: {
        Event.CHANGED: State.DIRTY,
        Event.EMPTIED: State.DIRTY,
        Event.REPLACED: State.DEAD,
    },
    State.DIRTY: {
        Event.CHANGED: State.DIRTY,
        Event.EMPTIED: State.DIRTY,
        Event.COMMITTED: State.CLEAN,
        Event.REPLACED: State.STALE,
        Event.DROPPED: State.DEAD,
        Event.FAILED: State.BROKEN,
    },
    State.STALE: {
        Event.EMPTIED: State.DIRTY,
        Event.REPLACED: State.STALE,
        Event.DROPPED: State.DEAD,
    },
    State.DEAD: {},
    State.BROKEN: {},
}
"""State -> what may happen -> the next state. Anything else is a bug (LocalProtocolError)."""


class Replaces(Enum):
    """The thing that a delivery of a file may replace under its name.

    NOTHING: the vehicle has no file of it, so the name has to be free. BASE: bytes of the base stay, so the
    base has to be there still. ANYTHING: whatever has the name by then, because a program emptied the file,
    or because the card, which cannot rename, may have a part of the file under its own name.
    """

    NOTHING = "nothing"
    BASE = "base"
    ANYTHING = "anything"


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """One try to send a file.

    path: where its bytes go: a temporary file, or the file's own name if it is sent `in_place`. begun_at:
    when it began, by the caches' clock.
    """

    path: bytes
    in_place: bool
    sending: SendBuffer
    upload: Upload
    begun_at: float

    def fits(self, *, in_place: bool) -> bool:
        """Return whether a delivery may continue the attempt: no program changed a byte that was sent, and
        the card still takes the file at the same place."""
        return not self.sending.invalidated and in_place == self.in_place


class File(Item):
    """One file.

    Attributes:
        content: its bytes. state: see State.
        base: what the vehicle is known to have under its name; None if it has nothing there.
        proven_at: when the vehicle was last seen to have that, by the caches' clock. fresh_at: when it was
            last opened or delivered, so that no byte here is older.
        attempt: the attempt to send it that is under way.
        unsure: what this mount commits under the name, from the first request for that until it is known
            what has the name.
        has_part: an attempt in place ended, so the card may have a part of the file under its name.
        changes: counts the changes of the content. failed_changes: what that was when a delivery last failed.
        error: why the last delivery failed, or the write that broke the file.
        handles: how many are open; writers: how many of them may write. changers: the open handles that
            wrote to the file, or truncated it, since the vehicle last had all of it.
        verified: see OpenFile.verified.
        delivered_since_open: it was delivered since its first writer opened it.
        start_after: no upload begins by itself before that time (infinite: only a close sends the file).
        in_kernel: the kernel may have pages of it, and none is of an older version.
        lock: a program changes the file, it is being delivered, or a call takes its name or content away.
        delivery: the scope of the delivery that is under way. preempting: how many calls wait
            for the lock to take the name or the content away; they go before deliveries.
    """

    def __init__(self, folder: Folder, name: bytes, cache: BlockCache) -> None:
        super().__init__(folder, name)
        self.content = Content(Blocks(cache))
        self.state = State.CLEAN
        self.base: Known | None = None
        self.proven_at = self.fresh_at = NEVER
        self.attempt: Attempt | None = None
        self.error: MavftpfsError | None = None
        self.handles = self.writers = 0
        self.changers: set[object] = set()
        self.unsure: Unsure | None = None
        self.has_part = False
        self.changes = 0
        self.failed_changes = -1
        self.verified = ""
        self.delivered_since_open = False
        self.start_after = -inf
        self.in_kernel = False
        self.lock = trio.Lock()
        self.delivery: trio.CancelScope | None = None
        self.preempting = 0

    # --- what it is

    @property
    def blocks(self) -> Blocks:
        """The bytes read of the vehicle's file."""
        return self.content.blocks

    @property
    def is_local(self) -> bool:
        """See Item."""
        return self.content.spooled is not None

    @property
    def undelivered(self) -> bool:
        """Whether the vehicle lacks something of it that it should have."""
        return self.state in (State.DIRTY, State.STALE) and self.has_name

    @property
    def broken(self) -> bool:
        """Whether a write of it failed."""
        return self.state is State.BROKEN

    @property
    def is_new_and_empty(self) -> bool:
        """Whether the vehicle has no file of it yet, and nothing was written to it."""
        return self.is_local and self.base is None and not self.content.size

    @property
    def replaces(self) -> Replaces:
        """The thing that a delivery of it may replace now."""
        if self.lies_in_place:
            return Replaces.ANYTHING
        if self.base is None:
            return Replaces.NOTHING
        return Replaces.BASE if self.content.keeps_base else Replaces.ANYTHING

    @property
    def lies_in_place(self) -> bool:
        """Whether an upload to the file's own name (on a card that cannot rename) may have begun to write:
        the name may have a part of the new file, or an old file that this mount emptied."""
        if self.has_part:
            return True
        if self.attempt is None or not self.attempt.in_place:
            return False
        # A new file counts once bytes went out: CreateFile was ACKed. An old one may be emptied before that.
        sending = self.attempt.sending
        return sending.handed_out > 0 if self.base is None else sending.begun

    @property
    def unacked(self) -> int:
        """Bytes that are to be sent, and not ACKed yet. A file is sent as a whole."""
        if self.attempt is not None and not self.attempt.sending.invalidated:
            return self.attempt.sending.unacked
        return self.content.size if self.state is State.DIRTY else 0

    @property
    def size(self) -> int:
        """Bytes, as programs see it."""
        return self.content.size

    def crc32(self) -> int:
        """Return the CRC32 of whole content. Raises SpoolFailed."""
        return self.content.crc32()

    def changed_since(self, unsure: Unsure) -> bool:
        """Return whether a program changed the file since that was sent."""
        return self.changes != unsure.changes

    def require_alive(self) -> None:
        """Raise FileChanged if no handle may read the file, nor empty it."""
        if self.state is State.DEAD:
            raise FileChanged(f"{self.path!r} was replaced on the vehicle")

    def require_not_stale(self) -> None:
        """Raise FileChanged if others replaced the vehicle's file, so that no program may change this one."""
        self.require_alive()
        if self.state is State.STALE:
            raise FileChanged(f"{self.path!r} is another file by now")

    def require_base(self) -> None:
        """Raise FileChanged unless the vehicle's file of this name is the file's own."""
        self.require_not_stale()
        if not self.has_name:
            raise FileChanged(f"what was {self.path!r} is gone from the vehicle")

    def require_not_broken(self) -> None:
        """Raise WriteFailed if a write of it failed."""
        if self.broken:
            raise WriteFailed(
                f"nothing written to {self.path!r} reaches the card, because a write failed: {self.error}"
            )

    # --- what happens to it

    def on(self, event: Event) -> None:
        """Go to the next state.

        Raises:
            LocalProtocolError: that cannot happen now.
        """
        after = TRANSITIONS[self.state].get(event)
        if after is None:
            raise LocalProtocolError(f"a file that is {self.state.value} cannot be {event.value}")
        self.state = after

    def forget_content(self) -> None:
        """Forget every byte; an upload that is under way sends no more of them."""
        if self.attempt is not None:
            self.attempt.sending.on_changed(0, 0)
        self.content.forget()

    def prove(self, at: float) -> None:
        """Note that the vehicle's file of this name was seen to be the base at that time."""
        self.proven_at = max(self.proven_at, at)

    @asynccontextmanager
    async def preempt(self, patience: float) -> AsyncIterator[None]:
        """Hold the lock while the body removes, renames or empties the file. A delivery that is under way is
        cancelled first, and its caller begins it again later. Exception: a file that is being committed is
        waited for.

        Raises:
            FileBusy: the file was not committed within `patience` seconds.
        """
        self.preempting += 1
        try:
            if self.delivery is not None:
                self.delivery.cancel()
            with trio.move_on_after(patience) as scope:
                await self.lock.acquire()
            if scope.cancelled_caught:
                raise FileBusy(f"{self.path!r} is just getting its name on the vehicle")
        finally:
            self.preempting -= 1
        try:
            yield
        finally:
            self.lock.release()
