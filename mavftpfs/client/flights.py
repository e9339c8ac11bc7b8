"""What a watch does next: wait, look which logs there are, fetch one, or let go. Layer: client; pure.

A flight ends when a vehicle is disarmed. Then its logs are looked at. A log that has not grown for QUIET is
fetched. A log that still grows PATIENCE after the end of the flight is fetched up to its present size, and
looked at again with growing pauses. While a vehicle is armed, is lost, or just refused to be armed, nothing
is asked of it. All times are of one clock, in seconds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import NamedTuple, TypeAlias

QUIET = 10.0
"""Seconds without growth after which a log counts as whole."""
PATIENCE = 60.0
"""Seconds after the end of a flight in which a log may grow. ArduPilot logs on for 15 s."""
REFUSED = 60.0
"""Seconds without a transfer after a vehicle refused to arm: the load of a transfer may be the reason (MAVSDK
issue 1636)."""
LOST = 10.0
"""Seconds without a heartbeat after which a vehicle is lost."""
RETRY, MOST_RETRY = 30.0, 600.0
"""Seconds until a failed step is tried again: the first time, and at most."""
GROWN, MOST_GROWN = 60.0, 3600.0
"""Seconds until a log that grew all the time is looked at again: the first time, and at most."""


class Log(NamedTuple):
    """A log that is not here yet, as it is listed."""

    path: bytes
    size: int


@dataclass(frozen=True, slots=True)
class Wait:
    """Do nothing before that time, unless something is heard."""

    until: float


@dataclass(frozen=True, slots=True)
class Look:
    """List the logs of a vehicle, and tell `looked`."""

    system: int


@dataclass(frozen=True, slots=True)
class Fetch:
    """Fetch a log, and tell `fetched`, `grows` or `failed`."""

    system: int
    log: Log


Step: TypeAlias = Wait | Look | Fetch


@dataclass(slots=True)
class _Sighting:
    """A log that is not here yet. since: when it was first seen with that size; grown: how often it was
    fetched while it grew."""

    size: int
    since: float
    grown: int = 0


@dataclass(slots=True)
class _Vehicle:
    """armed: None before that is known. ended_at: when its last flight ended, or when it came. look_at: when
    its logs are looked at next, infinite for never."""

    armed: bool | None = None
    heard_at: float = -inf
    lost: bool = False
    ended_at: float = -inf
    look_at: float = inf
    paused_until: float = -inf
    failures: int = 0
    seen: dict[bytes, _Sighting] = field(default_factory=dict)
    ready: list[Log] = field(default_factory=list)


class Policy:
    """Decides for all vehicles on a link; a system id is a vehicle."""

    def __init__(self) -> None:
        self._vehicles: dict[int, _Vehicle] = {}
        self._served = 0
        self._trouble_until = -inf

    # --- what happens

    def heard(self, system: int, armed: bool, now: float) -> str:
        """Take a vehicle's heartbeat; return what is new: "here", "back", "armed", "disarmed", or ""."""
        vehicle = self._vehicles.setdefault(system, _Vehicle())
        before, was_lost = vehicle.armed, vehicle.lost
        vehicle.armed, vehicle.heard_at, vehicle.lost = armed, now, False
        if before is armed and not was_lost:
            return ""
        if armed:
            vehicle.ready.clear()
            vehicle.look_at = inf
        else:
            self._begin(vehicle, now)
        if was_lost:
            return "back"
        return "here" if before is None else "armed" if armed else "disarmed"

    def restarted(self, system: int, now: float) -> None:
        """A vehicle restarted: it may have other logs, and closed those that grew."""
        vehicle = self._vehicles.get(system)
        if vehicle is not None and not vehicle.armed:
            self._begin(vehicle, now)

    def refused(self, system: int, now: float) -> None:
        """A vehicle refused to be armed."""
        vehicle = self._vehicles.get(system)
        if vehicle is not None:
            vehicle.paused_until = now + REFUSED
            if vehicle.ready:  # its logs are listed again: it may be another vehicle then
                vehicle.ready.clear()
                vehicle.look_at = now

    def replaced(self, system: int) -> None:
        """Another vehicle has that system id now."""
        self._vehicles.pop(system, None)

    def newly_lost(self, now: float) -> Iterator[int]:
        """Yield the vehicles that are lost since the last call."""
        for system, vehicle in self._vehicles.items():
            if not vehicle.lost and now - vehicle.heard_at > LOST:
                vehicle.lost = True
                vehicle.ready.clear()
                yield system

    # --- what is done

    def may_transfer(self, system: int, now: float) -> bool:
        """Return whether a vehicle may be asked for something; if not, a transfer under way lets go."""
        vehicle = self._vehicles.get(system)
        if vehicle is None or vehicle.lost or vehicle.armed is not False:
            return False
        return now >= vehicle.paused_until

    def next(self, now: float) -> Step:
        """Return what to do now. The vehicle that was served last goes on, so that it is left only once."""
        if now < self._trouble_until:
            return Wait(self._trouble_until)
        for system in sorted(self._vehicles, key=lambda system: (system != self._served, system)):
            vehicle = self._vehicles[system]
            if self.may_transfer(system, now) and (vehicle.ready or vehicle.look_at <= now):
                self._served = system
                return Fetch(system, vehicle.ready[0]) if vehicle.ready else Look(system)
        return Wait(min(self._deadlines(), default=inf))

    def looked(self, system: int, logs: Sequence[Log], now: float) -> None:
        """Take the logs of a vehicle that are not here yet, in the order in which they are to be fetched."""
        vehicle = self._vehicles.get(system)
        if vehicle is None:
            return
        before, vehicle.seen = vehicle.seen, {}
        vehicle.ready.clear()
        vehicle.look_at = inf
        for log in logs:
            sighting = before.get(log.path, _Sighting(-1, now))
            grew = sighting.size != log.size
            if grew:
                sighting = _Sighting(log.size, now, sighting.grown)
            vehicle.seen[log.path] = sighting
            impatient = now - vehicle.ended_at >= PATIENCE and not sighting.grown
            if now - sighting.since >= QUIET or impatient:
                vehicle.ready.append(log)
            elif grew and sighting.grown:
                again = min(GROWN * 2 ** (sighting.grown - 1), MOST_GROWN)
                sighting.grown += 1
                vehicle.look_at = min(vehicle.look_at, now + again)
            else:
                vehicle.look_at = min(vehicle.look_at, sighting.since + QUIET)

    def fetched(self, system: int, log: Log) -> None:
        """Note that a log is here, or is not on the vehicle any more."""
        vehicle = self._taken(system, log)
        if vehicle is not None:
            vehicle.failures = 0
            vehicle.seen.pop(log.path, None)

    def grows(self, system: int, log: Log, now: float) -> bool:
        """Note that a log grew while it was fetched; return whether to say so, because it grows for long."""
        vehicle = self._taken(system, log)
        if vehicle is None:
            return False
        late = now - vehicle.ended_at >= PATIENCE
        sighting = vehicle.seen[log.path] = vehicle.seen.get(log.path, _Sighting(log.size, now))
        sighting.size, sighting.since = -1, now
        first, sighting.grown = late and not sighting.grown, max(sighting.grown, int(late))
        vehicle.look_at = min(vehicle.look_at, now + (GROWN if late else QUIET))
        return first

    def failed(self, system: int, log: Log | None, now: float) -> None:
        """Note that a log could not be fetched, or that the logs could not be listed."""
        vehicle = self._taken(system, log)
        if vehicle is not None:
            again = now + min(RETRY * 2 ** min(vehicle.failures, 10), MOST_RETRY)
            vehicle.failures += 1
            vehicle.look_at = again if log is None else min(vehicle.look_at, again)

    def local_trouble(self, now: float) -> None:
        """Note that the local disk takes nothing now."""
        self._trouble_until = now + RETRY

    # --- inside

    def _begin(self, vehicle: _Vehicle, now: float) -> None:
        """Count all as new from now on."""
        vehicle.ended_at = vehicle.look_at = now
        vehicle.failures = 0
        vehicle.seen.clear()
        vehicle.ready.clear()

    def _taken(self, system: int, log: Log | None) -> _Vehicle | None:
        vehicle = self._vehicles.get(system)
        if vehicle is not None and log in vehicle.ready:
            vehicle.ready.remove(log)
        return vehicle

    def _deadlines(self) -> Iterator[float]:
        """Yield the times at which there is something to do even if nothing is heard."""
        for vehicle in self._vehicles.values():
            if not vehicle.lost and vehicle.armed is False:
                yield max(vehicle.look_at, vehicle.paused_until)
