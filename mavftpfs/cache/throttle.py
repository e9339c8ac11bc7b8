"""Keeps programs from writing more than the link carries. Layer: cache.

A program in close() cannot be killed, so the bytes that a close may wait for are limited: to those of about
ten seconds at the measured rate, shared by the uploads under way. A change of a part is refused (EFBIG) if it
would take longer than two minutes, because the whole file is fetched and sent again.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection

import trio

from mavftpfs.cache.blocks import RateMeter
from mavftpfs.cache.file import File, Replaces
from mavftpfs.cache.options import KIB, MIB
from mavftpfs.cache.together import together
from mavftpfs.shared.errors import FileTooLarge

SECONDS = 10.0
"""Seconds: what the measured rate carries in that time may be un-ACKed, within LEAST and MOST bytes."""

LEAST, MOST = 64 * KIB, 8 * MIB
UNMEASURED = 256 * KIB
"""Bytes that may be un-ACKed before a rate is measured."""

REWRITE_SECONDS = 120.0
"""How long it may take to fetch and send a file of which a part was changed."""

LEAST_REWRITE, MOST_REWRITE = 64 * KIB, 64 * MIB
"""Bytes of such a file that are always allowed, and the most that ever are."""

STALL = 5.0
"""After so many seconds in which nothing was ACKed a writer asks why."""


class Throttle:
    """Makes writers wait while too many bytes are not ACKed.

    Attributes:
        waiting: the writers that wait for room. Any event that may give room unparks all of them.
        meter: how fast bytes are ACKed.
    """

    def __init__(
        self,
        files: Collection[File],
        reads: RateMeter,
        link_rate: float | None,
        clock: Callable[[], float],
    ) -> None:
        """files: all that may be sent. reads: how fast bytes are read. link_rate: bytes per second that the
        link carries at most, where that is known."""
        self.waiting = trio.lowlevel.ParkingLot()
        self.meter = RateMeter()
        self._files = files
        self._reads = reads
        self._link_rate = link_rate
        self._clock = clock

    @property
    def limit(self) -> int:
        """The most bytes without an ACK over all uploads."""
        rate = self.meter.rate
        return UNMEASURED if rate is None else min(max(int(rate * SECONDS), LEAST), MOST)

    def require_sendable(self, file: File, size: int) -> None:
        """Check that a file of `size` bytes, of which the vehicle has a part, can be sent again.

        Raises:
            FileTooLarge.
        """
        limit = self._rewritable(file)
        if file.replaces is Replaces.BASE and size > limit:
            raise FileTooLarge(
                f"a change of a part sends the whole file: {size} bytes, and two minutes of the link carry "
                f"{limit}; write a new file instead"
            )

    def _rewritable(self, file: File) -> int:
        """Return how large a file may be of which a part is changed, as far as the rates are known."""
        read = self._reads.rate
        write = self.meter.rate or read or self._link_rate
        read = read or write
        if not write or not read:
            return MOST_REWRITE
        missing = sum([stop - start for start, stop in file.content.missing(0, file.size)])
        possible = int((REWRITE_SECONDS - missing / read) * write)
        return min(max(possible, LEAST_REWRITE), MOST_REWRITE)

    def is_full(self, file: File) -> bool:
        """Return whether the writers of a file have to wait."""
        if not file.has_name or file.unacked <= LEAST:
            return False  # a file without a name is not delivered
        if file.start_after == float("inf") or file.replaces is Replaces.BASE:
            return False  # nothing of it moves before it is closed: it waits on the local disk
        streams = sum(other.attempt is not None for other in self._files)
        return file.unacked > self.limit // max(streams, 1)

    async def wait(self) -> bool:
        """Wait for anything to move; return False if nothing did for STALL seconds."""
        with trio.move_on_after(STALL):
            await self.waiting.park()
            return True
        return False

    async def while_full(self, file: File, deliver: Callable[[], Awaitable[None]]) -> None:
        """Run a delivery only for its error, and cancel it once bytes move again: the program is still
        writing, so a completed delivery would commit half a file.

        Raises:
            The error of the delivery.
        """
        delivery, watch = trio.CancelScope(), trio.CancelScope()

        async def try_it() -> None:
            try:
                with delivery:
                    await deliver()
            finally:
                watch.cancel()

        async def look() -> None:
            with watch:
                while self.is_full(file):
                    await self.waiting.park()
                delivery.cancel()

        await together(try_it, look)

    def on_acked(self, file: File, count: int) -> None:
        """Note that bytes of a file were ACKed: writers that wait look again."""
        self.meter.on_bytes(count, self._clock(), file)
        self.waiting.unpark_all()

    @property
    def speed(self) -> float | None:
        """Bytes per second that are ACKed, as people are told; None while it is not known."""
        return self.meter.shown.at(self._clock())

    def transfers(self) -> list[dict[str, object]]:
        """Return the files that are not delivered, those being sent first; eta: seconds at the measured
        rate."""
        waiting = [file for file in self._files if file.undelivered]
        rate, before, found = self.speed, 0, []
        for file in sorted(waiting, key=lambda file: file.attempt is None):
            before += file.unacked
            found.append(
                {
                    "path": file.path.decode(errors="replace"),
                    "size": file.size,
                    "bytes_left": file.unacked,
                    "sending": file.attempt is not None,
                    "eta": round(before / rate, 1) if rate else None,
                }
            )
        return found
