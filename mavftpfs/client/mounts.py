"""The mounts that are up, and the status of each. Layer: client.

The kernel's table of sockets shows the control socket of a mount, whose name is a hash of the mountpoint. The
mount answers over its socket. If a mount does not answer, or does not serve this user, its status has only
`mountpoint`, `source`, `state` (dead, mute, foreign) and `problem`.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any

from mavftpfs import __version__
from mavftpfs.client import control, wire
from mavftpfs.client.control import ControlError, NobodyThere, Refused
from mavftpfs.client.mountpoint import (
    OUR_TYPE,
    Mounted,
    canonical,
    enclosing_mount,
    is_dead,
    mounts,
    vehicles_below,
)
from mavftpfs.client.status import Facts
from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID
from mavftpfs.link.samelink import same_link
from mavftpfs.link.uri import LinkSpec, parse_source
from mavftpfs.shared.errors import LinkClosed, MavftpfsError
from mavftpfs.shared.model import normalise
from mavftpfs.shared.options import Options

Status = Mapping[str, Any]

PATIENCE = 10.0
"""Seconds for a mount to answer, which it does without asking the vehicle."""
STATUS_PATIENCE = 3.0
"""Seconds for a mount to answer a command that can do without the answer."""

_OF_ONE_VEHICLE = frozenset(("vehicle", "link", "transfers", "held", "connection", "cache"))
"""Keys in the status of a mount of one vehicle; a mount of another version may lack some."""


# -- asking ---------------------------------------------------------------------------------------


def all_statuses() -> list[Status]:
    """Return the status of each mount that this user may see, the dead ones too, by mountpoint."""
    found = {status["mountpoint"]: status for status in _of_mounts(PATIENCE)}
    known = {control.socket_name(path) for path in found}
    for socket in control.all_sockets():
        if socket.name not in known:
            # The kernel no longer shows this mount, but it still uploads; or it is in another mount
            # namespace.
            with suppress(ControlError):  # only the mount itself could say which one it is
                status = _ask(socket, PATIENCE)
                found.setdefault(status["mountpoint"], status)
    return [found[path] for path in sorted(found)]


def _of_mounts(patience: float) -> Iterator[Status]:
    """Yield the status of each mount in the kernel's table that this user may ask."""
    for path, mount in mounts().items():
        if mount.type == OUR_TYPE and mount.root == "/":  # otherwise a bind mount of a part
            status = _status_of(path, mount, patience)
            if status.get("state") != "foreign":
                yield status


def status_of(mountpoint: str, patience: float = PATIENCE) -> Status:
    """Return the status of one mount; without an answer, `state` and `problem` in words.

    Raises:
        NobodyThere: no vehicle is mounted there.
    """
    mount = mounts().get(mountpoint)
    if mount is not None and mount.type == OUR_TYPE:
        return _status_of(mountpoint, mount, patience)
    try:
        return _ask(control.find_socket(mountpoint), patience)
    except NobodyThere:  # it may have left its socket
        raise _nobody(mountpoint) from None


def socket_of(mountpoint: str) -> Path:
    """Return the control socket of a mount, which may have stopped answering.

    Raises:
        NobodyThere: there is no socket. Refused: the mount is another user's.
    """
    mount = mounts().get(mountpoint)
    if mount is None or mount.type != OUR_TYPE:
        return control.find_socket(mountpoint)
    for path in dict.fromkeys((mountpoint, *mount.others)):
        with suppress(NobodyThere):
            return control.find_socket(path, mount.uid)
    if os.getuid() not in (0, mount.uid):
        raise Refused(control.FOREIGN)
    raise _nobody(mountpoint)


def _status_of(path: str, mount: Mounted, patience: float) -> Status:
    """Return a mount's own status; without an answer, `state` and `problem`."""
    told: Facts = {"mountpoint": path, "source": mount.source}
    try:
        return _ask(socket_of(path), patience)
    except Refused as exc:
        return _unasked(told, "foreign", str(exc))
    except NobodyThere:
        if _is_dead(path):
            return _unasked(told, "dead", f"DEAD: its program is gone; run: mavftpfs umount {path}")
        return _unasked(told, "mute", "its socket cannot be reached from here")
    except ControlError as exc:
        return _unasked(told, "mute", f"its program does not answer: {exc}")


def _is_dead(path: str) -> bool:
    """Return whether a mount has lost its process; False if it does not answer, as one that was stopped."""
    answer = Future[bool]()
    threading.Thread(target=lambda: answer.set_result(is_dead(path)), daemon=True).start()
    try:
        return answer.result(STATUS_PATIENCE)
    except TimeoutError:
        return False


def _nobody(mountpoint: str) -> NobodyThere:
    return NobodyThere(f"no vehicle of yours is mounted on {mountpoint}")


def _unasked(told: Facts, state: str, problem: str) -> Status:
    return {**told, "state": state, "problem": problem}


