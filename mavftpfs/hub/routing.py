"""The destinations of each frame. Layer: hub; pure.

Frames come from *sides* and go to sides: the port that SOURCE names, endpoints, and clients, which are
mavftpfs programs. Only a frame that `senders` believes goes anywhere.

- A frame with a target goes to the target. A frame for all, or for a target that was never heard, goes to all
  places of the port and of the endpoints. No frame goes to a side where its sender is.
- A client's frames go to the address that it names, if a sender was heard there. Otherwise they follow the
  same rule, but go to the port alone.
- A client's vehicle is the target that its frames named last. A client receives all frames of its vehicle,
  FTP with its vehicle, and the heartbeats of other vehicles. Until it names a vehicle, it receives only
  heartbeats. `_concerns` decides.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

from mavftpfs.hub.senders import PORT, Belief, Place, Senders
from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.fastframe import FTP_MESSAGE_ID
from mavftpfs.link.frames import EVERYBODY, HEARTBEAT_ID, Frame, armed_by
from mavftpfs.link.messages import Address

_MOST_PLANS = 4096


class Kind(Enum):
    """Kind of a side."""

    PORT = "port"
    ENDPOINT = "endpoint"
    CLIENT = "client"


@dataclass(slots=True)
class _Side:
    """fixed: every frame for this side goes to one address. focus: a client's vehicle, None before it names
    one."""

    kind: Kind
    fixed: bool
    focus: int | None = None


class Router:
    """Knows the sides, and the destinations of a frame.

    Attributes:
        senders: the senders that were heard, with their places.
        armed: system -> whether its autopilot's last heartbeat said that it is armed.
    """

    def __init__(self) -> None:
        self.senders = Senders()
        self.armed: dict[int, bool] = {}
        self._sides: dict[int, _Side] = {}
        self._plans: dict[tuple[Place, Address, Address, bool, NetAddress | None], tuple[Place, ...]] = {}

    # -- sides

    def add(self, side: int, kind: Kind, *, fixed: bool = True) -> None:
        """Add a side. fixed: its frames have one way out, for every address."""
        self._sides[side] = _Side(kind, fixed)
        self._plans.clear()

    def remove(self, side: int) -> None:
        """Forget a side and its senders; harmless if the side is unknown."""
        self._sides.pop(side, None)
        self.senders.remove(side)
        self._plans.clear()

    # -- frames

    def route(
        self, frame: Frame, place: Place, now: float, to: NetAddress | None = None
    ) -> tuple[Place, ...]:
        """Return the destinations of a frame that arrived at a place; none if the frame is refused. to: the
        address of the port that a client named."""
        belief = self.senders.judge(frame.source, place, now, proven=frame.crc_fits)
        if belief is Belief.REFUSED:
            return ()
        if belief is Belief.SECOND:
            # Each client judges by unique ids which of two vehicles is the mounted one.
            return tuple(self._to_clients(frame, place))
        if belief is Belief.NEW:
            self._plans.clear()
        if frame.id == HEARTBEAT_ID:  # noted first, because its destinations depend on its content
            self._note_armed(frame, place)
            return (*self._out(frame, place, to), *self._to_clients(frame, place))
        self._note_focus(frame, place)
        key = (place, frame.source, frame.target, frame.id == FTP_MESSAGE_ID, to)
        plan = self._plans.get(key)
        if plan is None:
            if len(self._plans) >= _MOST_PLANS:
                self._plans.clear()
            plan = self._plans[key] = (*self._out(frame, place, to), *self._to_clients(frame, place))
        return plan

    def _note_focus(self, frame: Frame, place: Place) -> None:
        side, system = self._sides[place.side], frame.target.system
        if side.kind is Kind.CLIENT and system not in (EVERYBODY.system, side.focus):
            side.focus = system
            self._plans.clear()

    def _note_armed(self, frame: Frame, place: Place) -> None:
        armed = armed_by(frame) if place.side == PORT and frame.crc_fits else None
        if armed is not None:
            self.armed[frame.source.system] = armed

    def _out(self, frame: Frame, place: Place, to: NetAddress | None) -> list[Place]:
        """Return the frame's destinations on the port and at endpoints."""
        origin = self._sides[place.side]
        if to is not None and Place(PORT, to) in self.senders.places_at(PORT):
            return [self._way_to(Place(PORT, to))]
        if origin.kind is Kind.CLIENT:
            sides = {PORT}
        else:
            sides = {number for number, side in self._sides.items() if side.kind is not Kind.CLIENT}
            sides -= {heard.side for heard in self.senders.places_of(frame.source)}
        targets = self.senders.places_of(frame.target)
        if not targets:
            targets = [found for side in sorted(sides) for found in self._places_at(side)]
        return list(dict.fromkeys(self._way_to(found) for found in targets if found.side in sides))

    def _places_at(self, side: int) -> list[Place]:
        return [Place(side, None)] if self._sides[side].fixed else self.senders.places_at(side)

    def _way_to(self, place: Place) -> Place:
        return Place(place.side, None) if self._sides[place.side].fixed else place

    def _to_clients(self, frame: Frame, place: Place) -> Iterator[Place]:
        """Yield the clients that a frame concerns."""
        kind = self._sides[place.side].kind
        for_all = frame.id == HEARTBEAT_ID and _is_for_all_clients(frame, kind)
        for number, side in self._sides.items():
            if (
                side.kind is Kind.CLIENT
                and number != place.side
                and (for_all or _concerns(side.focus, frame, kind))
            ):
                yield Place(number, None)


def _is_for_all_clients(beat: Frame, origin: Kind) -> bool:
    """Return whether every client receives a heartbeat. Clients hear vehicles, which are on the port, and
    ground stations, but not one another."""
    return origin is Kind.PORT or (origin is Kind.ENDPOINT and armed_by(beat) is None)


def _concerns(focus: int | None, frame: Frame, origin: Kind) -> bool:
    """Return whether a client with that focus receives a frame."""
    of_vehicle = origin is Kind.PORT and frame.source.system == focus
    with_vehicle = frame.id == FTP_MESSAGE_ID and frame.target.system in (EVERYBODY.system, focus)
    return focus is not None and (of_vehicle or with_vehicle)
