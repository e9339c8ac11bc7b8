"""`mftp://` URLs: which component serves a file, and its path. Layer: protocol; pure.

    mftp://[comp=ID:][@ALIAS/]path      MAVLink FTP guide; brackets mark what may be left out. Those around
                                        the component may be written, too
    mftp://[;comp=ID]path               component metadata; these brackets are part of the URL

Paths are given in the mount's spelling, absolute: `mftp://@SYS/uarts.txt` is `/@SYS/uarts.txt`. A `?` belongs
to the path (`@PARAM/param.pck?withdefaults=1`). `%XX` stands for a byte.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from urllib.parse import unquote_to_bytes

from mavftpfs.shared.errors import LocalProtocolError, UsageError
from mavftpfs.shared.model import normalise

SCHEME = "mftp://"
_EXAMPLE = "mftp://comp=1:/fs/microsd/log"

_NEW_COMPONENT = re.compile(r"\[comp=([^:/\]]*):\]|comp=([^:/]*):")
# Some senders put the slash before the bracket.
_OLD_COMPONENT = re.compile(r"/?\[;comp=([^\]]*)\]")
_BAD_ESCAPE = re.compile(r"%(?![0-9A-Fa-f]{2})")


@dataclass(frozen=True, slots=True)
class MftpUrl:
    """component: 1..255, or None for whichever serves by default. path: normalised mount path."""

    component: int | None
    path: bytes


def is_url(text: str) -> bool:
    """Return whether the text says that it is an mftp URL."""
    return text[: len(SCHEME)].lower() == SCHEME


def parse_url(text: str) -> MftpUrl:
    """Return what a URL names.

    Raises:
        UsageError: one line that says what is wrong.
    """
    if not is_url(text):
        raise UsageError(f"{text!r} is no mftp URL; write for example {_EXAMPLE}")
    rest = text[len(SCHEME) :]
    match = _OLD_COMPONENT.match(rest) or _NEW_COMPONENT.match(rest)
    component = None
    if match is not None:
        component = _component(match[match.lastindex or 1], text)
        rest = rest[match.end() :]
    elif rest.lstrip("/").startswith("[;") or rest.startswith(("comp=", ";comp=", "[comp=")):
        raise UsageError(f"{text!r}: the component is not closed; write for example {_EXAMPLE}")
    if _BAD_ESCAPE.search(rest):
        raise UsageError(f"{text!r}: '%' must be followed by two hex digits (%25 is a percent sign)")
    try:
        path = normalise(unquote_to_bytes(rest.encode("utf-8", "surrogateescape")))
    except LocalProtocolError as exc:
        raise UsageError(f"{text!r}: {exc}") from exc
    return MftpUrl(component, path)


def _component(text: str, url: str) -> int:
    value = int(text) if text.isascii() and text.isdigit() and len(text) <= 3 else 0
    if not 1 <= value <= 255:
        raise UsageError(f"{url!r}: component {text!r} is not a number from 1 to 255")
    return value
