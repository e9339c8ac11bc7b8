"""Logs the events of a vehicle, and measures the traffic on its link. Layer: client."""

from __future__ import annotations

import logging
from collections.abc import Callable

import trio

from mavftpfs.client.status import Facts, is_read_only
from mavftpfs.shared.readable import readable_time
from mavftpfs.shared.speed import Speed

log = logging.getLogger("mavftpfs.vehicle")

PERIOD = 0.25
"""Seconds between two looks at the connection: a heartbeat is valid until the next, about a second."""


class Watcher:
    """Watches a connection: logs each change that matters to a pilot, and measures the traffic.

    Attributes:
        traffic: bytes per second, both ways, over the last seconds; None while unknown.
    """

    def __init__(self, status: Callable[[], Facts], *, writing: bool) -> None:
        """`status`: Connection.status; `writing`: the mount allows changes."""
        self._status = status
        self._writing = writing
        self._seen: tuple[str, int, bool, bool] | None = None
        self._silent_since: float | None = None
        self._speed = Speed()
        self._moved = 0
        self.traffic: float | None = None

    async def run(self) -> None:
        """Look until cancelled."""
        while True:
            self.look(trio.current_time())
            await trio.sleep(PERIOD)

    def look(self, now: float) -> None:
        """Look once."""
        facts = self._status()
        vehicle, link = facts["vehicle"], facts["link"]
        moved = link["received_bytes"] + link["sent_bytes"]
        self._speed.on_bytes(moved - self._moved, now)
        self._moved = moved
        speed = self._speed.at(now)
        self.traffic = None if speed is None else round(speed, 1)
        before = self._seen
        self._seen = link["state"], vehicle["restarts"], bool(vehicle["armed"]), link["other_ftp_client"]
        if before is None:
            return
        state, restarts, armed, rival = before
        name = f"vehicle {vehicle['system']}/{vehicle['component']}"
        if state != link["state"]:
            self._log_state(name, state, link["state"], vehicle["heartbeat_age"] or 0.0, now)
        if restarts < vehicle["restarts"]:
            log.warning("%s restarted", name)
        if armed and not vehicle["armed"]:
            log.info("%s is disarmed", name)
        if vehicle["armed"] and not armed:
            waits = self._writing and is_read_only(vehicle)
            log.info("%s is armed%s", name, ": nothing is written to it until it is disarmed" * waits)
        if rival is not link["other_ftp_client"]:
            log.info("another FTP client of %s is heard%s", name, " no more" * rival)

    def _log_state(self, name: str, before: str, state: str, silence: float, now: float) -> None:
        if state == "lost":
            self._silent_since = now - silence
            log.warning("%s is lost: no heartbeat for %s", name, readable_time(silence))
        elif before == "lost" and state != "replaced":
            away = "" if self._silent_since is None else f" after {readable_time(now - self._silent_since)}"
            log.info("%s is back%s", name, away)
        elif before == "replaced":
            log.info("%s is the one again that was mounted", name)
