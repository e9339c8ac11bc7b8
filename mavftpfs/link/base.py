"""What a link is to the layers above. Layer: link.

A link moves bytes. It never interprets them, never raises for a peer that went away and came back
(it reopens by itself and counts), and raises LinkClosed only when it can never work again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from mavftpfs.link.addresses import NetAddress


@dataclass(slots=True)
class LinkStats:
    """Counters for status; plain sums since the link was opened."""

    received_bytes: int = 0
    sent_bytes: int = 0
    received_chunks: int = 0
    sent_chunks: int = 0
    dropped_sends: int = 0
    reopened: int = 0


class Link(Protocol):
    """A byte or datagram pipe."""

    stats: LinkStats

    @property
    def description(self) -> str:
        """SOURCE as a person would write it."""
        ...

    @property
    def is_stream(self) -> bool:
        """True for TCP and serial: chunk boundaries mean nothing."""
        ...

    @property
    def is_serial(self) -> bool:
        """True for serial ports: small receive buffers are likely at the far end."""
        ...

    @property
    def backlog(self) -> int:
        """Bytes accepted by send_nowait and not yet handed to the kernel."""
        ...

    async def receive(self) -> list[bytes]:
        """Wait for input and return 1..256 chunks, draining what is there.

        Returns an empty list when the link was reopened (the caller resets its parser).

        Raises:
            LinkClosed: the link will never work again (aclose was called).
        """
        ...

    def send_nowait(self, frames: Sequence[bytes]) -> None:
        """Send whole MAVLink frames, several to a datagram or write where they fit in 1400 bytes.

        Never blocks and never raises for a full or absent peer: what cannot be kept within a
        bounded backlog is dropped and counted, as a radio would.
        """
        ...

    def sender(self, index: int) -> NetAddress | None:
        """Return who sent a chunk of the list that `receive` returned last; None where only one can."""
        ...

    def answer(self, address: NetAddress) -> None:
        """From now on send to this address. Only a link that hears several senders has a choice."""
        ...

    def dismiss(self) -> None:
        """Let whoever waits for the present peer's place have it, though the peer is not silent."""
        ...

    async def aclose(self) -> None:
        """Flush what can be flushed at once and close."""
        ...
