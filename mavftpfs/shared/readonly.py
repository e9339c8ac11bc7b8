"""The reasons why a change is refused as read-only (EROFS), in words. Layer: shared; pure."""

from __future__ import annotations

from mavftpfs.shared.readable import name_text

ARMED = "the vehicle is armed: nothing is written in flight (when_armed=ro)"

WAS_ARMED = "the vehicle was armed (when_armed=ro)"
"""The same words for a write that failed earlier."""

NOTHING_BY_OPTION = "nothing is changed, because the option ro was given"


def by_option(path: bytes) -> str:
    """Return the words for the option ro, of a mount or of a command."""
    return f"'{name_text(path)}' is not changed, because the option ro was given"


def virtual(path: bytes) -> str:
    """Return the words for a path below an `@` directory."""
    return f"'{name_text(path)}' is not changed: the vehicle's @ directories are read-only"
