"""bwlimit=: about so much of a link that could carry more, on virtual time."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import pytest
import trio

from mavftpfs.link.fastframe import FTP_MESSAGE_ID
from mavftpfs.protocol.flow import DEPTH
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.rigs import Rig
from tests.support.transfers import content, put, read_file

PROFILES = ["px4", "px4-nuttx", "ardupilot", "mavsdk"]
LIMIT = 20_000
FRAME = 266
WIDE = LinkSettings(rate=100_000.0, delay=0.03)
DATA = content(150_000, 4)


class Meter:
    """Sees all frames: what we sent, and replies of FTP. Times in seconds, sizes in bytes."""

    def __init__(self, connection: Connection) -> None:
        self.frames: list[tuple[float, int]] = []
        self._own = connection.options.source_system
        connection.driver.framer.on_frame = self._on_frame

    def _on_frame(self, frame: bytes) -> None:
        if frame[5] == self._own or int.from_bytes(frame[7:10], "little") == FTP_MESSAGE_ID:
            self.frames.append((trio.current_time(), len(frame)))

    def most_within(self, seconds: float) -> int:
        """Return the most bytes that any stretch of so many seconds had."""
        most = first = total = 0
        for at, size in self.frames:
            total += size
            while self.frames[first][0] <= at - seconds:
                total -= self.frames[first][1]
                first += 1
            most = max(most, total)
        return most

    @property
    def rate(self) -> float:
        """Return the average over all, in bytes per second."""
        return sum(size for _, size in self.frames) / (self.frames[-1][0] - self.frames[0][0])


async def read(connection: Connection, here: Rig) -> None:
    assert await read_file(connection, here.root + b"/d/f") == DATA


async def write(connection: Connection, here: Rig) -> None:
    await put(connection, here.root + b"/d/g", DATA)
    assert here.data(b"/d/g") == DATA


def check(meter: Meter, limit: float = LIMIT, *, late: float = 0.0) -> None:
    """Hold the limit over any two seconds, by a tenth, and use it; late: seconds by which a server may hold
    replies back, so that they come at once."""
    assert meter.most_within(2.0) <= (2.0 * 1.1 + late) * limit + DEPTH * FRAME
    assert meter.rate >= 0.9 * limit


@pytest.mark.holds("fault overflow")
@pytest.mark.parametrize("transfer", [read, write])
@pytest.mark.parametrize("profile", PROFILES)
async def test_bulk_keeps_the_limit_and_uses_it(
    profile: str, transfer: Callable[[Connection, Rig], Awaitable[None]]
) -> None:
    """Whatever read_mode says: the pace of bursts is the server's."""
    here = Rig(profile, {b"/d/f": DATA}, WIDE)
    limit = LIMIT // 2 if profile == "ardupilot" else LIMIT  # its short queue allows no more
    async with here.connected(ConnectOptions(bwlimit=limit, read_mode="burst")) as connection:
        meter = Meter(connection)
        await transfer(connection, here)
        assert not here.count(Opcode.BURST_READ_FILE)
        check(meter, limit, late=here.server.profile.stall_chance and 0.3)


async def test_listings_in_a_loop_keep_the_limit() -> None:
    here = Rig("px4", {b"/d/%d" % number: b"" for number in range(60)}, WIDE)
    async with here.connected(ConnectOptions(bwlimit=LIMIT // 10)) as connection:
        meter = Meter(connection)
        with trio.move_on_after(20.0):
            while True:
                await connection.store.list_directory(b"/d")
        assert meter.most_within(2.0) <= 2.0 * 1.1 * LIMIT // 10 + DEPTH * FRAME


async def test_short_chunks_use_the_limit_too() -> None:
    here = Rig("px4", {b"/d/f": DATA}, WIDE)
    async with here.connected(ConnectOptions(bwlimit=LIMIT, chunk=64)) as connection:
        meter = Meter(connection)
        await read(connection, here)
        check(meter)


async def test_a_listing_goes_ahead_of_a_copy() -> None:
    here = Rig("px4", {b"/d/f": DATA}, WIDE)
    async with here.connected(ConnectOptions(bwlimit=LIMIT)) as connection:
        meter = Meter(connection)
        async with trio.open_nursery() as nursery:
            nursery.start_soon(read, connection, here)
            await trio.sleep(2.0)
            for _ in range(3):
                began = trio.current_time()
                await connection.store.list_directory(b"/d")
                assert trio.current_time() - began < 0.5
                await trio.sleep(1.0)
        assert meter.most_within(2.0) <= 2.0 * 1.1 * LIMIT + 2 * DEPTH * FRAME


async def test_the_slowest_limit_is_slow_and_no_time_out() -> None:
    here = Rig("px4", {b"/f": DATA[:5000]}, WIDE)
    async with here.connected(ConnectOptions(bwlimit=100)) as connection:
        began = trio.current_time()
        assert await read_file(connection, b"/f") == DATA[:5000]
        assert 50.0 < trio.current_time() - began < 100.0
        assert here.count(Opcode.OPEN_FILE_RO) == 1  # waiting for the limit is no silence
        assert connection.engine.stats.lost == 0
