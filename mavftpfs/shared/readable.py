"""The vehicle's names and numbers in text for people. Layer: shared; pure."""

from __future__ import annotations

import ast
import re

_BYTES = re.compile(r"""\bb('(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*")""")

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
"""All control characters but tabs and line ends."""

_AUTOPILOTS = {3: "ArduPilot", 12: "PX4", 0: "generic autopilot"}
"""Common MAV_AUTOPILOT values."""


def readable(message: str) -> str:
    """Return a message in which byte strings, such as names, are text: `b'/Fl\\xc3\\xbcge'` is `'/Flüge'`.

    Bytes that are not UTF-8 stay escaped. A character that a terminal would obey becomes `?`.
    """
    return _CONTROL.sub("?", _BYTES.sub(_as_text, message))


def name_text(name: bytes) -> str:
    """Return a name or path as text, with escapes for bytes that are not UTF-8."""
    return name.decode("utf-8", "backslashreplace")


def printable(text: str) -> str:
    """Return a text without control characters and undecodable bytes."""
    return "".join(character if character.isprintable() else "?" for character in text)


def autopilot_name(number: int) -> str:
    """Return the name of a MAV_AUTOPILOT value."""
    return _AUTOPILOTS.get(number, f"autopilot type {number}")


def readable_size(count: float) -> str:
    """Return a number of bytes with a unit; kB = 1000 bytes in all texts for people."""
    for unit in ("B", "kB", "MB"):
        if round(count, 0 if unit == "B" else 1) < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"


def count_files(count: int) -> str:
    """Return `1 file`, `2 files`."""
    return f"{count} file" if count == 1 else f"{count} files"


def readable_time(seconds: float) -> str:
    """Return a duration in words: 40 ms, 12 s, 3 min 20 s, 2 h 5 min."""
    if seconds < 1:
        return f"{seconds * 1000:.0f} ms"
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"


def time_left(seconds: float) -> str:
    """Return the remaining time in words, at least a second."""
    return f"{readable_time(max(1.0, seconds))} left"


def _as_text(quoted: re.Match[str]) -> str:
    try:
        name: bytes = ast.literal_eval(quoted[0])
    except (SyntaxError, ValueError):  # a path or words that only look like bytes
        return quoted[0]
    return f"'{printable(name_text(name))}'"
