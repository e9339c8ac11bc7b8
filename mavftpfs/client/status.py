"""What mounts tell of themselves, and how they are asked for it. Layer: client.

A mount builds its status from two plain dictionaries, `Connection.status()` and `Tree.status()`; the keys
are those of `status --json`, which docs/json.md describes. It is asked over its control socket. If that
cannot be reached (it is another user's), the extended attribute of the mount's root says the same to users
that may read the mount; root may ask all mounts. Of a mount that cannot be asked only `mountpoint`, `source`,
`state` and `problem` are known.
"""

from __future__ import annotations

import errno
import json
import os
import re
import threading
from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

from mavftpfs import __version__
from mavftpfs.client import control
from mavftpfs.client.control import ControlError, NobodyThere
from mavftpfs.client.mountpoint import OUR_TYPE, XATTR_STATUS, Mounted, mounts, vehicles_below
from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID
from mavftpfs.link.samelink import same_link
from mavftpfs.link.uri import LinkSpec, parse_source
from mavftpfs.shared.errors import LinkClosed, MavftpfsError, NotFound, UsageError
from mavftpfs.shared.options import Options

BESIDE = ".put-"
"""Begins the name that a file which `put` sends has in a mount until it is whole."""
_BESIDE = re.compile(re.escape(BESIDE) + "[0-9a-f]{8}-([^/]+)")

Facts = Mapping[str, Any]

MOST = 100
"""Entries of each list: an extended attribute holds 64 KiB. `held` counts them all."""
_TOLD = {"transfers", "errors", "broken", "reads"}
"""Keys of the cache's status that are in the snapshot's own lists."""


def snapshot(connection: Facts, cache: Facts, traffic: float | None) -> dict[str, Any]:
    """Return the facts of a status, JSON-able; bytes, seconds, and bytes per second; None = unknown."""
    vehicle, link = connection["vehicle"], connection["link"]
    moving = link["state"] in ("fine", "lossy")
    return {
        **connection,
        "link": {**link, "rate": traffic},
        "transfers": _transfers(cache, moving=moving, writing=moving and not is_read_only(vehicle)),
        "held": {
            "files": cache.get("files_undelivered", 0),
            "bytes": cache.get("bytes_undelivered", 0),
            "bytes_on_disk": cache.get("bytes_held", 0),
            "errors": dict(islice(cache.get("errors", {}).items(), MOST)),
            "broken": dict(islice(cache.get("broken", {}).items(), MOST)),
        },
        "cache": {key: value for key, value in cache.items() if key not in _TOLD},
    }


def final_name(path: str) -> str:
    """Return the path that a file will have when it is whole."""
    parent, _, name = path.rpartition("/")
    match = _BESIDE.fullmatch(name)
    return path if match is None else f"{parent}/{match[1]}"


def is_read_only(vehicle: Facts) -> bool:
    """Return whether nothing is written to a vehicle, because it is armed."""
    return bool(vehicle["armed"]) and vehicle["when_armed"] == "ro"


def _transfers(cache: Facts, *, moving: bool, writing: bool) -> list[dict[str, Any]]:
    """Return the files that are being read or written; those being sent come before those that wait.

    moving: the vehicle is there; writing: it may also be written to.
    """
    found = []
    for read in cache.get("reads", []):
        left, rate = read["size"] - read["done"], cache.get("rate") if moving else None
        eta = round(left / rate, 1) if rate else None
        found.append({"direction": "read", "state": "reading", **read, "rate": rate, "eta": eta})
    for write in cache.get("transfers", []):
        sending = write["sending"] and writing
        found.append(
            {
                "direction": "write",
                "state": "sending" if sending else "waiting",
                "path": final_name(write["path"]),
                "size": write["size"],
                "done": max(0, write["size"] - write["bytes_left"]),
                "rate": cache.get("write_rate") if sending else None,
                "eta": write["eta"] if writing else None,
                "error": cache.get("errors", {}).get(write["path"]),
            }
        )
    return found[:MOST]


Status = Mapping[str, Any]

PATIENCE = 10.0
"""Seconds for a mount to answer: it does so without asking the vehicle."""
_OF_ONE_VEHICLE = frozenset(("vehicle", "link", "transfers", "held", "connection", "cache"))
"""Keys that the status of a mount of one vehicle has."""


# -- asking mounts ----------------------------------------------------------------------------------


