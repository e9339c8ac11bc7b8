"""Where each sender is, and whether the hub believes a frame of it. Layer: hub; pure.

A *place* is a side of the hub, and a network address there. A sender is at one place of the port, or at
several places elsewhere: at endpoints and clients, where two ground stations may have one id. Neither a fake
nor a frame that returns through a loop of cables and forwards may move a sender:

| the sender is | a frame comes from | and it was silent for 5 s | the frame is | then the sender is |
|---|---|---|---|---|
| nowhere | any place | | NEW | there |
| at that place | there | | KNOWN | there |
| elsewhere | another place elsewhere | | NEW | at both |
| on the port | elsewhere | no | REFUSED | where it was |
| elsewhere | the port | no | REFUSED | where it was |
| on the port | another address of the port | no | SECOND | where it was |
| on the port or elsewhere | any of these three | yes | NEW | only there |

The hub learns nothing from a frame with a wrong CRC: it is KNOWN where its sender is, and otherwise REFUSED.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from typing import NamedTuple

from mavftpfs.link.addresses import PATIENCE, NetAddress
from mavftpfs.link.messages import Address

PORT = 0
"""The side that SOURCE names."""

MEMORY = 60.0
"""Seconds of silence after which a sender is forgotten, once a new sender appears on its side."""
MOST_SENDERS = 512
"""The most senders of one side. If a program makes up more within 5 s, only the first ones count."""


class Place(NamedTuple):
    """A side, and an address there; None where the side has only one address, or chooses it itself."""

    side: int
    address: NetAddress | None


class Belief(Enum):
    """Verdict on a frame, by its sender and its place."""

    KNOWN = "believed"
    NEW = "believed, and its sender is at a new place"
    SECOND = "of a second vehicle on the port with the same id, or of a fake"
    REFUSED = "not believed: it returns through a loop, or is a fake"


class Senders:
    """The recently heard senders, with their places."""

    def __init__(self) -> None:
        self._heard: dict[Address, dict[Place, float]] = {}
        self._seconds: dict[Address, tuple[NetAddress, float]] = {}

    def __contains__(self, sender: Address) -> bool:
        return sender in self._heard

    def judge(self, sender: Address, place: Place, now: float, *, proven: bool) -> Belief:
        """Return the verdict on a frame, and note its sender's place. proven: its CRC is right."""
        known = self._heard.get(sender, {})
        if place in known:
            if proven:
                known[place] = now
            return Belief.KNOWN
        if not proven:
            return Belief.REFUSED
        on_port = any(heard.side == PORT for heard in known)
        if on_port or (known and place.side == PORT):
            if now - max(known.values()) <= PATIENCE:
                if not on_port or place.side != PORT:
                    return Belief.REFUSED
                self._seconds.setdefault(sender, (place.address or (), now))
                return Belief.SECOND
            for heard in list(known):  # the sender moved
                self._forget(sender, heard)
        if not self._has_room(place.side, now):
            return Belief.REFUSED
        self._heard.setdefault(sender, {})[place] = now
        return Belief.NEW

    def doubles(self) -> dict[Address, NetAddress]:
        """Return the senders of the port that were also heard at a second address, and that address. A sender
        that moved is not among them: a double was heard at the first address again."""
        return {
            sender: address
            for sender, (address, since) in self._seconds.items()
            if max(self._heard[sender].values()) > since
        }

    def places_of(self, target: Address) -> list[Place]:
        """Return the places of a component, or otherwise of its system; none for a target that means
        everybody."""
        if target in self._heard:
            return list(self._heard[target])
        if not target.system:
            return []
        return [
            place
            for sender, places in self._heard.items()
            if sender.system == target.system
            for place in places
        ]

    def places_at(self, side: int) -> list[Place]:
        """Return the places of a side that have senders."""
        return list(dict.fromkeys(place for _, place, _ in self._at(side)))

    def heard_at(self, side: int) -> float | None:
        """Return the time when a side was last heard."""
        return max((at for _, _, at in self._at(side)), default=None)

    def remove(self, side: int) -> None:
        """Forget the senders of a side."""
        for sender, place, _ in list(self._at(side)):
            self._forget(sender, place)

    def _at(self, side: int) -> Iterator[tuple[Address, Place, float]]:
        """Yield each sender of a side, its place there, and when it was last heard."""
        for sender, places in self._heard.items():
            for place, at in places.items():
                if place.side == side:
                    yield sender, place, at

    def _has_room(self, side: int, now: float) -> bool:
        """Return whether one more sender of a side may be noted. Forget those that are silent."""
        there = list(self._at(side))
        patience = MEMORY if len(there) < MOST_SENDERS else PATIENCE
        silent = [(sender, place) for sender, place, at in there if now - at > patience]
        for sender, place in silent:
            self._forget(sender, place)
        return len(there) - len(silent) < MOST_SENDERS

    def _forget(self, sender: Address, place: Place) -> None:
        """Forget that a sender is at a place."""
        del self._heard[sender][place]
        if not self._heard[sender]:
            del self._heard[sender]
            self._seconds.pop(sender, None)
