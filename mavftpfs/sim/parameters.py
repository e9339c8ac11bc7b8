"""The parameters of one vehicle, as its server serves and accepts `@PARAM/param.pck`. Layer: sim; pure.

Source: servers.md 11 and 17; AP_Filesystem_Param, PX4's mavlink_ftp_param, and recordings of both. The
simulator packs and parses with code of its own, so that it shares no mistake with the code that it tests.

A *table* holds the values, packs a download, and takes an upload. PX4 parses strictly, each write as it
arrives. ArduPilot parses the whole file when the client closes it, and does not report whether it accepted
the file.
"""

from __future__ import annotations

import errno
import math
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from mavftpfs.sim.tree import ClaimedFile, fail

MAGIC = 0x671B
MAGIC_DEFAULTS = 0x671C
INT8, INT16, INT32, FLOAT = 1, 2, 3, 4
HEADER = struct.Struct("<HHH")
PX4_BLOCK = 239
"""PX4 pads for this block size, even if the client reads in another one."""

_MAX_NAME = 16
_HAS_DEFAULT = 1
_FORMATS = {INT8: "<b", INT16: "<h", INT32: "<i", FLOAT: "<f"}
_WIDTHS = {INT8: 1, INT16: 2, INT32: 4, FLOAT: 4}


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter. `value` and `default` are as stored, little-endian; a default of None is the value.

    drift: the growth of the value in each second. limits: a value outside becomes the nearest one inside.
    read_only: the vehicle ignores a new value. needs: the parameter exists only while the parameter of that
    name is not 0. misfit: the default does not fit the type, so a download includes the default although it
    looks equal (SIM_OH_RELAY_MSK).
    """

    name: bytes
    kind: int
    value: bytes
    default: bytes | None = None
    drift: float = 0.0
    limits: tuple[float, float] = (-math.inf, math.inf)
    read_only: bool = False
    needs: bytes = b""
    misfit: bool = False

    @property
    def number(self) -> float:
        """The value as a number."""
        return unpack(self.kind, self.value)


def unpack(kind: int, value: bytes | bytearray) -> float:
    """Return a stored value as a number."""
    return float(struct.unpack_from(_FORMATS[kind], value)[0])


def pack(kind: int, number: float) -> bytes:
    """Return a number in the stored form; for an integer that does not fit, the nearest one that does."""
    if kind == FLOAT:
        return struct.pack("<f", number)
    bits = 8 * _WIDTHS[kind]
    return struct.pack(_FORMATS[kind], int(max(-(2 ** (bits - 1)), min(2 ** (bits - 1) - 1, number))))


def parameter(
    name: str,
    kind: int,
    number: float,
    default: float | None = None,
    *,
    drift: float = 0.0,
    limits: tuple[float, float] = (-math.inf, math.inf),
    read_only: bool = False,
    needs: str = "",
) -> Parameter:
    """Build a parameter from numbers."""
    packed_default = None if default is None else pack(kind, default)
    return Parameter(
        name.encode(),
        kind,
        pack(kind, number),
        packed_default,
        drift=drift,
        limits=limits,
        read_only=read_only,
        needs=needs.encode(),
    )


@dataclass(frozen=True, slots=True)
class Selection:
    """The arguments of a download, `param.pck?start=50&count=10&withdefaults=1`. count 0: all the rest."""

    start: int = 0
    count: int = 0
    defaults: bool = False


def selection(query: bytes) -> Selection:
    """Parse the text behind the `?`. Unknown keys are ignored, and a text that is not a number counts as
    0."""
    found = dict.fromkeys((b"start", b"count", b"withdefaults"), 0)
    for option in query.split(b"&"):
        key, _, value = option.partition(b"=")
        if key in found:
            found[key] = int(value) if value.isdigit() else 0
    return Selection(found[b"start"], found[b"count"], found[b"withdefaults"] == 1)


def pack_file(chosen: Sequence[Parameter], total: int, *, block: int, defaults: bool) -> bytes:
    """Return param.pck for reads of `block` bytes: the last value of an entry crosses no block's end.

    total: the header's number of parameters. defaults: with default values where they differ.
    """
    out = bytearray(HEADER.pack(MAGIC_DEFAULTS if defaults else MAGIC, len(chosen), total))
    last = b""
    for one in chosen:
        default = one.value if one.default is None else one.default
        told = default if defaults and (one.misfit or default != one.value) else b""
        common = _common_prefix(last, one.name)
        kind = one.kind | (_HAS_DEFAULT << 4 if told else 0)
        entry = (
            bytes([kind, common | (len(one.name) - common - 1) << 4]) + one.name[common:] + one.value + told
        )
        over = (len(out) + len(entry)) % block
        if 1 < len(one.value) > over > 0:
            out += bytes(len(one.value) - over)
        out += entry
        last = one.name
    return bytes(out)


def _common_prefix(last: bytes, name: bytes) -> int:
    limit = min(len(last), len(name) - 1, 15)
    return next((i for i in range(limit) if last[i] != name[i]), max(limit, 0))


class Table:
    """A vehicle's parameters, in its order. Times are seconds of a clock that does not go back."""

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self._held = {one.name: one for one in parameters}
        self._drifted_to: float | None = None
        self._packed: dict[tuple[Selection, int], bytes] = {}

    def visible(self, now: float) -> list[Parameter]:
        """Return the parameters that exist now, with their present values."""
        self._drift(now)
        return [one for one in self._held.values() if self._is_there(one)]

    def number(self, name: str, now: float) -> float:
        """Return a present value. Raises KeyError: the parameter does not exist now."""
        return {one.name: one for one in self.visible(now)}[name.encode()].number

    def set(self, name: bytes, number: float, now: float) -> None:
        """Set a value; a parameter that does not exist, or is read-only, stays as it is."""
        self._drift(now)
        one = self._held.get(name)
        if one is None or not self._is_there(one) or one.read_only:
            return
        low, high = one.limits
        self._replace(one, pack(one.kind, max(low, min(high, number))))

    def find(self, name: bytes, now: float) -> Parameter | None:
        """Return a parameter that exists now."""
        self._drift(now)
        one = self._held.get(name)
        return one if one is not None and self._is_there(one) else None

    def download(self, wanted: Selection, block: int, now: float) -> bytes:
        """Return the file as read in blocks of `block` bytes.

        Raises:
            OSError: EINVAL, the vehicle has no parameters from `start` on.
        """
        there = self.visible(now)
        if (wanted, block) in self._packed:
            return self._packed[wanted, block]
        if wanted.start >= len(there):
            raise fail(errno.EINVAL)
        chosen = there[wanted.start :][: wanted.count or None]
        packed = pack_file(chosen, len(there), block=block, defaults=wanted.defaults)
        self._packed[wanted, block] = packed
        return packed

    def _is_there(self, one: Parameter) -> bool:
        return not one.needs or self._held[one.needs].number != 0

    def _drift(self, now: float) -> None:
        """Advance the parameters that drift by whole seconds."""
        if not math.isfinite(now):
            return
        if self._drifted_to is None:
            self._drifted_to = now
        seconds = math.floor(now - self._drifted_to)
        if seconds <= 0:
            return
        self._drifted_to += seconds
        for one in self._held.values():
            if one.drift:
                self._replace(one, pack(one.kind, one.number + seconds * one.drift))

    def _replace(self, one: Parameter, value: bytes) -> None:
        self._held[one.name] = replace(one, value=value)
        self._packed.clear()