def _ask(socket: Path, patience: float) -> Status:
    """Return the status from a mount's control socket, with all keys that other functions need."""
    status: Status = control.ask(socket, {"command": "status"}, timeout=patience)["status"]
    if "members" in status or status.keys() >= _OF_ONE_VEHICLE:
        return status
    theirs = status.get("version", "unknown")
    problem = f"its program is of version {theirs}, this one of {__version__}: unmount it, and mount it again"
    return _unasked(status, "mute", problem)


def require_usable(status: Status, mountpoint: str) -> None:
    """Check that a mount with this status answers, and has this program's version of the protocol.

    Raises:
        LinkClosed: it does not; the text gives the reason, or says which side to upgrade.
    """
    if status.get("problem"):
        raise LinkClosed(f"the mount on {mountpoint}: {status['problem']}")
    theirs = 0 if "members" in status else status.get("protocol", 0)
    if "members" in status or theirs == wire.VERSION:
        return
    version = status.get("version", "unknown")
    what = f"the mount on {mountpoint} is of mavftpfs {version}, this program of {__version__}"
    if theirs < wire.VERSION:
        raise LinkClosed(f"{what}; unmount it, and mount it again: mavftpfs umount {mountpoint}")
    raise LinkClosed(f"{what}; upgrade this program")


# -- mounts of all vehicles -----------------------------------------------------------------------


def several_at(place: str) -> Status | None:
    """Return the status of the mount of all vehicles below a directory; None if there is none."""
    try:
        status = _ask(control.find_socket(place), PATIENCE)
    except ControlError:
        return None
    return status if "members" in status else None


def statuses_at(place: str) -> list[Status]:
    """Return the statuses that belong to a mountpoint, or to the directory of a mount of all vehicles.

    The first one is dead if the process that started the vehicles' mounts is gone.

    Raises:
        NobodyThere: no vehicle is mounted there, or this user may not ask.
    """
    try:
        return with_vehicles(status_of(place))
    except NobodyThere:
        vehicles = [status_of(path) for path in vehicles_below(place)]
        if not vehicles:
            raise
        told = {"mountpoint": place, "source": vehicles[0]["source"]}
        problem = f"DEAD: no more vehicles are mounted; run: mavftpfs umount {place}"
        return [{**_unasked(told, "dead", problem), "vehicles": vehicles}, *vehicles]


def with_vehicles(status: Status) -> list[Status]:
    """Return the statuses that belong to one mountpoint: its own, and those of its vehicles if it has
    several, which are also under `vehicles` of the first."""
    if "members" not in status:
        return [status]
    vehicles: list[Status] = []
    for path in vehicles_below(status["mountpoint"]):
        with suppress(NobodyThere):
            vehicles.append(status_of(path))
    return [{**status, "vehicles": vehicles}, *vehicles]


# -- which mount has a link -------------------------------------------------------------------------


def network_namespace() -> str:
    """Return an identifier of this process's network namespace, unique among those that exist now."""
    facts = os.stat("/proc/self/ns/net")
    return f"{facts.st_dev}:{facts.st_ino}"


def has_link(status: Status, spec: LinkSpec) -> bool:
    """Return whether the mount with this status is of one vehicle and has that link. A port belongs to a
    network namespace; a mount of 0.2 does not name its own, and its socket is seen only there."""
    if "version" not in status or "members" in status:  # the mount does not answer, or is of several
        return False
    here = network_namespace()
    with suppress(MavftpfsError):
        return status.get("network_namespace", here) == here and same_link(
            parse_source(status["source"]), spec
        )
    return False


def mounts_on(spec: LinkSpec) -> list[Status]:
    """Return the status of each mount of one vehicle that has a link, as far as other users' mounts show
    it.

    Raises:
        LinkClosed: one of them is of a version that reports too little; the text says what to do.
    """
    found = [status for status in _of_mounts(STATUS_PATIENCE) if has_link(status, spec)]
    for status in found:
        if status.get("problem"):
            require_usable(status, status["mountpoint"])
    return found


def is_wanted(status: Status, options: Options) -> bool:
    """Return whether a mount has the vehicle that the options ask for, and that vehicle still answers
    there."""
    vehicle, component = status["vehicle"], options.target_component
    autopilot = status["connection"]["autopilot"] != MAV_AUTOPILOT_INVALID
    return (
        options.target_system in (0, vehicle["system"])
        and (component == vehicle["component"] or (component == 0 and autopilot))
        and status["link"]["state"] != "replaced"
    )


def mountpoint_of(source: str) -> tuple[str, bytes] | None:
    """Return (mountpoint, subtree) if SOURCE is a vehicle's mountpoint or a path below one, otherwise None.

    The directory of a mount of all vehicles counts as a mountpoint.
    """
    place, _, subtree = source.partition("#")
    if not place or (":" in place and not place.startswith("/")):
        return None
    found = enclosing_mount(place)
    if found is None:
        several = canonical(place)
        if several_at(several) is None:
            return None
        found = several, ""
    mountpoint, below = found
    return mountpoint, normalise(os.fsencode(f"{below}/{subtree}"))
