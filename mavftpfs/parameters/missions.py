"""Missions, fences and rally points: the packed file, and the lines of "QGC WPL 110". Layer: parameters;
pure.

Source: docs/servers.md 17. A packed file is a header of five 16-bit numbers (magic, kind of mission,
options, first item, items) and 38 bytes an item, those of MAVLink's MISSION_ITEM_INT. Latitude and
longitude are degrees times ten million, x and y of local frames metres times ten thousand, and plain
numbers where the command has no place.

A vehicle does not store every field of an item, so some fields read back differently. `differences` decides
which differences count.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mavftpfs.parameters.text import Problem
from mavftpfs.parameters.values import BadValue, float_text, nearest_float, parse_number
from mavftpfs.shared.errors import RemoteProtocolError

MAGIC = 0x763D
MISSION, FENCE, RALLY = 0, 1, 2
HEADER = struct.Struct("<HHHHH")
_ITEM = struct.Struct("<ffffiifHHBBBBBB")
TITLE = "QGC WPL 110"
_FIELDS = 12
_MOST = 65535

_DEGREES, _METRES, _PLAIN = 1e7, 1e4, 1.0
_NO_PLACE = 2**31 - 1
"""x or y of an item without a place, for which the vehicle uses its own position (MISSION_ITEM_INT)."""

_GLOBAL = frozenset((0, 3, 5, 6, 10, 11))
_SAME_FRAME = {5: 0, 6: 3, 11: 10}
"""Frames that mean the same as another frame, with integers."""
_HAS_PLACE = frozenset(
    [
        *(*range(16, 20), *range(21, 26), 31, *range(34, 37), *range(80, 83), 84, 85, 94, 179, 188, 189),
        *(192, 195, 201, 252, 4001, 4501, *range(5000, 5005), 5100, 30001, *range(31000, 31010), 43003),
    ]
)
"""Commands whose fifth and sixth parameter are a place (`hasLocation` in MAVLink's definitions)."""

_HEIGHT_STEP = {MISSION: 0.011, FENCE: 0.011, RALLY: 1.0}
"""Precision in metres with which a vehicle stores heights: a centimetre; a metre for rally points."""
_STEP = 1e-4
"""Relative precision with which a vehicle stores the four parameters, which are 32-bit floats."""


@dataclass(frozen=True, slots=True)
class Item:
    """An item of a mission; x and y as in MISSION_ITEM_INT."""

    frame: int
    command: int
    parameters: tuple[float, float, float, float]
    x: int
    y: int
    z: float
    current: int = 0
    autocontinue: int = 1

    @property
    def scale(self) -> float:
        """The number by which x and y are divided to get degrees, metres or plain numbers."""
        if self.command not in _HAS_PLACE:
            return _PLAIN
        return _DEGREES if self.frame in _GLOBAL else _METRES


# -- packed ---------------------------------------------------------------------------------------


def unpack(data: bytes, kind: int) -> list[Item]:
    """Parse a download.

    Raises:
        RemoteProtocolError: the file is inconsistent, or holds items of another kind.
    """
    if len(data) < HEADER.size:
        raise RemoteProtocolError(f"a mission file of {len(data)} bytes has no header")
    magic, found, _, start, count = HEADER.unpack_from(data)
    if magic != MAGIC or found != kind or start != 0:
        raise RemoteProtocolError(f"a mission file does not begin with {data[: HEADER.size].hex()}")
    if len(data) != HEADER.size + count * _ITEM.size:
        raise RemoteProtocolError(f"a mission file of {len(data)} bytes does not have {count} items")
    return [_unpack_item(data, HEADER.size + place * _ITEM.size) for place in range(count)]


def _unpack_item(data: bytes, at: int) -> Item:
    *parameters, x, y, z, _, command, _, _, frame, current, autocontinue, _ = _ITEM.unpack_from(data, at)
    one, two, three, four = parameters
    return Item(frame, command, (one, two, three, four), x, y, z, current, autocontinue)


def pack_upload(items: Sequence[Item], kind: int, target: tuple[int, int]) -> list[bytes]:
    """Return an upload that replaces all items, in pieces that no request may split. target: the vehicle's
    ids.
    """
    header = HEADER.pack(MAGIC, kind, 0, 0, len(items))
    packed = [_pack_item(place, item, kind, target) for place, item in enumerate(items)]
    return [header + packed[0], *packed[1:]] if packed else [header]


def _pack_item(place: int, item: Item, kind: int, target: tuple[int, int]) -> bytes:
    flags = (*target, item.frame, item.current, item.autocontinue, kind)
    return _ITEM.pack(*item.parameters, item.x, item.y, item.z, place, item.command, *flags)


# -- text -----------------------------------------------------------------------------------------


def render(items: Sequence[Item]) -> str:
    """Return a file that MAVProxy, Mission Planner and QGroundControl load."""
    return "".join(line + "\n" for line in (TITLE, *map(_render_item, range(len(items)), items)))


def _render_item(place: int, item: Item) -> str:
    numbers = [float_text(value) for value in item.parameters]
    return "\t".join(
        [
            *(str(place), str(item.current), str(item.frame), str(item.command), *numbers),
            *(_place_text(item.x, item.scale), _place_text(item.y, item.scale), float_text(item.z)),
            str(item.autocontinue),
        ]
    )


def _place_text(value: int, scale: float) -> str:
    digits = {_DEGREES: 7, _METRES: 4}.get(scale, 0)
    return f"{value / scale:.{digits}f}"


def parse(text: str) -> tuple[list[Item], list[Problem]]:
    """Read a file. Items are numbered from 0, in the order of their lines, because a vehicle would take the
    second item for its home if the first one were missing.
    """
    items: list[Item] = []
    problems: list[Problem] = []
    titled = False
    place = -1
    for number, raw in enumerate(text.split("\n"), 1):
        line = raw.partition("#")[0].strip()
        if not line:
            continue
        if not titled:
            titled = True
            if re.sub(r"\s+", " ", line) != TITLE:
                problems.append(Problem(number, f"the first line is not {TITLE!r}"))
                break
            continue
        place += 1
        try:
            items.append(_parse_item(line, place))
        except BadValue as error:
            problems.append(Problem(number, str(error)))
    if not titled:
        problems.append(Problem(1, f"the first line is not {TITLE!r}"))
    if len(items) > _MOST:
        problems.append(Problem(0, f"{len(items)} items are more than {_MOST}"))
    return items, problems


def _parse_item(line: str, place: int) -> Item:
    fields = line.split()
    if len(fields) != _FIELDS:
        raise BadValue(f"an item needs {_FIELDS} numbers, but this line has {len(fields)}")
    if _whole(fields[0], _MOST, "the number of an item") != min(place, _MOST):
        raise BadValue(f"this is item {place}, but its number is {fields[0]}: items count from 0")
    current, frame = _whole(fields[1], 255, "current"), _whole(fields[2], 255, "the frame")
    command, autocontinue = _whole(fields[3], _MOST, "the command"), _whole(fields[11], 255, "autocontinue")
    one, two, three, four = (_float(field) for field in fields[4:8])
    bare = Item(frame, command, (one, two, three, four), 0, 0, 0.0)
    x, y = _scaled(fields[8], bare.scale), _scaled(fields[9], bare.scale)
    if bare.scale == _DEGREES:
        _require_degrees(fields[8], x, 90, "latitude")
        _require_degrees(fields[9], y, 180, "longitude")
    z = _float(fields[10])
    if not math.isfinite(z):
        raise BadValue(f"{fields[10]} is not a height")
    return Item(frame, command, bare.parameters, x, y, z, current, autocontinue)


def _require_degrees(text: str, scaled: int, most: int, what: str) -> None:
    if abs(scaled) > most * _DEGREES and scaled != _NO_PLACE:
        raise BadValue(f"{text} is not a {what}: from -{most} to {most}")


def _whole(text: str, most: int, what: str) -> int:
    number = parse_number(text)
    if number != number or not 0 <= number <= most or number != int(number):
        raise BadValue(f"{what} is not a whole number up to {most}: {text}")
    return int(number)


def _float(text: str) -> float:
    try:
        return nearest_float(parse_number(text))
    except OverflowError:
        raise BadValue(f"{text} is too large for a 32-bit float") from None


def _scaled(text: str, scale: float) -> int:
    number = parse_number(text)
    scaled = round(number * scale) if abs(number) <= 2**31 else 2**31
    if not -(2**31) <= scaled < 2**31:
        raise BadValue(f"{text} is not a place")
    return scaled


# -- reading back -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Difference:
    """A field that reads back differently. kept: the vehicle stores that field; otherwise it is no error."""

    text: str
    kept: bool


def differences(wanted: Sequence[Item], got: Sequence[Item], kind: int) -> list[Difference]:
    """Compare the items that were sent with those read back. A mission's first item is the vehicle's home."""
    first = 1 if kind == MISSION else 0
    if len(wanted[first:]) != len(got[first:]):
        count = f"wanted {len(wanted[first:])} items, got {len(got[first:])}"
        return [Difference(count + (" (beside home)" if first else ""), kept=True)]
    found: list[Difference] = []
    for place, (one, other) in enumerate(zip(wanted[first:], got[first:], strict=True), first):
        found += _item_differences(place, one, other, kind)
    return found


def _item_differences(place: int, wanted: Item, got: Item, kind: int) -> list[Difference]:
    if wanted.command != got.command:
        return [Difference(f"item {place}: command: wanted {wanted.command}, got {got.command}", kept=True)]
    found: list[Difference] = []

    def compare(
        what: str, one: float, other: float, equal: Callable[[float, float], bool], *, kept: bool
    ) -> None:
        if not equal(one, other):
            texts = (float_text(nearest_float(value)) for value in (one, other))
            found.append(Difference("item {}: {}: wanted {}, got {}".format(place, what, *texts), kept))

    has_place = wanted.command in _HAS_PLACE
    for number, (one, other) in enumerate(zip(wanted.parameters, got.parameters, strict=True), 1):
        dropped = has_place and number > 1 and other == 0
        compare(f"parameter {number}", one, other, _alike, kept=not dropped)
    if has_place:
        frames = [_SAME_FRAME.get(item.frame, item.frame) for item in (wanted, got)]
        compare("frame", frames[0], frames[1], _within(0), kept=True)
    compare("x", wanted.x, got.x, _within(1), kept=True)
    compare("y", wanted.y, got.y, _within(1), kept=True)
    compare("height", wanted.z, got.z, _within(_HEIGHT_STEP[kind]), kept=has_place)
    return found


def _alike(one: float, other: float) -> bool:
    """Return whether two parameters are equal; NaN stands for the vehicle's own value."""
    return one != one or math.isclose(one, other, rel_tol=_STEP, abs_tol=_STEP)


def _within(step: float) -> Callable[[float, float], bool]:
    return lambda one, other: abs(one - other) <= step
