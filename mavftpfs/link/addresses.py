"""Which network address each MAVLink sender is known by. Layer: link; pure.

Any program can send to a UDP port and claim to be the vehicle. So a sender is known by the address at which
it was first heard, and counts only from there. Another address may take its place after 5 s of silence: the
vehicle's router restarted, or it comes over its other link.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

from mavftpfs.link.messages import Address

PATIENCE = 5.0
"""Seconds of silence after which a sender may come from another address."""

_MOST_SENDERS = 256

NetAddress: TypeAlias = tuple[Any, ...]
"""A socket's name for its peer: host, port, and more for IPv6. A TCP peer is known by its host alone."""


@dataclass(slots=True)
class _Known:
    address: NetAddress
    heard_at: float


class AddressBook:
    """The senders of one link.

    Attributes:
        distrusted: where another vehicle answered for a sender. Any other address may take its place at once.
    """

    def __init__(self) -> None:
        self.distrusted: NetAddress | None = None
        self._senders: dict[Address, _Known] = {}

    def __contains__(self, sender: Address) -> bool:
        return sender in self._senders

    def accepts(self, sender: Address, address: NetAddress, now: float) -> bool:
        """Return whether a frame of a sender counts that came from an address, and note that it was heard."""
        known = self._senders.get(sender)
        if known is None:
            if len(self._senders) >= _MOST_SENDERS:
                self._drop_silent(now)
            if len(self._senders) < _MOST_SENDERS:
                self._senders[sender] = _Known(address, now)
            return True
        if known.address != address:
            if now - known.heard_at <= PATIENCE and known.address != self.distrusted:
                return False
            known.address = address
        known.heard_at = now
        return True

    def _drop_silent(self, now: float) -> None:
        self._senders = {
            sender: known for sender, known in self._senders.items() if now - known.heard_at <= PATIENCE
        }


def readable_address(address: NetAddress) -> str:
    """Return an address as a person writes it."""
    host, *port = address[:2]
    shown = f"[{host}]" if port and ":" in host else host
    return ":".join([shown, *map(str, port)])
