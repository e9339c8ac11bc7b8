"""The value of a parameter, as a number and as text. Layer: parameters; pure.

A FLOAT is a number that 32 bits hold exactly. Its text is the shortest decimal that gives the same 32 bits.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from enum import IntEnum

Number = int | float

_NUMBER = re.compile(r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|nan|inf)", re.ASCII)
_LEAST_NORMAL = 2.0**-126
"""The least float with 24 significant bits: above it six digits always survive."""


class Kind(IntEnum):
    """The type of a value, by its number in packed files (AP_Param's)."""

    INT8 = 1
    INT16 = 2
    INT32 = 3
    FLOAT = 4

    @property
    def mavlink(self) -> int:
        """The number of the same type in MAVLink messages (MAV_PARAM_TYPE)."""
        return _MAVLINK[self]


WIDTHS = {Kind.INT8: 1, Kind.INT16: 2, Kind.INT32: 4, Kind.FLOAT: 4}
_MAVLINK = {Kind.INT8: 2, Kind.INT16: 4, Kind.INT32: 6, Kind.FLOAT: 9}
_SAID = {Kind.INT8: "an 8-bit integer", Kind.INT16: "a 16-bit integer", Kind.INT32: "a 32-bit integer"}
_to_float = struct.Struct("<f")


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of a vehicle. default: None if unknown."""

    name: str
    kind: Kind
    value: Number
    default: Number | None = None

    @property
    def changed(self) -> bool:
        """Whether its default is known, and differs from its value."""
        return self.default is not None and not same(self.value, self.default)


class BadValue(ValueError):
    """A text is not a value for a parameter; the message gives the reason."""


def same(one: Number, other: Number) -> bool:
    """Return whether two values are equal; two NaN are."""
    return one == other or (one != one and other != other)


def text_of(kind: Kind, value: Number) -> str:
    """Return a value as people write it."""
    return float_text(value) if kind is Kind.FLOAT else str(int(value))


def float_text(value: float) -> str:
    """Return the shortest decimal whose nearest 32-bit float is this value, which must be a 32-bit float.

    Six digits always survive a normal float, so the function tries no shorter rounding: `%g` drops the zeros.
    """
    if not math.isfinite(value):
        return "nan" if value != value else "inf" if value > 0 else "-inf"
    first = 6 if abs(value) >= _LEAST_NORMAL or value == 0 else 1
    text = next(text for digits in range(first, 10) if _is_float(text := f"{value:.{digits}g}", value))
    return repr(float(text)).removesuffix(".0")


def _is_float(text: str, value: float) -> bool:
    try:
        return bool(_to_float.unpack(_to_float.pack(float(text)))[0] == value)
    except OverflowError:
        return False


def nearest_float(value: Number) -> float:
    """Return the 32-bit float nearest to a number.

    Raises:
        OverflowError: the number is too large for one.
    """
    return float(_to_float.unpack(_to_float.pack(float(value)))[0])


def parse_number(text: str) -> Number:
    """Read a decimal number: an int where it has neither point nor exponent.

    Raises:
        BadValue: the text is not a number.
    """
    if not _NUMBER.fullmatch(text.lower()):
        raise BadValue(f"{text!r} is not a number")
    try:
        return int(text)
    except ValueError:
        number = float(text)
    if math.isinf(number) and "inf" not in text.lower():
        raise BadValue(f"{text} is too large")
    return number


def fit(kind: Kind, number: Number) -> Number:
    """Return a number as a value of a type.

    Raises:
        BadValue: the number does not fit.
    """
    if kind is Kind.FLOAT:
        try:
            return nearest_float(number)
        except OverflowError:
            raise BadValue(f"{str(number)[:20]} is too large for a 32-bit float") from None
    most = 1 << (8 * WIDTHS[kind] - 1)
    if isinstance(number, float) and not number.is_integer():
        raise BadValue(f"{number} is not a whole number, and this is {_SAID[kind]}")
    if not -most <= number < most:
        raise BadValue(f"{int(number)} does not fit {_SAID[kind]} ({-most} to {most - 1})")
    return int(number)
