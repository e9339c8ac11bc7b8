"""What a file is to be, and how far the vehicle has it. Layer: cache; pure.

A draft lies over a base: the file as it is on the vehicle. Each byte below `size` is *held* (the spool has
it), else *base* (below `base_limit`: the vehicle has it), else zero: the content between the old end and a
write beyond it, or of a file that was extended.

All handles of a path share its draft. Its state, and what may happen next, is in one table: `TRANSITIONS`;
the next step that brings it to the vehicle is `choose`. Whatever changes a file's content is sent as a whole
new file under a reserved name beside it, verified there, and renamed into place (`delivery`). Only on cards
that cannot rename it is sent under its own name. A write while that file is sent joins it; once it is being
renamed into place, writers wait for the end of that.

`Sending` has the books of one attempt: each byte is dirty, in flight, acked or proven (a Terminate was ACKed
after it). It may be written again while it is in flight; then it is dirty *and* in flight, and is not handed
out before the older copy was accounted for: two copies under way at once may reach the card in the wrong
order. A new attempt gets new books, so whatever a late upload still says of the old one changes nothing.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from mavftpfs.shared.errors import FileChanged, LocalProtocolError, NotSupported
from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.traits import WriteTraits

AHEAD = 64 * 1024
"""Bytes fetched from the spool at once, since chunks are small."""

FULL = 239
"""Bytes of a full request (servers.md 1)."""

STEP = 64 * 1024
"""Bytes read from the spool at once for a checksum."""


class State(Enum):
    """How far the vehicle has a draft.

    CLEAN: it has all of it. DIRTY: it does not, and nothing is under way. SENDING: a new file is written
    under a reserved name. COMMITTING: that file is verified and being renamed into place. TORN: the renames
    were interrupted, so nobody knows whether it was delivered (`OwnNames.torn`: which names may lack their
    file). STALE: the base is another file now.
    """

    CLEAN = "clean"
    DIRTY = "dirty"
    SENDING = "sending"
    COMMITTING = "committing"
    TORN = "torn"
    STALE = "stale"


class Event(Enum):
    """What happens to a draft.

    CHANGED: a program wrote or truncated. EMPTIED: it was truncated to nothing, so that no base matters.
    BEGUN: an attempt to send it began. GIVEN_UP: the attempt ended without success. COMMITS: what was sent
    is verified, and the first rename is about to be asked for. PLACED: it has its name. REFUSED: it has not,
    and all is where it was. INTERRUPTED: nobody knows how far that came. REPLACED: others replaced the base.
    """

    CHANGED = "changed"
    EMPTIED = "emptied"
    BEGUN = "begun"
    GIVEN_UP = "given up"
    COMMITS = "commits"
    PLACED = "placed"
    REFUSED = "refused"
    INTERRUPTED = "interrupted"
    REPLACED = "replaced"


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
        Event.REPLACED: State.STALE,
    },
    State.SENDING: {
        Event.CHANGED: State.SENDING,
        Event.EMPTIED: State.SENDING,
        Event.GIVEN_UP: State.DIRTY,
        Event.COMMITS: State.COMMITTING,
    },
    State.COMMITTING: {
        Event.PLACED: State.CLEAN,
        Event.REFUSED: State.DIRTY,
        Event.INTERRUPTED: State.TORN,
    },
    State.TORN: {
        Event.CHANGED: State.DIRTY,
        Event.EMPTIED: State.DIRTY,
        Event.PLACED: State.CLEAN,
        Event.REFUSED: State.DIRTY,
    },
    State.STALE: {
        Event.EMPTIED: State.DIRTY,
    },
}
"""State -> what may happen -> the next state. Anything else is a bug (LocalProtocolError)."""


class Content(Protocol):
    """Keeps bytes by offset (cache.spool.SpoolContent)."""

    def put(self, offset: int, data: bytes | memoryview) -> None:
        """Keep them. Raises NoSpace or SpoolFailed, having kept none."""
        ...

    def get(self, start: int, stop: int) -> bytes:
        """Return bytes that were put. Raises SpoolFailed."""
        ...

    def cut(self, size: int) -> None:
        """Forget what lies at and beyond `size`. Raises NoSpace or SpoolFailed, having forgotten nothing."""
        ...

    def settle(self) -> None:
        """The vehicle has all of it."""
        ...


class Where(Enum):
    """Who has a byte."""

    HELD = "held"
    BASE = "base"
    ZERO = "zero"


@dataclass(frozen=True, slots=True)
class Base:
    """What is known of the vehicle's file below a draft: size in bytes; mtime in seconds UTC and CRC32 where
    they were told."""

    size: int
    mtime: int | None = None
    crc32: int | None = None


class Draft:
    """The local content of one file.

    Attributes:
        size: bytes, as programs see it.
        base: the file on the vehicle, None if there is none.
        base_limit: below this, bytes that are not held are the base's.
        state: see State.
        sending: the present attempt's books, only while SENDING.
        begun: the file may exist under its own name because of us (cards that cannot rename).
    """

    def __init__(self, content: Content, base: Base | None) -> None:
        self._content = content
        self.size = 0 if base is None else base.size
        self.base = base
        self.base_limit = self.size
        self.state = State.DIRTY if base is None else State.CLEAN
        self.sending: Sending | None = None
        self.begun = False
        self._held = ExtentSet()
        self._changed = ExtentSet()
        self._lacked = False

    # --- what it is

    @property
    def undelivered(self) -> bool:
        """Whether the vehicle lacks something of it that it should have."""
        return self._lacked if self.state is State.STALE else self.state is not State.CLEAN

    @property
    def whole(self) -> bool:
        """Whether the content is known without asking the vehicle."""
        return not self.missing_base()

    @property
    def unacked(self) -> int:
        """Bytes that programs wrote and that have still to travel."""
        return self._changed.total if self.sending is None else self.sending.unacked

    @property
    def changed(self) -> ExtentSet:
        """What programs changed since the vehicle last had it all (a copy)."""
        return self._changed.copy()

    @property
    def held(self) -> ExtentSet:
        """What the spool has (a copy)."""
        return self._held.copy()

    def missing_base(self) -> list[tuple[int, int]]:
        """Return the ranges of which only the vehicle has the bytes."""
        return self._held.missing(0, min(self.base_limit, self.size))

    def segments(self, start: int, stop: int) -> list[tuple[Where, int, int]]:
        """Return who has which part of [start, stop), cut at the file's size, ascending."""
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
            parts.append(self._content.get(a, b) if where is Where.HELD else bytes(b - a))
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def crc32(self) -> int:
        """Return the CRC32 as the vehicle computes it (servers.md 10) of a whole draft.

        Raises:
            SpoolFailed.
        """
        value = 0xFFFFFFFF
        for at in range(0, self.size, STEP):
            value = zlib.crc32(self.local_bytes(at, min(at + STEP, self.size)), value)
        return value ^ 0xFFFFFFFF

    # --- what programs do

    def write(self, offset: int, data: bytes | memoryview) -> None:
        """Replace bytes; a gap behind the present end becomes zeros.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        stop = offset + len(data)
        if offset == stop:
            return
        after = self._after(Event.CHANGED)
        self._content.put(offset, data)
        self._held.add(offset, stop)
        self._note_changed(min(offset, self.size), stop)
        self.size, self.state = max(self.size, stop), after

    def truncate(self, size: int) -> None:
        """Cut, or extend with zeros.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        if size == self.size:
            return
        after = self._after(Event.CHANGED if size else Event.EMPTIED)
        if size < self.size:
            self._content.cut(size)
            for extents in (self._held, self._changed):
                extents.discard(size, max(size, extents.end))
            self.base_limit = min(self.base_limit, size)
            if self.sending is not None:
                self.sending.on_cut(size)
        else:
            self._note_changed(self.size, size)
        self.size, self.state = size, after

    def fill(self, offset: int, data: bytes | memoryview) -> None:
        """Hold bytes of the base, where nothing newer is held.

        Raises:
            NoSpace, SpoolFailed.
        """
        stop = min(offset + len(data), self.base_limit, self.size)
        for start, end in self._held.missing(offset, stop):
            self._content.put(start, memoryview(data)[start - offset : end - offset])
            self._held.add(start, end)

    # --- what delivery does

    def begin(self, *, in_place: bool) -> Sending:
        """Start to send a whole draft to an empty file. in_place: to the file's own name, so that from now on
        nothing counts of what is there."""
        self.on(Event.BEGUN)
        if in_place:
            self.begun, self.base_limit = True, 0
        self.sending = Sending(self.local_bytes, self.size)
        return self.sending

    def give_up(self) -> None:
        """The attempt ended without success."""
        if self.state is State.SENDING:
            self.on(Event.GIVEN_UP)
        self.sending = None

    def commit(self) -> None:
        """What was sent is verified and about to be renamed."""
        self.on(Event.COMMITS)
        self.sending = None

    def interrupted(self, *, ours: bool = False) -> None:
        """Nobody knows which file has the name now; all of the draft is known here, so none matters. ours:
        what has the name is what was sent, or what became of it."""
        self.on(Event.INTERRUPTED)
        self.base_limit = 0
        if ours:
            self.base = Base(self.size)

    def delivered(self, crc32: int | None = None) -> None:
        """The vehicle has it, checked: from now on that is the base. crc32: of the content, if known."""
        if self.state is State.SENDING:  # a card that cannot rename
            self.commit()
        self.on(Event.PLACED)
        self.base, self.base_limit = Base(self.size, crc32=crc32), self.size
        self.begun = False
        self._changed.clear()
        self._content.settle()

    def lose_base(self) -> None:
        """Others replaced the file on the vehicle. If no byte of it was to stay that changes nothing."""
        if self.base_limit and self.state is not State.STALE:
            self._lacked = self.state is not State.CLEAN
            self.give_up()
            self.on(Event.REPLACED)

    def on(self, event: Event) -> None:
        """Go to the next state.

        Raises:
            LocalProtocolError: that cannot happen now.
        """
        self.state = self._after(event)

    def _after(self, event: Event) -> State:
        after = TRANSITIONS[self.state].get(event)
        if after is None:
            raise LocalProtocolError(f"a file that is {self.state.value} cannot be {event.value}")
        return after

    def check_invariants(self) -> None:
        """Raise AssertionError if the books are wrong (for tests)."""
        assert self._held.end <= self.size
        assert self._changed.end <= self.size
        assert self.base_limit <= self.size
        assert (self.sending is not None) == (self.state is State.SENDING)
        assert self.base is not None or self.base_limit == 0
        if self.state in (State.SENDING, State.COMMITTING, State.TORN):
            assert self.whole
        if self.sending is not None:
            self.sending.check_invariants()

    # --- inside

    def _note_changed(self, start: int, stop: int) -> None:
        self._changed.add(start, stop)
        if self.sending is not None:
            self.sending.on_write(start, stop)


