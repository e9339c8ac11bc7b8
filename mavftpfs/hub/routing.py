"""Where each frame goes. Layer: hub; pure.

Frames come from *sides* and go to sides: the port that SOURCE names (side 0), an endpoint, a client. A side
may have several *places*: the network addresses that are heard there.

- A sender counts only from where it was first heard, as on a port of our own (link.addresses). So a loop of
  cables and forwards ends here: a frame that comes back by another way is not believed.
- A frame with a target goes where the target was heard. A frame for all, or for a target that was never
  heard, goes to all other sides. No frame goes to a side where its sender was heard.
- Clients are programs of ours. Each gets the frames that concern its vehicle, and its frames go to its
  vehicle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

from mavftpfs.link.addresses import PATIENCE, AddressBook, NetAddress
from mavftpfs.link.fastframe import FTP_MESSAGE_ID
from mavftpfs.link.frames import EVERYBODY, HEARTBEAT_ID, Frame, armed_by
from mavftpfs.link.messages import Address

PORT = 0
"""The side that SOURCE names."""

ALL = 0
"""The focus of a client that does not know its vehicle yet."""
BEATS = -1
"""The focus of a client that wants only heartbeats."""

BEAT_PERIOD = 0.5
"""Seconds between two heartbeats of one sender that clients with another vehicle get."""
MEMORY = 60.0
"""Seconds for which a place that fell silent still gets the frames for all."""
_MOST_PLACES = 64
_MOST_SENDERS = 64
"""Of one side."""
_MOST_PLANS = 4096


class Kind(Enum):
    """What a side is."""

    PORT = "port"
    ENDPOINT = "endpoint"
    CLIENT = "client"


class Place(NamedTuple):
    """A side, and an address there; None where the side has only one, or chooses it itself."""

    side: int
    address: NetAddress | None


@dataclass(slots=True)
class _Side:
    """fixed: all frames go there to one address. focus: the system that concerns a client. answers: the
    address that a client sends to."""

    kind: Kind
    fixed: bool
    focus: int = ALL
    answers: NetAddress | None = None
    heard: dict[NetAddress | None, float] = field(default_factory=dict)


class Router:
    """Knows the sides, what was heard where, and where a frame goes.

    Attributes:
        doubles: senders of the port that were heard at a second address too, and where: two vehicles, or a
            fake.
        armed: system -> whether its autopilot's last heartbeat said that it is armed.
    """

    def __init__(self) -> None:
        self.doubles: dict[Address, NetAddress] = {}
        self.armed: dict[int, bool] = {}
        self._sides: dict[int, _Side] = {}
        self._book = AddressBook()
        self._suspects: dict[Address, NetAddress] = {}
        self._elsewhere: dict[Address, dict[Place, float]] = {}
        self._beats: dict[Address, float] = {}
        self._plans: dict[tuple[Place, Address, Address, bool], tuple[Place, ...]] = {}

    # -- sides

    def add(self, side: int, kind: Kind, *, fixed: bool) -> None:
        """Add a side. fixed: its frames have one way out, whatever the address."""
        self._sides[side] = _Side(kind, fixed)
        self._plans.clear()

    def remove(self, side: int) -> None:
        """Forget a side, and what was heard there."""
        del self._sides[side]
        for sender, places in list(self._elsewhere.items()):
            for place in [place for place in places if place.side == side]:
                del places[place]
            if not places:
                del self._elsewhere[sender]
        self._plans.clear()

    def focus(self, side: int, system: int) -> None:
        """Only one system concerns a client from now on, or ALL, or BEATS."""
        self._sides[side].focus = system
        self._plans.clear()

    def answer(self, side: int, address: NetAddress | None) -> None:
        """Note the address of a client's vehicle."""
        self._sides[side].answers = address
        self._plans.clear()

    def taken(self, wanted: Address, now: float) -> bool:
        """Return whether a program uses a MAVLink address."""
        return wanted in self._elsewhere or self._book.place_of(wanted, now) is not None

    def heard_at(self, side: int) -> float | None:
        """Return when something was heard from a side last."""
        return max(self._sides[side].heard.values(), default=None)

    # -- frames

    def route(self, frame: Frame, place: Place, now: float) -> tuple[Place, ...]:
        """Return where a frame goes that came from a place; nowhere if it is not believed."""
        side = self._sides[place.side]
        if not self._is_believed(frame, place, side.kind, now):
            if side.kind is not Kind.PORT or frame.source in self._elsewhere:
                return ()
            # Each client judges by unique ids which of two vehicles is the mounted one.
            return tuple(self._clients(frame, place, now))
        if place.address not in side.heard:
            self._welcome(place.address, side, now)
        side.heard[place.address] = now
        if frame.id == HEARTBEAT_ID:
            self._on_heartbeat(frame, side)
            return (*self._plan(frame, place), *self._clients(frame, place, now))
        key = (place, frame.source, frame.target, frame.id == FTP_MESSAGE_ID)
        plan = self._plans.get(key)
        if plan is None:
            if len(self._plans) >= _MOST_PLANS:
                self._plans.clear()
            plan = self._plans[key] = (*self._plan(frame, place), *self._clients(frame, place, now))
        return plan

    def _is_believed(self, frame: Frame, place: Place, kind: Kind, now: float) -> bool:
        """Return whether a frame from a place is believed, and note its sender."""
        sender, book = frame.source, self._book
        if kind is Kind.PORT:
            others = self._elsewhere.get(sender)
            if others is not None and now - max(others.values()) <= PATIENCE:
                return False  # it comes back
            where = place.address or ()
            before = book.last_place(sender)
            if not frame.crc_fits:
                return before == where
            if not book.accepts(sender, where, now):
                self._suspects[sender] = where
                return False
            if others is not None:  # it is silent there
                del self._elsewhere[sender]
                self._plans.clear()
            if before != where:
                self._plans.clear()
                self._suspects.pop(sender, None)
                self.doubles.pop(sender, None)
            elif sender in self._suspects:  # both are there: it did not just move
                self.doubles[sender] = self._suspects.pop(sender)
            return True
        if book.place_of(sender, now) is not None:
            return False  # it comes back, or claims to be the vehicle
        places = self._elsewhere.get(sender)
        if places is not None and place in places:
            places[place] = now
            return True
        if not frame.crc_fits:
            return False
        self._make_room(place.side)
        self._elsewhere.setdefault(sender, {})[place] = now
        self._plans.clear()
        return True

    def _make_room(self, side: int) -> None:
        """If a side has too many senders, because it makes them up, forget the one that was silent for
        longest."""
        heard = [
            (at, sender, place)
            for sender, places in self._elsewhere.items()
            for place, at in places.items()
            if place.side == side
        ]
        if len(heard) >= _MOST_SENDERS:
            _, sender, place = min(heard, key=lambda one: one[0])
            del self._elsewhere[sender][place]
            if not self._elsewhere[sender]:
                del self._elsewhere[sender]

    def _welcome(self, address: NetAddress | None, side: _Side, now: float) -> None:
        """Note a new address of a side, and forget those that fell silent."""
        if len(side.heard) >= _MOST_PLACES:
            del side.heard[min(side.heard, key=lambda known: side.heard[known])]
        for known in [known for known, at in side.heard.items() if now - at > MEMORY]:
            del side.heard[known]
        side.heard[address] = now
        self._plans.clear()

    def _on_heartbeat(self, frame: Frame, side: _Side) -> None:
        armed = armed_by(frame) if side.kind is Kind.PORT and frame.crc_fits else None
        if armed is not None:
            self.armed[frame.source.system] = armed

    def _plan(self, frame: Frame, place: Place) -> Iterator[Place]:
        """Yield the places on the port and at endpoints that a frame goes to."""
        origin = self._sides[place.side]
        known = [where for where in self._places_of(frame.target) if where.side != place.side]
        if origin.kind is Kind.CLIENT:
            if origin.answers is not None:
                yield self._outlet(PORT, origin.answers)
                return
            known = [where for where in known if where.side == PORT]
            yield from known or self._all_of(PORT)
            return
        shunned = {place.side, *(heard.side for heard in self._elsewhere.get(frame.source, ()))}
        if not known:
            others = [number for number, side in self._sides.items() if side.kind is not Kind.CLIENT]
            known = [where for number in others for where in self._all_of(number)]
        for where in known:
            if where.side not in shunned and self._sides[where.side].kind is not Kind.CLIENT:
                yield where

    def _places_of(self, target: Address) -> list[Place]:
        """Return where a component was heard, or else its system."""
        system: dict[Place, None] = {}
        exact: dict[Place, None] = {}
        if target.system:
            for sender, address in self._book.known():
                if sender.system == target.system:
                    found = exact if sender == target else system
                    found[self._outlet(PORT, address or None)] = None
            for sender, places in self._elsewhere.items():
                if sender.system == target.system:
                    found = exact if sender == target else system
                    found.update(dict.fromkeys(self._outlet(*where) for where in places))
        return list(exact or system)

    def _all_of(self, number: int) -> list[Place]:
        """Return all places of a side."""
        side = self._sides[number]
        return [Place(number, None)] if side.fixed else [Place(number, address) for address in side.heard]

    def _outlet(self, number: int, address: NetAddress | None) -> Place:
        return Place(number, None if self._sides[number].fixed else address)

    def _clients(self, frame: Frame, place: Place, now: float) -> Iterator[Place]:
        """Yield the clients that a frame concerns."""
        kind, heartbeat = self._sides[place.side].kind, frame.id == HEARTBEAT_ID
        if kind is not Kind.PORT and frame.id != FTP_MESSAGE_ID:
            # Vehicles are on the port. Clients need to hear of ground stations, but not of each other.
            station = heartbeat and kind is Kind.ENDPOINT and armed_by(frame) is None
            if not station:
                return
        due = heartbeat and self._is_beat_due(frame.source, now)
        for number, side in self._sides.items():
            if side.kind is not Kind.CLIENT or number == place.side:
                continue
            if due or _concerns(side.focus, frame, on_port=kind is Kind.PORT):
                yield Place(number, None)

    def _is_beat_due(self, sender: Address, now: float) -> bool:
        if now - self._beats.get(sender, float("-inf")) < BEAT_PERIOD:
            return False
        if len(self._beats) >= _MOST_PLANS:
            self._beats.clear()
        self._beats[sender] = now
        return True


def _concerns(focus: int, frame: Frame, *, on_port: bool) -> bool:
    """Return whether a client with that focus gets a frame, from the port or from elsewhere."""
    if focus == BEATS:
        return False
    if focus == ALL or (on_port and frame.source.system == focus):
        return True
    return frame.id == FTP_MESSAGE_ID and frame.target.system in (EVERYBODY.system, focus)
