"""What a mount tells of its vehicle, link and transfers: a status, and log lines for changes. Layer: top.

All of it is built from two plain dictionaries, `Connection.status()` and `Tree.status()`: nothing else here
knows the layers below. The keys of `snapshot` are those of `status --json`; docs/guide.md describes them.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping
from itertools import islice
from typing import Any

import trio

from mavftpfs.shared.readable import autopilot_name, readable_time

log = logging.getLogger("mavftpfs.vehicle")

Facts = Mapping[str, Any]

PERIOD = 1.0
"""Seconds between two looks at the connection."""
RATE_SPAN = 5
"""Looks over which the traffic on the link is averaged."""
SILENCE = 5.0
"""Seconds without heartbeats after which the vehicle counts as lost for people."""
MOST = 100
"""Entries of each list: an extended attribute holds 64 KiB. `held` counts them all."""
_TOLD = {"transfers", "errors", "reads"}
"""What the cache tells that stands in the snapshot's own lists."""
LOSSY = 0.1
"""From this share of lost packets on, the link is not called fine."""


def snapshot(connection: Facts, cache: Facts, traffic: float | None, *, when_armed: str) -> dict[str, Any]:
    """Return the facts of a status, JSON-able; bytes, seconds, and bytes per second; None = unknown."""
    return {
        "vehicle": _vehicle(connection, when_armed),
        "link": _link(connection, traffic),
        "transfers": _transfers(
            cache,
            moving=link_state(connection) in ("fine", "lossy"),
            writing=not connection.get("armed") or when_armed == "ok",
        ),
        "held": {
            "files": cache.get("files_undelivered", 0),
            "bytes": cache.get("bytes_held", 0),
            "bytes_on_disk": cache.get("bytes_held_on_disk", 0),
            "errors": dict(islice(cache.get("errors", {}).items(), MOST)),
        },
        "connection": connection,
        "cache": {key: value for key, value in cache.items() if key not in _TOLD},
    }


def _vehicle(connection: Facts, when_armed: str) -> dict[str, Any]:
    system, component = connection.get("vehicle") or (None, None)
    autopilot = connection.get("autopilot")
    return {
        "system": system,
        "component": component,
        "autopilot": None if autopilot is None else autopilot_name(autopilot),
        "armed": connection.get("armed"),
        "when_armed": when_armed,
        "heartbeat_age": connection.get("heartbeat_age"),
        "says_ftp": connection.get("ftp_flag"),
        "restarts": connection.get("reboots", 0),
    }


def _link(connection: Facts, traffic: float | None) -> dict[str, Any]:
    speed, counters = connection.get("speed", {}), connection.get("link", {})
    return {
        "source": connection.get("source"),
        "address": connection.get("address"),
        "state": link_state(connection),
        "rtt": connection.get("rtt"),
        "loss": speed.get("loss"),
        "rate": traffic,
        "other_ftp_client": bool(connection.get("other_ftp_client")),
        "received_bytes": counters.get("received_bytes", 0),
        "sent_bytes": counters.get("sent_bytes", 0),
        "requests": connection.get("requests", 0),
        "retransmissions": connection.get("retransmissions", 0),
        "reopened": counters.get("reopened", 0),
    }


def link_state(connection: Facts) -> str:
    """Return `fine`, `lossy`, `lost`, or `replaced` where another vehicle answers in place of ours."""
    if connection.get("another_vehicle"):
        return "replaced"
    age = connection.get("heartbeat_age")
    if connection.get("lost") or (age is not None and age > SILENCE):
        return "lost"
    loss = connection.get("speed", {}).get("loss") or 0.0
    return "lossy" if loss >= LOSSY else "fine"


def _transfers(cache: Facts, *, moving: bool, writing: bool) -> list[dict[str, Any]]:
    """Return what is being read or written, what is sent before what waits.

    moving: the vehicle is there; writing: and it may be written to.
    """
    found = []
    for read in cache.get("reads", []):
        left, rate = read["size"] - read["done"], cache.get("rate") if moving else None
        eta = round(left / rate, 1) if rate else None
        found.append({"direction": "read", "state": "reading", **read, "rate": rate, "eta": eta})
    for write in cache.get("transfers", []):
        sending = write["sending"] and moving and writing
        found.append(
            {
                "direction": "write",
                "state": "sending" if sending else "waiting",
                "path": write["path"],
                "size": write["size"],
                "done": max(0, write["size"] - write["bytes_left"]),
                "rate": cache.get("write_rate") if sending else None,
                "eta": write["eta"] if moving and writing else None,
                "error": cache.get("errors", {}).get(write["path"]),
            }
        )
    return found[:MOST]


class Watcher:
    """Looks at a connection each second: logs each change that a pilot cares for, measures the traffic."""

    def __init__(self, status: Callable[[], Facts], *, read_only_when_armed: bool) -> None:
        """`status`: Connection.status."""
        self._status = status
        self._read_only_when_armed = read_only_when_armed
        self._seen: dict[str, Any] = {}
        self._silent_since: float | None = None
        self._bytes: deque[tuple[float, int]] = deque(maxlen=RATE_SPAN + 1)

    @property
    def traffic(self) -> float | None:
        """Bytes per second, both ways, over the last few seconds; None while too little was seen."""
        if len(self._bytes) < 2:
            return None
        (began, first), (ended, last) = self._bytes[0], self._bytes[-1]
        return round((last - first) / (ended - began), 1) if ended > began else None

    async def run(self) -> None:
        """Look until cancelled."""
        while True:
            self.look(trio.current_time())
            await trio.sleep(PERIOD)

    def look(self, now: float) -> None:
        """Look once."""
        facts = self._status()
        counters = facts.get("link", {})
        self._bytes.append((now, counters.get("received_bytes", 0) + counters.get("sent_bytes", 0)))
        seen = {
            "lost": link_state(facts) == "lost",
            "replaced": link_state(facts) == "replaced",
            "restarts": facts.get("reboots", 0),
            "armed": bool(facts.get("armed")),
            "other_client": bool(facts.get("other_ftp_client")),
        }
        before, self._seen = self._seen, seen
        if before:
            self._log_changes(before, facts, now)

    def _log_changes(self, before: Facts, facts: Facts, now: float) -> None:
        seen = self._seen
        system, component = facts.get("vehicle") or ("?", "?")
        name = f"vehicle {system}/{component}"
        if seen["lost"] and not before["lost"]:
            age = facts.get("heartbeat_age") or 0.0
            self._silent_since = now - age
            log.warning("%s is lost: no heartbeat for %s", name, readable_time(age))
        if before["lost"] and not seen["lost"] and not seen["replaced"]:
            away = "" if self._silent_since is None else f" after {readable_time(now - self._silent_since)}"
            log.info("%s is back%s", name, away)
        if before["replaced"] and not seen["replaced"] and not seen["lost"]:
            log.info("%s is the one again that was mounted", name)
        if seen["restarts"] > before["restarts"]:
            log.warning("%s restarted", name)
        if seen["armed"] is not before["armed"]:
            log.info("%s is %s", name, self._armed_words(seen["armed"]))
        if seen["other_client"] is not before["other_client"]:
            words = "is heard" if seen["other_client"] else "is heard no more"
            log.info("another FTP client of %s %s", name, words)

    def _armed_words(self, armed: bool) -> str:
        if not armed:
            return "disarmed"
        return (
            "armed: nothing is written to it until it is disarmed" if self._read_only_when_armed else "armed"
        )
