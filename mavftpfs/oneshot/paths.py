"""Paths on the vehicle as people write them. Layer: top; pure."""

from __future__ import annotations

import os
from collections.abc import Sequence

from mavftpfs.protocol.url import MftpUrl, is_url, parse_url
from mavftpfs.shared.errors import LocalProtocolError, UsageError
from mavftpfs.shared.model import normalise


def parse_paths(texts: Sequence[str]) -> tuple[list[bytes], int | None]:
    """Return the normalised remote paths, and the component that mftp:// URLs among them name.

    Raises:
        UsageError: `..` or NUL, a malformed URL, or two components at once.
    """
    paths, components = [], set()
    for text in texts:
        url = parse_url(text) if is_url(text) else MftpUrl(None, _plain_path(text))
        paths.append(url.path)
        components |= {url.component} - {None}
    if len(components) > 1:
        raise UsageError("the URLs name several components; ask one at a time")
    return paths, components.pop() if components else None


def _plain_path(text: str) -> bytes:
    try:
        return normalise(os.fsencode(text))
    except LocalProtocolError as exc:
        raise UsageError(str(exc)) from exc