# --- how far it was sent


class Sending:
    """One attempt to send a file of `size` bytes, which `read(start, stop)` returns; a remote.UploadSource.

    Attributes:
        unacked: bytes not ACKed yet.
        reached: one past the highest byte that may have been written to the remote file.
        progress: told how many bytes were ACKed.
        overtaken: the file was cut below `reached`, so the remote file is too long: it is to be given up.
        rewritten: bytes changed after they may have been sent, so that an older copy of them may come late.
        growing: more may be written behind the last byte; what fills no request there waits for it.
    """

    def __init__(self, read: Callable[[int, int], bytes], size: int) -> None:
        self._read = read
        self.overtaken = self.rewritten = self.growing = False
        self.progress: Callable[[int], None] | None = None
        self.reached = 0
        self._dirty = ExtentSet([(0, size)] if size else [])
        self._in_flight = ExtentSet()
        self._acked = ExtentSet()
        self._proven = ExtentSet()
        self._ahead = (0, b"")
        self._clear = 0  # nothing under way lies in the lowest dirty extent, if that begins below
        # ACKed in a row, and not entered yet: ACKs come one by one, a hundred thousand a second
        self._run = (0, 0)

    @property
    def unacked(self) -> int:
        """Bytes that are dirty or in flight."""
        self._enter_run()
        total = self._dirty.total
        for a, b in self._in_flight:
            total += sum([stop - start for start, stop in self._dirty.missing(a, b)])
        return total

    # --- the program's side

    def on_write(self, start: int, stop: int) -> None:
        """The draft's bytes [start, stop) changed: they go (again)."""
        self._enter_run()
        self._clear = 0
        self.rewritten |= start < self.reached
        self._dirty.add(start, stop)
        self._acked.discard(start, stop)
        self._proven.discard(start, stop)
        at, data = self._ahead
        if start < at + len(data) and at < stop:
            self._ahead = (0, b"")

    def on_cut(self, size: int) -> None:
        """The draft ends at `size` now."""
        self._enter_run()
        self._clear = 0
        self.overtaken |= size < self.reached
        for extents in (self._dirty, self._in_flight, self._acked, self._proven):
            extents.discard(size, max(extents.end, size))
        self._ahead = (0, b"")

    # --- the upload's side

    def next_chunk(self, limit: int) -> tuple[int, bytes] | None:
        """See cache.remote.UploadSource."""
        found = self._dirty.first()
        if found is None or self.overtaken:
            return None
        start, stop = found
        if self._run[1] > start:
            self._enter_run()  # an ACK of these bytes was not for the copy that goes now
        if start < self._clear:
            stop = min(stop, start + limit)
        elif (found := self._next_extent(limit)) is None:
            return None
        else:
            start, stop = found
        if self.growing and stop == self._dirty.end:
            stop -= (stop - start) % FULL
            if start == stop:
                return None
        at, ahead = self._ahead
        if at <= start and stop <= at + len(ahead):
            data = ahead[start - at : stop - at]
        else:
            data = self._fetch(start, stop)
        self._dirty.discard(start, stop)
        self._in_flight.add(start, stop)
        if stop > self.reached:
            self.reached = stop
        return start, data

    def on_acked(self, offset: int, count: int) -> None:
        """See cache.remote.UploadSource."""
        begin, end = self._run
        if offset == end:
            self._run = (begin, end + count)
        else:
            self._enter_run()
            self._run = (offset, offset + count)
        if self.progress is not None:
            self.progress(count)

    def on_unsent(self, offset: int, count: int) -> None:
        """See cache.remote.UploadSource."""
        self._enter_run()
        self._clear = 0
        self._move_back(self._in_flight.intersection(offset, offset + count))

    def on_checkpoint(self) -> None:
        """See cache.remote.UploadSource."""
        self._enter_run()
        self._move(self._acked, self._proven)

    def on_rollback(self, everything: bool) -> None:
        """See cache.remote.UploadSource."""
        self._enter_run()
        self._clear = 0
        self._move(self._in_flight, self._dirty)
        self._move(self._acked, self._dirty)
        if everything:
            self._move(self._proven, self._dirty)

    def check_invariants(self) -> None:
        """Raise AssertionError if the books are wrong (for tests)."""
        for one, other in (
            (self._dirty, self._acked),
            (self._dirty, self._proven),
            (self._in_flight, self._acked),
            (self._in_flight, self._proven),
            (self._acked, self._proven),
        ):
            assert not any(other.overlaps(start, stop) for start, stop in one)

    # --- inside

    def _enter_run(self) -> None:
        offset, end = self._run
        if offset == end:
            return
        self._run = (0, 0)
        for start, stop in self._in_flight.intersection(offset, end):
            self._in_flight.discard(start, stop)
            for a, b in self._dirty.missing(start, stop):
                self._acked.add(a, b)

    def _next_extent(self, limit: int) -> tuple[int, int] | None:
        self._enter_run()
        first = self._dirty.first()
        if first is None:
            return None
        if not self._in_flight.overlaps(*first):
            self._clear = first[1]
            return first[0], min(first[1], first[0] + limit)
        for start, stop in self._dirty:
            for a, b in self._in_flight.missing(start, stop):
                return a, min(b, a + limit)
        return None

    def _fetch(self, start: int, stop: int) -> bytes:
        extent = next(iter(self._dirty.intersection(start, start + AHEAD)))
        data = self._read(start, max(stop, extent[1]))
        self._ahead = (start, data)
        return data[: stop - start]

    def _move(self, source: ExtentSet, target: ExtentSet) -> None:
        for start, stop in source:
            target.add(start, stop)
        source.clear()

    def _move_back(self, extents: list[tuple[int, int]]) -> None:
        for start, stop in extents:
            self._in_flight.discard(start, stop)
            self._dirty.add(start, stop)