def all_statuses() -> list[Status]:
    """Return the status of each mount that this user may ask, the dead ones too, by mountpoint."""
    found: dict[str, Status] = {}
    for path, mount in mounts().items():
        status = _status_of(path, mount) if mount.type == OUR_TYPE else None
        if status is not None:
            found[path] = status
    known = {control.socket_name(path) for path in found}
    for socket in control.all_sockets(control.own_directories()):
        if socket.name not in known:
            # The kernel does not show it any more, but it still delivers; or it is in another mount
            # namespace.
            status = _ask_or_remove(socket)
            if status is not None:
                found.setdefault(status["mountpoint"], status)
    return [found[path] for path in sorted(found)]


def status_of(mountpoint: str) -> Status:
    """Return the status of one mount; if it cannot be asked `state` (dead, mute) and `problem` in words.

    Raises:
        NobodyThere: no vehicle is mounted there, or this user may not ask.
    """
    mount = mounts().get(mountpoint)
    if mount is not None and mount.type == OUR_TYPE:
        status = _status_of(mountpoint, mount)
        if status is not None:
            return status
    try:
        return _ask(control.find_socket(mountpoint, control.own_directories()))
    except NobodyThere:  # it may have left its socket
        raise NobodyThere(f"no vehicle of yours is mounted on {mountpoint}") from None


def told_by(mountpoint: str, patience: float) -> Status:
    """Return a mount's status from the attribute of its root, within so many seconds; as status_of.

    The control socket is found by the mountpoint's name, which may be another mount in another mount
    namespace.

    Raises:
        NobodyThere: nothing is mounted there, or this user may not ask.
    """
    mount = mounts().get(mountpoint)
    status = several_at(mountpoint) if mount is None else _by_attribute(mountpoint, mount, patience)
    if status is None:
        raise NobodyThere(f"no vehicle of yours is mounted on {mountpoint}")
    return status


def several_at(place: str) -> Status | None:
    """Return the status of the mount of all vehicles below a directory; None if there is none."""
    try:
        status = _ask(control.find_socket(place, control.own_directories()))
    except ControlError:
        return None
    return status if "members" in status else None


def several_above(path: str) -> str | None:
    """Return the directory at or above a path below which all vehicles are mounted; None if there is none."""
    while path != "/":
        if several_at(path) is not None:
            return path
        path = os.path.dirname(path)
    return None


def second_vehicle(status: Status) -> str:
    """Return the words about a second vehicle with the same system id."""
    system, address = status["vehicle"]["system"], status["link"]["second"]
    return said_of_double(system, address)


def said_of_double(system: int, address: str) -> str:
    """Return the words about an address that uses another vehicle's system id."""
    return (
        f"a second vehicle has the system id {system}, or a router sends frames back: ignored at {address}; "
        "give each vehicle its own id"
    )


def vehicle_below(status: Mapping[str, Any], subtree: bytes, options: Options) -> str:
    """Return the mountpoint of the vehicle that the options ask for, below a mount of several vehicles.

    Raises:
        UsageError: the options do not say which one. NotFound: `subtree` names one that is not there.
        LinkClosed: it is not mounted now.
    """
    place, names = status["mountpoint"], {member["name"]: member for member in status["members"]}
    first = os.fsdecode(subtree.strip(b"/").partition(b"/")[0])
    wanted = str(options.target_system)
    if first.isdigit():
        raise NotFound(f"no vehicle is mounted on {place}/{first}")
    if not options.target_system and len(names) == 1:
        (wanted,) = names
    elif not options.target_system:
        shown = ", ".join(names) or "none yet"
        raise UsageError(f"{place} is for several vehicles ({shown}); name one, as {place}/1")
    if wanted not in names:
        raise LinkClosed(f"no vehicle {wanted} is mounted below {place}")
    if names[wanted]["state"] != "mounted":
        why = names[wanted]["problem"] or names[wanted]["state"]
        raise LinkClosed(f"vehicle {wanted} is not mounted below {place}: {why}")
    return os.path.join(place, wanted)


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
        problem = f"DEAD: no more vehicles are mounted; run: mavftpfs umount {place}"
        return [{**_unasked(place, vehicles[0]["source"], "dead", problem), "vehicles": vehicles}, *vehicles]


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


def find_socket(mountpoint: str) -> Path:
    """Return the control socket of a mount; root finds other users', too.

    Raises:
        NobodyThere: there is none.
    """
    mount = mounts().get(mountpoint)
    directories = control.own_directories()
    if mount is not None and mount.uid not in (None, os.getuid()):
        directories += control.directories_of(mount.uid)
    return control.find_socket(mountpoint, directories)


def _status_of(path: str, mount: Mounted) -> Status | None:
    """Return what a mount says; None if this user may not ask."""
    try:
        return _ask(find_socket(path))
    except NobodyThere:
        return _by_attribute(path, mount, PATIENCE)
    except ControlError as exc:
        return _unasked(path, mount.source, "mute", f"its program does not answer: {exc}")


