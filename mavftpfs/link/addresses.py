"""The network address by which each MAVLink sender is known. Layer: link; pure.

Any program can send to a UDP port and claim to be the vehicle. So a sender is known by the address at which
it was first heard, and its frames count only from there. Another address may replace it after 5 s of silence:
the vehicle's router restarted, or the vehicle uses its other link.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

from mavftpfs.link.messages import Address

PATIENCE = 5.0
"""Seconds of silence after which another address may replace a sender's."""

NetAddress: TypeAlias = tuple[Any, ...]
"""A socket's name for its peer: host, port, and more for IPv6. A TCP peer is known by its host alone."""


@dataclass(slots=True)
class _Known:
    address: NetAddress
    heard_at: float


class AddressBook:
    """The senders of one link: 65,536 at most, because system and component are a byte each."""

    def __init__(self) -> None:
        self._senders: dict[Address, _Known] = {}

    def of(self, sender: Address) -> NetAddress | None:
        """Return the address from which a sender's frames count; None if it was not heard."""
        known = self._senders.get(sender)
        return None if known is None else known.address

    def accepts(
        self, sender: Address, address: NetAddress, now: float, distrusted: NetAddress | None = None
    ) -> bool:
        """Return whether a sender's frame from an address counts, and note that the sender was heard.

        distrusted: the address where another vehicle answers now; any other may replace it at once.
        """
        known = self._senders.get(sender)
        if known is None:
            self._senders[sender] = _Known(address, now)
            return True
        if known.address != address:
            if now - known.heard_at <= PATIENCE and known.address != distrusted:
                return False
            known.address = address
        known.heard_at = now
        return True


def readable_address(address: NetAddress) -> str:
    """Return an address as a person writes it."""
    host, *port = address[:2]
    shown = f"[{host}]" if port and ":" in host else host
    return ":".join([shown, *map(str, port)])