# --- the next step


class Plan(Enum):
    """One step.

    NOTHING: the vehicle has it. MEND: have an interrupted replacement completed or undone. FETCH: get what
    only the vehicle has of the old content. REPLACE: send it under a reserved name and rename it. OVERWRITE:
    send it under its own name, since the card was seen not to rename.
    """

    NOTHING = "nothing"
    MEND = "mend"
    FETCH = "fetch"
    REPLACE = "replace"
    OVERWRITE = "overwrite"


SENDING = frozenset({Plan.REPLACE, Plan.OVERWRITE})
"""Steps that send bytes."""


def choose(draft: Draft, traits: WriteTraits, *, torn: bool, inplace: bool) -> Plan:
    """Return the next step for a draft, by what the server was seen to do.

    torn: its name may lack its file on the card. inplace: overwrite files where they cannot be replaced.

    Raises:
        FileChanged: the base is another file now.
        NotSupported: the card cannot rename, and `inplace` was not given.
    """
    if draft.state is State.CLEAN:
        return Plan.NOTHING
    if draft.state is State.STALE:
        raise FileChanged("others replaced the file on the vehicle while it was changed here")
    if draft.state is State.TORN or (torn and draft.state is State.DIRTY):  # written again meanwhile
        return Plan.MEND
    if traits.rename_works is False and draft.base is not None and not inplace and not draft.begun:
        raise NotSupported("this server cannot rename, so a file cannot be replaced safely; see inplace")
    if not draft.whole:
        return Plan.FETCH
    return Plan.OVERWRITE if traits.rename_works is False else Plan.REPLACE
