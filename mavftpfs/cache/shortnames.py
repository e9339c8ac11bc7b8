"""Short names (8.3), which NuttX treats in another way than others. Layer: cache; pure.

Its fat_parsesfname takes for one what it can: then small and capital letters are the same (which they were
is kept beside it), and a dot with nothing behind it is gone. A part in which they are mixed, a second dot, a
blank and some signs make a name long: of those every letter counts (servers.md 9).
"""

from __future__ import annotations

import re

_SIGNS = rb"!#-)\-0-9@^-`{}~"
_SHORT = re.compile(
    rb"(?:[%(s)bA-Z]{1,8}|[%(s)ba-z]{1,8})(?:\.(?:[%(s)bA-Z]{,3}|[%(s)ba-z]{,3}))?" % {b"s": _SIGNS}
)


def is_short(name: bytes) -> bool:
    """Return whether a name is short."""
    return _SHORT.fullmatch(name) is not None