class _PackedEntry(NamedTuple):
    """One entry of an upload, and the position of the next one."""

    name: bytes
    kind: int
    number: float
    stop: int


def _parse_entry(data: bytes | bytearray, at: int, last: bytes) -> _PackedEntry | None:
    """Parse an entry; return None if a part of it is still missing.

    Raises:
        OSError: EINVAL, a flag, an unknown type, or a name that is too long.
    """
    if len(data) < at + 2:
        return None
    kind, flags, common, length = data[at] & 15, data[at] >> 4, data[at + 1] & 15, (data[at + 1] >> 4) + 1
    if flags or kind not in _FORMATS or common + length > _MAX_NAME:
        raise fail(errno.EINVAL)
    start = at + 2 + length
    stop = start + _WIDTHS[kind]
    if len(data) < stop:
        return None
    name = last[:common] + bytes(data[at + 2 : start])
    return _PackedEntry(name, kind, unpack(kind, data[start:stop]), stop)


class ParameterUpload:
    """A param.pck that a client is writing. Both methods raise OSError: EINVAL."""

    def write(self, offset: int, data: bytes, now: float) -> None:
        """Take a chunk."""
        raise NotImplementedError

    def close(self, now: float) -> None:
        """Note that the client closed the file."""
        raise NotImplementedError


