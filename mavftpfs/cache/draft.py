"""What a file is to be, as far as the vehicle does not provably have it. Layer: cache; pure.

A draft lies over a base: the file as it is on the vehicle. Each byte below `size` is *held* (the spool has
it), else *base* (below `base_limit`: the vehicle has it), else zero: the content between the old end and a
write beyond it, or of a file that was extended. A hole of the base is never taken for zeros.

All handles of a path share its draft. `sending` is the present attempt to deliver it.
"""

from __future__ import annotations

import zlib
from enum import Enum
from typing import Protocol

from mavftpfs.cache.sending import Sending
from mavftpfs.shared.errors import DataUnproven
from mavftpfs.shared.extents import ExtentSet

STEP = 64 * 1024


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


class Draft:
    """The local content of one file.

    Attributes:
        size: bytes, as programs see it.
        base_limit: below this, bytes that are not held are the vehicle's.
        remote_size: size of the file on the vehicle, None if there is none.
        sending: the attempt under way, None before the first and after success.
        made: an attempt may have made the file, so that what is there is ours; maybe_made: if it is empty.
        overwrites: what is there was given up for this.
        placed: what a replacement sent may have the name on the vehicle, so that what was there may be gone.
        stretched: the vehicle's file may reach to here, also by requests of others that came late; 0 if not.
    """

    def __init__(self, content: Content, remote_size: int | None) -> None:
        self._content = content
        self.size = remote_size or 0
        self.base_limit = self.size
        self.remote_size = remote_size
        self.sending: Sending | None = None
        self.made = self.maybe_made = self.overwrites = self.placed = False
        self.stretched = 0
        self._held = ExtentSet()
        self._changed = ExtentSet()
        self._touched = False
        self._ruined = False
        self._lost = ExtentSet()

    # --- what it is

    @property
    def clean(self) -> bool:
        """Whether the vehicle has it all."""
        same = self._changed.empty and self._lost.empty and self.size == self.remote_end
        return same and not self.placed

    @property
    def remote_end(self) -> int | None:
        """The size of the file on the vehicle, None if there is none; it may have grown under an attempt."""
        if self.remote_size is None or self.sending is None or self.sending.whole:
            return self.remote_size
        return max(self.remote_size, self.sending.reached)

    @property
    def on_vehicle(self) -> bool:
        """Whether what has its name there is this file: it was there before, or we made it."""
        return self.remote_size is not None or self.made or self.overwrites

    @property
    def fresh(self) -> bool:
        """Whether nothing of the file on the vehicle is to stay."""
        return self.base_limit == 0

    @property
    def whole(self) -> bool:
        """Whether the content is known without asking the vehicle."""
        return not self.missing_base()

    @property
    def unacked(self) -> int:
        """Bytes that have still to travel, as far as it is known."""
        return self._changed.total if self.sending is None else self.sending.unacked

    @property
    def changed(self) -> ExtentSet:
        """What differs from the vehicle's file, apart from its size (a copy)."""
        return self._changed.copy()

    @property
    def held(self) -> ExtentSet:
        """What the spool has (a copy)."""
        return self._held.copy()

    @property
    def touched(self) -> bool:
        """Whether an unfinished attempt has changed a part of the vehicle's file."""
        under_way = self.sending is not None and not self.sending.whole and self.sending.reached > 0
        return self._touched or under_way

    @property
    def ruined(self) -> bool:
        """Whether an attempt found the vehicle's file without what was to stay of it: it may have holes."""
        return self._ruined or (self.sending is not None and self.sending.emptied)

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

    # --- changing it

    def write(self, offset: int, data: bytes | memoryview) -> None:
        """Replace bytes; a gap behind the present end becomes zeros.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        stop = offset + len(data)
        if offset == stop:
            return
        self._content.put(offset, data)
        self._held.add(offset, stop)
        self._note_changed(min(offset, self.size), stop)
        self.size = max(self.size, stop)

    def truncate(self, size: int) -> None:
        """Cut, or extend with zeros.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        if size < self.size:
            self._content.cut(size)
            for extents in (self._held, self._changed, self._lost):
                extents.discard(size, max(size, extents.end))
            self.base_limit = min(self.base_limit, size)
            if self.sending is not None:
                self.sending.on_cut(size)
        elif size > self.size:
            self._note_changed(self.size, size)
        self.size = size

    def fill(self, offset: int, data: bytes | memoryview) -> None:
        """Hold bytes of the base, where nothing newer is held, but for what is lost: it stays so.

        Raises:
            NoSpace.
        """
        stop = min(offset + len(data), self.base_limit, self.size)
        for start, end in self._held.missing(offset, stop):
            for a, b in self._lost.missing(start, end):
                self._content.put(a, memoryview(data)[a - offset : b - offset])
                self._held.add(a, b)

    def doubt(self, start: int, stop: int) -> list[tuple[int, int]]:
        """The vehicle may have other bytes in [start, stop): return those that are known here, which the next
        attempt sends if they are not compared before. The others are lost (`require_sound`)."""
        known = []
        for where, a, b in self.segments(start, stop):
            if where is Where.BASE:
                self._lost.add(a, b)
            else:
                self._changed.add(a, b)
                known.append((a, b))
        return known

    def require_sound(self, start: int = 0, stop: int | None = None) -> None:
        """Raise DataUnproven if there are bytes in [start, stop) that nobody has for certain."""
        for a, b in self._lost.intersection(start, self.size if stop is None else stop):
            raise DataUnproven(
                f"its bytes {a} to {b - 1} on the vehicle may be another file's, by a request that"
                " came late: write them, or the whole file, again"
            )

    # --- delivering it

    def begin(self, *, whole: bool) -> Sending:
        """Start an attempt: at an empty remote file (`whole`), or at the base with what changed of it."""
        self.begin_again()
        extents = [(0, self.size)] if whole else list(self._changed)
        self.sending = Sending(self.local_bytes, extents, whole=whole)
        return self.sending

    def begin_again(self) -> None:
        """The attempt is given up."""
        self.remote_size = self.remote_end
        self._touched = self.touched
        self._ruined = self.ruined
        self.sending = None

    def delivered(self) -> None:
        """The vehicle has it, checked: from now on that is the base."""
        self._changed.clear()
        self._lost.clear()
        self.remote_size = self.base_limit = self.size
        self.sending = None
        self._touched = self._ruined = self.made = self.maybe_made = self.overwrites = False
        self.placed, self.stretched = False, 0
        self._content.settle()

    def place(self) -> None:
        """What was sent under another name is about to get that of the vehicle's file."""
        self.placed = True
        if not self.fresh:
            self.stretched = max(self.stretched, self.size)

    def has_size(self, size: int) -> None:
        """The vehicle's file was found to have `size` bytes: what was feared to be too long may be."""
        if self.remote_size is not None and self.remote_size < size <= self.stretched:
            self.remote_size = size
        self.stretched = 0

    def remote_cut(self, size: int) -> None:
        """The vehicle's file has `size` bytes now, the first of what it had."""
        self.begin_again()
        self._touched = True
        self.remote_size = size

    def give_way(self) -> None:
        """What the present attempt still has to send is not to arrive any more: another one has to follow."""
        sending = self.sending
        self.begin_again()
        if sending is not None:
            sending.on_cut(0)

    def remote_removed(self) -> None:
        """The vehicle's file is about to be overwritten: nothing of it counts; the draft must be whole."""
        self._touched = True
        self._ruined = False
        self.base_limit = 0
        self.remote_size = None
        self.overwrites = True
        self._changed = ExtentSet([(0, self.size)])
        self.sending = None

    def check_invariants(self) -> None:
        """Raise AssertionError if the books are wrong (for tests)."""
        assert self._held.end <= self.size
        assert self._changed.end <= self.size
        assert self.base_limit <= self.size
        assert self.remote_size is not None or self._changed.covers(0, self.size)
        if self.sending is not None:
            self.sending.check_invariants()

    # --- inside

    def _note_changed(self, start: int, stop: int) -> None:
        self._changed.add(start, stop)
        self._lost.discard(start, stop)
        if self.sending is not None:
            self.sending.on_write(start, stop)
