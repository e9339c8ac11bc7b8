"""Comparison of SOURCEs: the same port, or a loop. Layer: link."""

from __future__ import annotations

import os

from mavftpfs.link.uri import LOOPBACK, LinkKind, LinkSpec

_ANYWHERE = {"0.0.0.0", "::"}
_HERE = {LOOPBACK, "localhost", "::1"}
_LISTENING = {LinkKind.UDP_OUT: LinkKind.UDP_IN, LinkKind.TCP_OUT: LinkKind.TCP_IN}


def same_link(one: LinkSpec, other: LinkSpec) -> bool:
    """Return whether two SOURCEs cannot be open at once, because they are the same link."""
    if one.kind is not other.kind:
        return False
    if one.kind is LinkKind.SERIAL:
        return os.path.realpath(one.device) == os.path.realpath(other.device)
    if one.port != other.port:
        return False
    return one.host == other.host or (one.kind.listens and bool({one.host, other.host} & _ANYWHERE))


def leads_back(endpoint: LinkSpec, source: LinkSpec) -> bool:
    """Return whether frames for an endpoint would return to SOURCE: both are the same link, or one of them
    sends to where the other listens."""
    return same_link(endpoint, source) or _reaches(endpoint, source) or _reaches(source, endpoint)


def _reaches(one: LinkSpec, other: LinkSpec) -> bool:
    """Return whether one link sends to where the other listens."""
    if _LISTENING.get(one.kind) is not other.kind or one.port != other.port:
        return False
    return one.host == other.host or (one.host in _HERE and other.host in _HERE | _ANYWHERE)