class StrictUpload(ParameterUpload):
    """PX4's: the server sets each entry as soon as all of it has arrived. After a mistake every write fails,
    and so does the close. An accepted chunk may arrive again; one that leaves a hole is a mistake. Unknown
    names are skipped.
    """

    def __init__(self, table: Table) -> None:
        self._table = table
        self._taken = bytearray()
        self._at = HEADER.size
        self._last = b""
        self._left = 0
        self._dead = False

    def write(self, offset: int, data: bytes, now: float) -> None:
        """See ParameterUpload."""
        if self._dead:
            raise fail(errno.EINVAL)
        try:
            self._take(offset, data, now)
        except OSError:
            self._dead = True
            raise

    def close(self, now: float) -> None:
        """See ParameterUpload."""
        complete = len(self._taken) >= HEADER.size and self._left == 0
        if self._dead or not complete or HEADER.unpack_from(self._taken)[2] != len(self._taken):
            raise fail(errno.EINVAL)

    def _take(self, offset: int, data: bytes, now: float) -> None:
        if offset > len(self._taken):
            raise fail(errno.EINVAL)
        had_header = len(self._taken) >= HEADER.size
        self._taken += data[len(self._taken) - offset :]
        if len(self._taken) < HEADER.size:
            return
        if not had_header:
            magic, self._left, _ = HEADER.unpack_from(self._taken)
            if magic != MAGIC:
                raise fail(errno.EINVAL)
        while self._left and (entry := _parse_entry(self._taken, self._at, self._last)) is not None:
            self._at, self._last = entry.stop, entry.name
            self._left -= 1
            self._apply(entry, now)

    def _apply(self, entry: _PackedEntry, now: float) -> None:
        known = self._table.find(entry.name, now)
        if known is None:
            return
        if entry.kind not in (INT32, FLOAT):
            raise fail(errno.EINVAL)
        self._table.set(entry.name, entry.number, now)


class LenientUpload(ParameterUpload):
    """ArduPilot's: chunks arrive in any order, and the close sets all values. Unknown names are skipped.
    says_so: closing a refused file is EINVAL; otherwise the server ACKs the close.
    """

    def __init__(self, table: Table, *, says_so: bool) -> None:
        self._table = table
        self._says_so = says_so
        self._taken = bytearray()

    def write(self, offset: int, data: bytes, now: float) -> None:
        """See ParameterUpload. The header has the length of the file. Missing bytes are 0."""
        stop = offset + len(data)
        if offset == 0 and len(data) >= HEADER.size:
            magic, _, length = HEADER.unpack_from(data)
            stop = max(stop, length) if magic == MAGIC else stop
        self._taken += bytes(max(0, stop - len(self._taken)))
        self._taken[offset : offset + len(data)] = data

    def close(self, now: float) -> None:
        """See ParameterUpload."""
        try:
            for entry in self._entries():
                self._apply(entry, now)
        except OSError:
            if self._says_so:
                raise

    def _entries(self) -> Iterator[_PackedEntry]:
        if len(self._taken) < HEADER.size:
            raise fail(errno.EINVAL)
        magic, count, length = HEADER.unpack_from(self._taken)
        if magic != MAGIC or length != len(self._taken):
            raise fail(errno.EINVAL)
        at, last = HEADER.size, b""
        for _ in range(count):
            entry = _parse_entry(self._taken, at, last)
            if entry is None:
                raise fail(errno.EINVAL)
            at, last = entry.stop, entry.name
            yield entry

    def _apply(self, entry: _PackedEntry, now: float) -> None:
        """Convert to the parameter's own type, as AP_Param::set_float does: 0.01 more, then truncated."""
        known = self._table.find(entry.name, now)
        if known is None or not math.isfinite(entry.number):
            return
        number = entry.number
        if known.kind != FLOAT and entry.kind == FLOAT:
            number += math.copysign(0.01, number)
        self._table.set(entry.name, number, now)


class ParameterFile(ClaimedFile):
    """param.pck that a session has open. clock: the server's.

    live: as ArduPilot's. Each read packs the present values, for blocks of the size of the first read;
    another size is EINVAL (AP_Filesystem_Param::read). Otherwise as PX4's: packed once, and read in any
    sizes.
    """

    def __init__(
        self,
        table: Table,
        wanted: Selection,
        clock: Callable[[], float],
        *,
        claimed: int,
        live: bool,
        upload: ParameterUpload | None,
        on_close: Callable[[], None],
    ) -> None:
        super().__init__(claimed, on_close)
        self._table = table
        self._wanted = wanted
        self._clock = clock
        self._live = live
        self._upload = upload
        self._block: int | None = None
        self._content = b""

    def read(self, offset: int, size: int) -> bytes:
        """See OpenFile."""
        if size == 0:
            return b""
        if self._upload is not None:
            raise fail(errno.EINVAL)
        if self._block is None:
            self._block = size
            self._content = self._pack(PX4_BLOCK)
        if self._live:
            if size != self._block:
                raise fail(errno.EINVAL)
            self._content = self._pack(size)
        return self._content[offset : offset + size]

    def _pack(self, block: int) -> bytes:
        return self._table.download(self._wanted, block, self._clock())

    def write(self, offset: int, data: bytes) -> int:
        """See OpenFile."""
        if self._upload is None:
            raise fail(errno.EBADF)
        self._upload.write(offset, data, self._clock())
        return len(data)

    def closed(self) -> None:
        """See ClaimedFile."""
        if self._upload is not None:
            self._upload.close(self._clock())
