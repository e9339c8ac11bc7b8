"""Components on a link, and whether they serve files. Layer: client; prints nothing."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import Any

import trio

from mavftpfs.client.connect import connect_options, opened, waiting
from mavftpfs.client.files import Target, heartbeats_in, usable_status
from mavftpfs.client.listening import listening
from mavftpfs.client.mounts import mounts_on, with_vehicles
from mavftpfs.client.status import second_vehicle
from mavftpfs.link.base import Link
from mavftpfs.link.messages import MAV_TYPE_GCS, Address, Heartbeat
from mavftpfs.link.peers import describe_peer, names_of
from mavftpfs.session.connection import connected, heard_within
from mavftpfs.shared.errors import FtpNak, MavftpfsError, VehicleLost
from mavftpfs.shared.options import Options
from mavftpfs.shared.readable import readable_time

Component = dict[str, Any]
"""The facts of a component on a link, as of `scan --json`."""

LISTEN_TIME = 3.0
"""Seconds in which every component sends its heartbeat at least twice."""
PROBE_TIME = 6.0
"""The most seconds for a component to answer a listing."""


async def scan(target: Target, show: Callable[[Component], None]) -> list[Component]:
    """Return the components that send heartbeats on a link, and which of them answer MAVLink FTP.

    show: called with each as soon as it is known. A component that does not answer takes PROBE_TIME, or
    connect_timeout if that is less.

    Raises:
        VehicleLost: no heartbeat at all within connect_timeout.
    """
    if target.mount is not None:
        return _shown(await _by_mount(target.mount[0]), show)
    assert target.spec is not None
    mounted = await trio.to_thread.run_sync(mounts_on, target.spec, abandon_on_cancel=True)
    found = _shown(_of_mounts(mounted), show)
    async with opened(target.spec, target.options) as link:
        async for entry in _others(link, target, {(one["system"], one["component"]) for one in found}):
            found += _shown([entry], show)
    return sorted(found, key=itemgetter("system", "component"))


def _shown(entries: list[Component], show: Callable[[Component], None]) -> list[Component]:
    for entry in entries:
        show(entry)
    return entries


async def _by_mount(mountpoint: str) -> list[Component]:
    """Return the entries from a mount, or from the mounts of several vehicles."""
    status = await usable_status(mountpoint)
    if "members" in status:
        _, *below = await trio.to_thread.run_sync(with_vehicles, status)
        return [_own_entry(vehicle) for vehicle in below if not vehicle.get("problem")]
    return _of_mount(status)


async def _others(link: Link, target: Target, known: Collection[tuple[int, int]]) -> AsyncIterator[Component]:
    """Yield the other components that are heard, with their answers to MAVLink FTP."""
    assert target.spec is not None
    options, tell = target.options, target.sinks.tell
    patience = min(PROBE_TIME, options.connect_timeout)

    def on_heard(heartbeat: Heartbeat) -> None:
        tell(f"heard {names_of([heartbeat])}")

    heard = await _listen(link, options, partial(tell, waiting(target.spec, options)), on_heard)
    for address in sorted(heard.keys() - known):
        yield await _probe(link, options, heard[address], patience)


async def _listen(
    link: Link, options: Options, on_wait: Callable[[], None], on_new: Callable[[Heartbeat], None]
) -> dict[Address, Heartbeat]:
    """Return the heartbeats that arrive within LISTEN_TIME of the first one."""
    found: dict[Address, Heartbeat] = {}

    def on_heard(heartbeat: Heartbeat) -> None:
        if heartbeat.source not in found:
            on_new(heartbeat)
        found[heartbeat.source] = heartbeat

    async with listening(link, options, on_heard) as listener:
        if not await heard_within(listener.first, options.connect_timeout, on_wait):
            raise listener.nobody(options.connect_timeout)
        await trio.sleep(min(LISTEN_TIME, options.connect_timeout / 2))
    return found


def _entry(heartbeat: Heartbeat, ftp: str) -> Component:
    """Return the entry for a heartbeat; ftp: the words about its sender's files."""
    return {
        "system": heartbeat.source.system,
        "component": heartbeat.source.component,
        "what": describe_peer(heartbeat),
        "autopilot": heartbeat.autopilot,
        "type": heartbeat.vehicle_type,
        "armed": heartbeat.armed,
        "firmware": None,
        "uid": None,
        "ftp": ftp,
        "answers": None,
        "seen": [],
    }


