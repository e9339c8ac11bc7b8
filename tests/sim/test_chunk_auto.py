"""Which chunk size a connection finds by itself over links that treat long frames worse, on virtual time."""

from __future__ import annotations

import random
from dataclasses import replace
from statistics import mean

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.chunks import Chunks
from mavftpfs.protocol.operations import OpenFile
from mavftpfs.protocol.payload import MAX_DATA, Opcode
from mavftpfs.protocol.transfers import ReadTransfer
from mavftpfs.protocol.writing import WriteTransfer
from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.sim.linkmodel import LinkSettings
from tests.sim.test_engine_profiles import Rig
from tests.support.sources import MemorySource
from tests.support.uploads import probe, put
from tests.support.virtual import MemorySink
from tests.support.worlds import content, path, read_file, world

RADIO = LinkSettings(rate=5760.0, delay=0.05, queue=8192)
PROFILES = ["px4", "ardupilot", "mavsdk", "px4-nuttx"]
OVERHEAD = 27
LIMITS = [260, 150, 75]


def sizes(connection: Connection) -> tuple[int, int]:
    """Return the chunk sizes of reads and of writes."""
    steering = connection.steering
    assert steering.chunks is not None
    assert steering.write_chunks is not None
    return steering.chunks.size, steering.write_chunks.size


@pytest.mark.parametrize("limit", LIMITS)
@pytest.mark.parametrize("profile", PROFILES)
async def test_a_file_is_read_where_no_full_frame_passes(
    profile: str, limit: int, autojump: MockClock
) -> None:
    data = content(100_000)
    here = world(profile, replace(RADIO, mtu=limit), file=data)
    async with here.connection() as connection:
        assert await read_file(connection, path(profile, "file")) == data
        assert limit - OVERHEAD - 16 < sizes(connection)[0] <= limit - OVERHEAD
        assert sizes(connection)[1] == MAX_DATA


@pytest.mark.parametrize("probed", [False, True], ids=["unknown", "probed"])
@pytest.mark.parametrize("limit", LIMITS)
@pytest.mark.parametrize("profile", PROFILES)
async def test_a_file_is_written_where_no_full_frame_passes(
    profile: str, limit: int, probed: bool, autojump: MockClock
) -> None:
    data = content(100_000)
    here = world(profile, RADIO)
    async with here.connection() as connection:
        if probed:
            await probe(connection, profile)
        here.model.settings = replace(RADIO, mtu=limit)
        await put(connection, path(profile, "new"), data)
        assert here.tree.data(path(profile, "new")) == data
        assert limit - OVERHEAD - 16 < sizes(connection)[1] <= limit - OVERHEAD
    assert here.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("profile", PROFILES)
async def test_it_is_soon_found_where_many_requests_were_lost_at_once(
    profile: str, autojump: MockClock
) -> None:
    """After a read the window is wide: what is lost of it waits for long to be repeated."""
    data = content(100_000)
    here = world(profile, replace(RADIO, rate=57_600.0, delay=0.02, mtu=150), file=data)
    async with here.connection() as connection:
        assert await read_file(connection, path(profile, "file")) == data
        began = trio.current_time()
        await put(connection, path(profile, "new"), data)
        assert trio.current_time() - began < 20.0
    assert here.tree.data(path(profile, "new")) == data


async def test_a_file_of_one_chunk_passes_too(autojump: MockClock) -> None:
    here = world("px4", replace(RADIO, mtu=150), small=content(200))
    async with here.connection() as connection:
        assert await read_file(connection, path("px4", "small")) == content(200)
        await put(connection, path("px4", "new"), content(200))
    assert here.tree.data(path("px4", "new")) == content(200)


@pytest.mark.parametrize("profile", ["px4", "ardupilot", "mavsdk"])
async def test_a_link_that_recovers_gets_full_chunks_back(profile: str, autojump: MockClock) -> None:
    data = content(600_000)
    here = world(profile, replace(RADIO, mtu=150), file=data)
    async with here.connection() as connection:
        async with trio.open_nursery() as nursery:

            async def recover() -> None:
                await trio.sleep(20.0)
                assert sizes(connection)[0] < 124
                here.model.settings = RADIO

            nursery.start_soon(recover)
            assert await read_file(connection, path(profile, "file")) == data
        assert sizes(connection)[0] == MAX_DATA
        requests = connection.engine.stats.requests
        assert await read_file(connection, path(profile, "file")) == data
        assert connection.engine.stats.requests - requests < 1.02 * (600_000 / MAX_DATA)


