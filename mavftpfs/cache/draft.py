"""What a file is to be, and how far the vehicle has it. Layer: cache; pure.

A draft lies over a base: the file as it is on the vehicle. Each byte below `size` is *held* (the spool has
it), else *base* (below `base_limit`: the vehicle has it), else zero (a gap before a write beyond the old end,
or an extension).

All handles of a path share its draft. Its state, and what may happen next, is in one table: `TRANSITIONS`;
`delivery` takes the steps. A changed file is sent as a whole new file under a reserved name beside it,
verified there, and renamed into place; on a card that cannot rename it is sent under its own name. Bytes that
are appended while it is sent join it. Writers wait while a close delivers it.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Any, Protocol

from mavftpfs.protocol.payload import crc32
from mavftpfs.shared.errors import LocalProtocolError
from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.sameness import Known
from mavftpfs.shared.sending import SendBuffer

STEP = 64 * 1024
"""Bytes read from the spool at once for a checksum."""


class State(Enum):
    """How far the vehicle has a draft.

    CLEAN: it has all of it. DIRTY: it lacks some, and nothing is sent; or all is sent, and gets its name
    (`Node.unsure`). SENDING: a new file is written under a temporary name, or under its own if the card
    cannot rename. STALE: the base is another file now. BROKEN: a program was told that a write failed, so the
    vehicle never gets the draft.
    """

    CLEAN = "clean"
    DIRTY = "dirty"
    SENDING = "sending"
    STALE = "stale"
    BROKEN = "broken"


class Event(Enum):
    """What happens to a draft.

    CHANGED: a program wrote or truncated. EMPTIED: it was truncated to nothing, so that no base matters.
    BEGUN: an attempt to send it began. ENDED: the attempt ended. PLACED: the vehicle has it, verified, under
    its name. REPLACED: others replaced the base. FAILED: a write was answered with an error after others had
    been taken.
    """

    CHANGED = "changed"
    EMPTIED = "emptied"
    BEGUN = "begun"
    ENDED = "no longer sent"
    PLACED = "placed"
    REPLACED = "replaced"
    FAILED = "failed"


TRANSITIONS: dict[State, dict[Event, State]] = {
    State.CLEAN: {
        Event.CHANGED: State.DIRTY,
        Event.EMPTIED: State.DIRTY,
        Event.REPLACED: State.STALE,
    },
    State.DIRTY: {
        Event.CHANGED: State.DIRTY,
        Event.EMPTIED: State.DIRTY,
        Event.BEGUN: State.SENDING,
        Event.PLACED: State.CLEAN,
        Event.REPLACED: State.STALE,
        Event.FAILED: State.BROKEN,
    },
    State.SENDING: {
        Event.CHANGED: State.SENDING,
        Event.EMPTIED: State.DIRTY,
        Event.ENDED: State.DIRTY,
        Event.FAILED: State.BROKEN,
    },
    State.STALE: {
        Event.EMPTIED: State.DIRTY,
    },
    State.BROKEN: {},
}
"""State -> what may happen -> the next state. Anything else is a bug (LocalProtocolError)."""


class Content(Protocol):
    """Keeps bytes by offset; see cache.spool.SpoolContent."""

    name: bytes | None

    def put(self, offset: int, data: bytes | memoryview) -> None: ...
    def get(self, start: int, stop: int) -> bytes: ...
    def cut(self, size: int) -> None: ...
    def mark_unneeded(self) -> None: ...
    def persist(self, facts: dict[str, Any]) -> str: ...
    def leave_budget(self) -> None: ...
    def close(self) -> None: ...


class Where(Enum):
    """Where a byte of the content is."""

    HELD = "held"
    BASE = "base"
    ZERO = "zero"


class Draft:
    """The local content of one file.

    Attributes:
        content: keeps what is held.
        size: bytes, as programs see it.
        base: what is known of the file on the vehicle, None if there is none.
        base_limit: below this, bytes that are not held are the base's. 0: nothing of the base stays, so the
            file is replaced whatever it has become.
        changes: counts the changes of the content.
        state: see State.
        sending: the buffer of the present attempt, only while SENDING.
        verified: see OpenFile.verified.
    """

    def __init__(self, content: Content, base: Known | None) -> None:
        self.content = content
        self.size = 0 if base is None else base.size
        self.base = base
        self.base_limit = self.size
        self.changes = 0
        self.state = State.DIRTY if base is None else State.CLEAN
        self.sending: SendBuffer | None = None
        self.verified = ""
        self._in_place = False  # the present attempt, or the last one
        self._sent_in_place = False  # by an earlier attempt
        self._held = ExtentSet()

    # --- what it is

    @property
    def whole(self) -> bool:
        """Whether all bytes of it are here."""
        return self._held.covers(0, min(self.base_limit, self.size))

    @property
    def sent_in_place(self) -> bool:
        """Whether under its own name the card may have bytes of it, or an old file that we may have emptied
        (cards that cannot rename)."""
        sending = self.sending
        if self._sent_in_place or sending is None or not self._in_place:
            return self._sent_in_place
        # A new file is ours once bytes went out: CreateFile was ACKed. An old one may be emptied before that.
        return sending.handed_out > 0 if self.base is None else sending.begun

    @property
    def unacked(self) -> int:
        """Bytes that are to be sent, and not ACKed yet. A file is sent as a whole."""
        sending = self.sending
        if sending is not None and not sending.overtaken:
            return sending.unacked
        return self.size if self.state in (State.DIRTY, State.SENDING) else 0

    @property
    def held(self) -> ExtentSet:
        """What the spool has (a copy)."""
        return ExtentSet(self._held)

    def missing_base(self) -> list[tuple[int, int]]:
        """Return the ranges of which only the vehicle has the bytes."""
        return self._held.missing(0, min(self.base_limit, self.size))

    def segments(self, start: int, stop: int) -> list[tuple[Where, int, int]]:
        """Return where each part of [start, stop) is, cut at the file's size, ascending."""
        found = []
        at, end = start, min(stop, self.size)
        for a, b in [*self._held.intersection(start, end), (end, end)]:
            if at < min(a, self.base_limit):
                found.append((Where.BASE, at, min(a, self.base_limit)))
                at = min(a, self.base_limit)
            if at < a:
                found.append((Where.ZERO, at, a))
            if a < b:
                found.append((Where.HELD, a, b))
            at = max(at, b)
        return found

    def local_bytes(self, start: int, stop: int) -> bytes:
        """Return [start, stop), no byte of which may be the base's.

        Raises:
            SpoolFailed.
        """
        parts = []
        for where, a, b in self.segments(start, stop):
            assert where is not Where.BASE
            parts.append(self.content.get(a, b) if where is Where.HELD else bytes(b - a))
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def crc32(self) -> int:
        """Return the CRC32 as the vehicle computes it (servers.md 10) of a whole draft.

        Raises:
            SpoolFailed.
        """
        value = 0
        for at in range(0, self.size, STEP):
            value = crc32(self.local_bytes(at, min(at + STEP, self.size)), value)
        return value

    # --- what programs do

    def write(self, offset: int, data: bytes | memoryview) -> None:
        """Replace bytes; a gap behind the present end becomes zeros.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        stop = offset + len(data)
        if offset == stop:
            return
        self.content.put(offset, data)
        self.on(Event.CHANGED)
        self._held.add(offset, stop)
        self._tell_changed(offset, stop)
        self.size = max(self.size, stop)

    def truncate(self, size: int) -> None:
        """Cut, or extend with zeros.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        if size == self.size and self.state is not State.STALE:
            return
        if size > self.size:
            self.on(Event.CHANGED)
            self._tell_changed(self.size, size)
        else:
            self.content.cut(size)
            if self.sending is not None:
                self.sending.on_changed(size, size)
            self.on(Event.CHANGED if size else Event.EMPTIED)
            self._held.discard(size, max(size, self._held.end))
            self.base_limit = min(self.base_limit, size)
        self.size = size

    def fill(self, offset: int, data: bytes | memoryview) -> None:
        """Hold bytes of the base, where nothing newer is held.

        Raises:
            NoSpace, SpoolFailed.
        """
        stop = min(offset + len(data), self.base_limit, self.size)
        for start, end in self._held.missing(offset, stop):
            self.content.put(start, memoryview(data)[start - offset : end - offset])
            self._held.add(start, end)

    # --- what delivery does

    def begin(self, *, in_place: bool, progress: Callable[[int], None] | None = None) -> SendBuffer:
        """Start to send a whole draft to an empty file. in_place: under the file's own name. progress: see
        SendBuffer."""
        self.on(Event.BEGUN)
        self._in_place = in_place
        self.sending = SendBuffer(self.local_bytes, self.size, progress)
        return self.sending

    def end_attempt(self) -> None:
        """Note that the attempt ended, if there is one."""
        if self.state is State.SENDING:
            self.on(Event.ENDED)

    def not_confirmed(self) -> None:
        """Note that a comparison right after the rename showed other bytes, or no file: what was placed there
        is spoilt, and the next delivery may replace it, whatever it has become. All of the draft is here.
        """
        self.base, self.base_limit = Known(self.size), 0

    def delivered(self, crc32: int | None = None) -> None:
        """Note that the vehicle has it, verified: from now on that is the base. crc32: of the content, if
        known."""
        self.on(Event.PLACED)
        self.base, self.base_limit = Known(self.size, crc32=crc32), self.size
        self._sent_in_place = False
        self.content.mark_unneeded()

    def lose_base(self, *, though_rewritten: bool = False) -> None:
        """Note that others replaced the base. That changes nothing if no byte of the base was to stay, unless
        `though_rewritten`: a change of names that was not answered may have given the name to another file,
        and this may be its only copy.
        """
        stays = self.base_limit or self.state is State.CLEAN  # CLEAN: also an empty base
        if (stays or though_rewritten) and self.state is not State.STALE:
            self.end_attempt()
            self.on(Event.REPLACED)

    def on(self, event: Event) -> None:
        """Go to the next state. The buffer of an attempt ends with SENDING.

        Raises:
            LocalProtocolError: that cannot happen now.
        """
        after = TRANSITIONS[self.state].get(event)
        if after is None:
            raise LocalProtocolError(f"a file that is {self.state.value} cannot be {event.value}")
        self.changes += event in (Event.CHANGED, Event.EMPTIED)
        self.state = after
        if after is not State.SENDING:
            self._sent_in_place, self.sending = self.sent_in_place, None

    def check_invariants(self) -> None:
        """Raise AssertionError if the books are wrong (for tests)."""
        assert self._held.end <= self.size
        assert self.base_limit <= self.size
        assert (self.sending is not None) == (self.state is State.SENDING)
        assert self.base is not None or self.base_limit == 0
        if self.state is State.SENDING:
            assert self.whole

    # --- inside

    def _tell_changed(self, start: int, stop: int) -> None:
        if self.sending is not None:
            self.sending.on_changed(start, max(self.size, stop))