async def _probe(link: Link, options: Options, heartbeat: Heartbeat, patience: float) -> Component:
    address = heartbeat.source
    entry = _entry(heartbeat, "not asked (a ground station)")
    if heartbeat.vehicle_type == MAV_TYPE_GCS:
        return entry
    wanted = replace(
        connect_options(options), target_system=address.system, target_component=address.component
    )
    async with connected(link, wanted) as connection:
        answer = "no answer"
        try:
            with trio.move_on_after(patience):
                await connection.ready(patience)
                await connection.store.list_directory(options.root)
                answer = "answers"
        except FtpNak as exc:
            answer = f"answers, but: {exc}"
        except VehicleLost:
            answer = "no answer (its heartbeats stopped)"
        except MavftpfsError as exc:
            answer = f"no answer ({exc})"
        answers = answer.startswith("answers")
        facts = connection.status()
        entry.update(
            ftp=answer,
            seen=_seen(facts, answers=answers),
            answers=answers,
            firmware=facts["vehicle"]["firmware"],
            uid=facts["vehicle"]["uid"],
            facts=facts["connection"],
        )
    return entry


def _seen(facts: Mapping[str, Any], *, answers: bool) -> list[str]:
    """Return the other observations of its FTP."""
    seen = []
    flag, rtt, times = facts["vehicle"]["says_ftp"], facts["link"]["rtt"], facts["connection"]["lists_times"]
    if flag is not None and flag is not answers:
        seen.append("says it supports FTP" if flag else "says it does not support FTP")
    if answers and rtt is not None:
        seen.append(f"in {readable_time(rtt)}")
    if answers and times is not None:
        seen.append("listings with times" if times else "listings without times")
    if facts["link"]["other_ftp_client"]:
        seen.append("another FTP client is heard")
    return seen + _second(facts)


def _own_entry(status: Mapping[str, Any]) -> Component:
    """Return the entry of a mount's vehicle."""
    vehicle, lost = status["vehicle"], status["link"]["state"] == "lost"
    return {
        "system": vehicle["system"],
        "component": vehicle["component"],
        "what": f"{vehicle['autopilot'] or 'unknown'}, {'armed' if vehicle['armed'] else 'disarmed'}",
        "autopilot": status["connection"]["autopilot"],
        "type": status["connection"]["type"],
        "armed": vehicle["armed"],
        "firmware": vehicle["firmware"],
        "uid": vehicle["uid"],
        "ftp": f"mounted on {status['mountpoint']}",
        "answers": not lost,
        "seen": ["the vehicle is silent"] * lost + _second(status),
        "facts": status["connection"],
    }


def _of_mounts(statuses: Sequence[Mapping[str, Any]]) -> list[Component]:
    """Return the entries of mounts' vehicles, one for each vehicle, however many mounts it has."""
    found: dict[tuple[Any, ...], Component] = {}
    for status in sorted(statuses, key=lambda status: status["link"]["state"] == "lost"):
        entry = _own_entry(status)
        same = found.setdefault((entry["system"], entry["component"], entry["uid"]), entry)
        if same is not entry:
            same["ftp"] += f" and on {status['mountpoint']}"
    return list(found.values())


def _second(facts: Mapping[str, Any]) -> list[str]:
    second = facts["link"].get("second")
    return [] if second is None else [second_vehicle(facts)]


def _of_mount(status: Mapping[str, Any]) -> list[Component]:
    """Return the entries of a mount's vehicle, and of others that the mount hears; these are not asked."""
    own = _own_entry(status)
    others = [one for one in heartbeats_in(status) if one.source != (own["system"], own["component"])]
    reason = f"not asked (the mount on {status['mountpoint']} has the link)"
    return [own, *(_entry(one, reason) for one in others)]
