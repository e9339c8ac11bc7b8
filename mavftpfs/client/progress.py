"""The progress of transfers, as numbers. Layer: client.

Only safe bytes count: those that have arrived here, or that the vehicle acknowledged.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress

import trio

from mavftpfs.client.files import Session
from mavftpfs.client.status import Facts
from mavftpfs.link.base import plain_nursery
from mavftpfs.shared.errors import LinkError
from mavftpfs.shared.speed import Speed


class Progress:
    """Counts, and shows nothing by itself. All sizes in bytes. lost: the vehicle is lost. sending: the path
    on the vehicle of a file that is being uploaded, otherwise "". untouched: the path of the present file
    still has its old content on the vehicle."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._speed = Speed()
        self.files = self.files_done = 0
        self.total = self._ended = 0
        self.name = ""
        self.size = self.here = 0
        self.state = self.sending = ""
        self.lost = False
        self.untouched = True

    def plan(self, files: int, total: int) -> None:
        """Note the amount of work from now on; no files: unknown."""
        self.files, self.total = files, total
        self.files_done = self._ended = 0

    def begin(self, name: str, size: int, here: int = 0) -> None:
        """Begin a file, or begin it again; `here` bytes of it need not move."""
        self.name, self.size, self.here, self.state, self.sending = name, size, here, "", ""
        self.untouched = True

    def at(self, here: int) -> None:
        """Note the number of safe bytes of the file."""
        self._speed.on_bytes(max(0, here - self.here), self._clock())
        self.here = here
        self.size = max(self.size, here)

    def look(self, facts: Facts) -> None:
        """Take the facts of `status --json`."""
        self.lost = facts["link"]["state"] in ("lost", "replaced")
        for transfer in facts["transfers"]:
            if transfer["direction"] == "write" and transfer["path"] == self.sending:
                self.at(min(transfer["done"], self.size))
                if transfer["done"] >= self.size:
                    self.check()

    def check(self) -> None:
        """Note that all bytes moved, and that the vehicle computes the checksum."""
        self.state = "checking"

    def end(self, planned: int) -> None:
        """Note that the file is done, or failed; `planned`: its bytes in the plan."""
        self._ended += planned
        self.files_done += 1
        self.size = self.here = 0
        self.name = self.state = self.sending = ""

    @property
    def done(self) -> int:
        """Bytes of the plan that are done."""
        return min(self._ended + self.here, self.total)

    @property
    def rate(self) -> float | None:
        """Bytes per second that move, None while unknown."""
        return self._speed.at(self._clock())

    @property
    def time_left(self) -> float | None:
        """Seconds until all is done, None while unknown."""
        return (self.total - self.done) / self.rate if self.rate else None


WAIT_SHOWN = 2.0
"""Seconds of waiting after which a person learns the reason."""
_REASONS = {
    "client": "waiting: another FTP client may have a file open on the vehicle",
    "session": "waiting: the vehicle has to close a file that an earlier client left open, within 14 s",
}


@asynccontextmanager
async def waits_told(session: Session, tell: Callable[[str], None]) -> AsyncIterator[None]:
    """Print during the body, once for each reason, why requests wait."""

    async def watch() -> None:
        since: dict[str | None, float] = {}
        reasons = dict(_REASONS)
        while reasons:
            with suppress(LinkError):  # if the mount is gone, the body gets the error
                now, reason = trio.current_time(), (await session.status())["link"].get("waits_for")
                since = {reason: since.get(reason, now)}
                if reason in reasons and now - since[reason] >= WAIT_SHOWN:
                    tell(reasons.pop(reason))
            await trio.sleep(LOOK_PERIOD)

    async with plain_nursery() as nursery:
        nursery.start_soon(watch)
        yield


LOOK_PERIOD = 0.25
"""Seconds between two looks at the vehicle and the upload."""


@asynccontextmanager
async def followed(session: Session, progress: Progress) -> AsyncIterator[None]:
    """Report to progress during the body whether the vehicle is lost, and what it acknowledged of an
    upload."""

    async def watch() -> None:
        while True:
            with suppress(LinkError):  # if the mount is gone, the body gets the error
                progress.look(await session.status())
            await trio.sleep(LOOK_PERIOD)

    async with plain_nursery() as nursery:
        nursery.start_soon(watch)
        yield
