"""Names and numbers of the vehicle as a person reads them. Layer: shared; pure."""

from __future__ import annotations

import ast
import re

_BYTES = re.compile(r"""\bb('(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*")""")

_AUTOPILOTS = {3: "ArduPilot", 12: "PX4", 0: "generic autopilot"}
"""MAV_AUTOPILOT values people meet."""


def readable(message: str) -> str:
    """Return a message in which names, which are bytes, are text: `b'/Fl\\xc3\\xbcge'` is `'/Flüge'`.

    What is no UTF-8 stays escaped; what a terminal would obey is `?`.
    """
    return _BYTES.sub(_as_text, message)


def autopilot_name(number: int) -> str:
    """Return what a MAV_AUTOPILOT value says."""
    return _AUTOPILOTS.get(number, f"autopilot type {number}")


def _as_text(quoted: re.Match[str]) -> str:
    try:
        name: bytes = ast.literal_eval(quoted[0])
    except (SyntaxError, ValueError):  # somebody's path or words
        return quoted[0]
    text = name.decode("utf-8", "backslashreplace")
    return "'" + "".join(character if character.isprintable() else "?" for character in text) + "'"