def _by_attribute(path: str, mount: Mounted, patience: float) -> Status | None:
    """Return what a mount says by the attribute of its root; None if this user may not ask."""
    answer = _questions.ask(path, mount, patience)
    if isinstance(answer, bytes):
        return _understood(json.loads(answer), path)
    if answer == errno.ENOTCONN:
        return _unasked(path, mount.source, "dead", f"DEAD: its program is gone; run: mavftpfs umount {path}")
    if answer in (errno.EACCES, errno.EPERM):
        return None
    return _unasked(path, mount.source, "mute", f"its program does not answer: {os.strerror(answer)}")


def _understood(status: Status, path: str) -> Status:
    """Return a status that has all keys on which others rely; a mount of another version may not tell
    them."""
    if "members" in status or status.keys() >= _OF_ONE_VEHICLE:
        return status
    theirs = status.get("version", "unknown")
    problem = f"its program is of version {theirs}, this one of {__version__}: unmount it, and mount it again"
    return _unasked(path, status.get("source", ""), "mute", problem)


def _unasked(path: str, source: str, state: str, problem: str) -> Status:
    return {"mountpoint": path, "source": source, "state": state, "problem": problem}


class _Questions:
    """Reads the attribute of mounts, each in a thread, because a mount that was stopped never answers. It
    keeps one thread, however often it is asked."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: dict[str, Future[bytes | int]] = {}

    def ask(self, path: str, mount: Mounted, patience: float) -> bytes | int:
        """Return the attribute, or the errno; ETIMEDOUT after so many seconds."""
        with self._lock:
            answer = self._open.get(mount.number)
            if answer is None:
                answer = Future()
                threading.Thread(target=self._read, args=(path, mount, answer), daemon=True).start()
                self._open[mount.number] = answer
        try:
            return answer.result(patience)
        except TimeoutError:
            return errno.ETIMEDOUT

    def _read(self, path: str, mount: Mounted, answer: Future[bytes | int]) -> None:
        found: bytes | int
        try:
            found = os.getxattr(path, XATTR_STATUS)
        except OSError as exc:
            found = exc.errno or errno.EIO
        with self._lock:
            del self._open[mount.number]
        answer.set_result(found)


_questions = _Questions()


def _ask(socket: Path) -> Status:
    """Return what a mount says at its control socket."""
    status: Status = control.ask(socket, {"command": "status"}, timeout=PATIENCE)["status"]
    return _understood(status, status["mountpoint"])


def _ask_or_remove(socket: Path) -> Status | None:
    try:
        return _ask(socket)
    except NobodyThere:
        socket.unlink(missing_ok=True)
    except ControlError:
        pass  # only the mount itself could say which one it is
    return None


# -- which mount has a link -------------------------------------------------------------------------


def network_namespace() -> str:
    """Return what tells this process's network namespace from others that exist now."""
    facts = os.stat("/proc/self/ns/net")
    return f"{facts.st_dev}:{facts.st_ino}"


def has_link(status: Status, spec: LinkSpec) -> bool:
    """Return whether the mount with this status has that link. A port belongs to a network namespace."""
    with suppress(MavftpfsError, KeyError):  # it cannot be asked, or is of an older version
        return status["network_namespace"] == network_namespace() and same_link(
            parse_source(status["source"]), spec
        )
    return False


def holder_of(spec: LinkSpec) -> Status | None:
    """Return the status of the mount that has a link, also of another user's; None if there is none."""
    return next((status for status in all_statuses() if has_link(status, spec)), None)


def also_mounted(spec: LinkSpec, vehicle: Facts) -> str:
    """Return a line about the mounts of a vehicle on a link, or "". vehicle: the facts of its status."""

    def is_same(status: Status) -> bool:
        same = all(status["vehicle"][key] == vehicle[key] for key in ("system", "component"))
        return same and has_link(status, spec)

    known = [status for status in all_statuses() if not status.get("problem") and "vehicle" in status]
    places = [status["mountpoint"] for status in known if is_same(status)]
    if not places:
        return ""
    return (
        f"this vehicle is mounted on {' and '.join(places)}, too; a change through one mount may show in the "
        f"other one 20 s later; to have only one, run: mavftpfs umount {places[0]}"
    )


def is_wanted(status: Mapping[str, Any], options: Options) -> bool:
    """Return whether a mount is of the vehicle that the options ask for, and that vehicle still answers
    there."""
    vehicle, component = status["vehicle"], options.target_component
    autopilot = status["connection"]["autopilot"] != MAV_AUTOPILOT_INVALID
    return (
        options.target_system in (0, vehicle["system"])
        and (component == vehicle["component"] or (component == 0 and autopilot))
        and status["link"]["state"] != "replaced"
    )