@pytest.mark.parametrize("profile", ["px4", "px4-nuttx"])
async def test_fades_do_not_hide_that_long_frames_suffer(profile: str, autojump: MockClock) -> None:
    """Each is a pause, as a card makes them, but explains no more than was lost in it."""
    fades = tuple((8.0 * n + 2.0, 8.0 * n + 2.4) for n in range(400))
    data = content(1_000_000)
    here = world(profile, replace(RADIO, rate=57_600.0, piece_loss=0.13, cuts=fades), file=data)
    async with here.connection() as connection:
        assert await read_file(connection, path(profile, "file")) == data
        assert sizes(connection)[0] < 200


async def take_both_ways(profile: str, settings: LinkSettings, options: ConnectOptions) -> object:
    """Read and write a file; return what that cost."""
    data = content(300_000)
    here = world(profile, settings, file=data)
    async with here.connection(options) as connection:
        assert await read_file(connection, path(profile, "file")) == data
        await put(connection, path(profile, "new"), data)
        return trio.current_time(), dict(connection.engine.stats.by_opcode)


@pytest.mark.parametrize("loss", [0.1, 0.2])
@pytest.mark.parametrize("profile", ["px4", "ardupilot", "mavsdk"])
def test_losses_of_a_fifth_change_nothing(profile: str, loss: float) -> None:
    """The same requests go out as with chunk=239, and it takes as long."""
    settings = replace(RADIO, loss=loss)
    costs = [
        trio.run(take_both_ways, profile, settings, options, clock=MockClock(autojump_threshold=0))
        for options in (ConnectOptions(), ConnectOptions(chunk=MAX_DATA))
    ]
    assert costs[0] == costs[1]


SETTLED, SIZE = 200_000, 500_000
FIXED = (180, 150, 110, 101, 90, 64)
SEEDS = range(4)


def goodput(settings: LinkSettings, chunk: int | None, *, writes: bool, seed: int) -> float:
    """Return bytes per second from SETTLED to SIZE, by chunks of a size, or of the one that is found best."""
    rig = Rig("px4", settings, seed=seed)
    data = random.Random(1).randbytes(SIZE)
    rig.tree.add(b"/f", data)
    link, source, sink = rig.link, MemorySource(data), MemorySink(SIZE)
    transfer: ReadTransfer | WriteTransfer
    rig.open(b"/f")
    if writes:
        rig.close()
        opening = OpenFile(Opcode.CREATE_FILE, b"/f", link.engine.home_session)
        link.run(opening)
        transfer = WriteTransfer(opening.session, source, chunk or MAX_DATA)
    else:
        transfer = ReadTransfer(rig.session, SIZE, sink, chunk or MAX_DATA)
        transfer.want(0, SIZE, True)
    if chunk is None:
        transfer.chunks = Chunks()
    done = source.acked if writes else sink.held
    link.engine.start(transfer, link.now)
    link.run_until(lambda: done.total >= SETTLED, 3600.0)
    began = link.now
    link.run_until(lambda: done.total == SIZE, 3600.0)
    assert (rig.tree.data(b"/f") if writes else sink.data) == data
    return (SIZE - SETTLED) / (link.now - began)


@pytest.mark.parametrize("writes", [False, True], ids=["reads", "writes"])
@pytest.mark.parametrize("piece_loss", [0.1, 0.15])
def test_where_frames_go_in_pieces_it_finds_nearly_the_best(piece_loss: float, writes: bool) -> None:
    link = replace(RADIO, piece=64, piece_loss=piece_loss)
    best = max(goodput(link, chunk, writes=writes, seed=1) for chunk in FIXED)
    found = [goodput(link, None, writes=writes, seed=seed) for seed in SEEDS]
    assert mean(found) > 0.85 * best
