"""The session layer against every profile, on virtual time."""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.shared.errors import FtpNak, RequestTimeout, VehicleLost
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.takingturns import taking_turns
from tests.support.worlds import MemorySink, begin_to_read, content, path, read_file, world

EVERY_PROFILE = sorted(PROFILES)
BAD = LinkSettings(rate=60_000.0, delay=0.02, loss=0.1, duplicate=0.02, reorder=0.05)


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_list_and_read_over_a_bad_link(profile: str, autojump: MockClock) -> None:
    sizes = (0, 1, 238, 239, 240, 478, 5000, 60_000)
    files = {f"f{size}": content(size, size) for size in sizes}
    here = world(profile, BAD, **files)
    async with here.connection() as connection:
        listing = await connection.store.list_directory(path(profile, "")[:-1])
        assert {entry.name.decode(): entry.size for entry in listing.entries} == {
            name: len(data) for name, data in files.items()
        }
        for name, data in files.items():
            assert await read_file(connection, path(profile, name)) == data
    assert here.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_small_file_costs_open_read_terminate(profile: str, autojump: MockClock) -> None:
    here = world(profile, small=b"hello")
    async with here.connection() as connection:
        assert await read_file(connection, path(profile, "small")) == b"hello"
        await trio.sleep(5)
        assert connection.engine.stats.by_opcode == {
            Opcode.OPEN_FILE_RO: 1,
            Opcode.READ_FILE: 1,
            Opcode.TERMINATE_SESSION: 1,
        }
        assert here.vehicle.server.open_sessions == 0


@pytest.mark.holds("rule 14.7")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_several_files_at_once_share_the_session(profile: str, autojump: MockClock) -> None:
    files = {f"f{index}": content(20_000, index) for index in range(5)}
    here = world(profile, BAD, **files)
    got: dict[str, bytes] = {}
    most_open = 0
    async with here.connection() as connection, trio.open_nursery() as nursery:

        async def fetch(name: str) -> None:
            nonlocal most_open
            got[name] = await read_file(connection, path(profile, name))
            most_open = max(most_open, here.vehicle.server.open_sessions)

        for name in files:
            nursery.start_soon(fetch, name)
    assert got == files
    assert most_open == 1, "also where the server has more"
    assert here.vehicle.server.open_sessions == 0


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_is_asked_for_as_the_last_bytes_come_goes_out_at_once(
    profile: str, autojump: MockClock
) -> None:
    """It may be asked for before who serves the session has seen that it has nothing more to do."""
    rtt, step, steps = 0.1, 239, 60
    here = world(profile, LinkSettings(rate=1e6, delay=rtt / 2), f=content(steps * step))
    async with here.connection() as connection:
        sink = MemorySink(steps * step)
        reader = await connection.store.open_reader(path(profile, "f"), sink)
        began = trio.current_time()
        for start in range(0, steps * step, step):
            reader.want(start, start + step, demand=True)
            await sink.wait_for(start, start + step)
        assert trio.current_time() - began < 1.2 * steps * rtt
        reader.close()


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_is_asked_for_meanwhile_does_not_wait_for_an_answer(
    profile: str, autojump: MockClock
) -> None:
    rtt = 1.0
    here = world(profile, LinkSettings(rate=1e6, delay=rtt / 2), f=content(478))
    async with here.connection() as connection:
        sink = MemorySink(478)
        reader = await connection.store.open_reader(path(profile, "f"), sink)
        began = trio.current_time()
        reader.want(0, 239, demand=True)
        await trio.sleep(0.5 * rtt)
        reader.want(239, 478, demand=True)
        await sink.wait_for(0, 478)
        assert trio.current_time() - began < 1.8 * rtt
        reader.close()


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_small_read_overtakes_a_bulk_copy(profile: str, autojump: MockClock) -> None:
    """Promise 7: Terminate, open and read take a round trip each, and what is on its way comes first."""
    rate, rtt = 20_000.0, 0.1
    files = {f"small{number}": content(200, number) for number in range(5)}
    here = world(profile, LinkSettings(rate=rate, delay=rtt / 2), big=content(400_000), **files)
    async with here.connection() as connection, trio.open_nursery() as nursery:
        _, sink = await begin_to_read(connection, path(profile, "big"), 20_000)
        for name, data in files.items():
            await trio.sleep(0.4)  # less than a quantum: the copy has only just begun again
            copied_before, began = sink.have.total, trio.current_time()
            assert await read_file(connection, path(profile, name)) == data
            allowed = 3 * rtt + 0.3 + 4 * 300 / rate
            assert trio.current_time() - began < allowed
            assert sink.have.total - copied_before < allowed * rate
        await connection.store.list_directory(path(profile, "")[:-1])
        assert await sink.wait_for(0, 400_000) == content(400_000)
        nursery.cancel_scope.cancel()


@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_one_small_file_after_another_does_not_stop_a_copy(profile: str, autojump: MockClock) -> None:
    small = {f"s{index}": bytes([index]) * 100 for index in range(200)}
    here = world(profile, LinkSettings(rate=60_000.0, delay=0.015), big=content(2_000_000), **small)
    async with here.connection() as connection, trio.open_nursery() as nursery:
        sink = MemorySink(2_000_000)
        reader = await connection.store.open_reader(path(profile, "big"), sink)
        reader.want(0, 2_000_000, demand=True)
        await trio.sleep(2)

        async def read_small() -> None:
            for name, data in small.items():
                assert await read_file(connection, path(profile, name)) == data

        began, before = trio.current_time(), sink.have.total
        with trio.move_on_after(30):
            await read_small()
        copied = (sink.have.total - before) / (trio.current_time() - began)
        assert copied > {"px4": 4_000, "ardupilot": 1_800}[profile]  # half of it without the rule
        nursery.cancel_scope.cancel()


@pytest.mark.holds("promise 5")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_cut_in_mid_read_is_bridged(profile: str, autojump: MockClock) -> None:
    data = content(100_000)
    here = world(profile, LinkSettings(rate=20_000.0, delay=0.02, cuts=((4.0, 16.0),)), big=data)
    async with here.connection() as connection:
        assert await read_file(connection, path(profile, "big")) == data
    assert here.vehicle.server.open_sessions == 0


@pytest.mark.holds("fault reboot")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_reboot_in_mid_read_is_bridged(profile: str, autojump: MockClock) -> None:
    data = content(300_000)
    here = world(profile, LinkSettings(rate=20_000.0, delay=0.02), big=data)
    async with here.connection() as connection, trio.open_nursery() as nursery:

        async def reboot() -> None:
            await trio.sleep(8)
            here.vehicle.reboot(trio.current_time(), downtime=4.0)
            here.link.kick()

        nursery.start_soon(reboot)
        assert await read_file(connection, path(profile, "big")) == data
        assert connection.vehicle.reboots == 1


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_reboot_forgets_what_was_seen_of_the_server(profile: str, autojump: MockClock) -> None:
    here = world(profile, small=b"hello")
    async with here.connection() as connection:
        await trio.sleep(8)
        await connection.store.list_directory(path(profile, "")[:-1])
        assert await read_file(connection, path(profile, "small")) == b"hello"
        assert connection.engine.traits.ack_carries_own_session is not None
        here.vehicle.reboot(trio.current_time(), downtime=1.0)
        here.link.kick()
        await trio.sleep(3)
        assert connection.vehicle.reboots == 1
        assert connection.engine.traits.ack_carries_own_session is None
        assert connection.store.lists_times is None
        assert await read_file(connection, path(profile, "small")) == b"hello"


@pytest.mark.holds("fault stale session", "rule 14.10")
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_session_left_by_a_killed_client_is_got_over(profile: str, autojump: MockClock) -> None:
    data = content(50_000)
    here = world(profile, LinkSettings(rate=100_000.0, delay=0.02), big=data)
    with trio.CancelScope():
        async with here.connection(seed=3) as connection:
            await begin_to_read(connection, path(profile, "big"), 1000)
            here.link.cut()  # so that the farewell does not arrive: kill -9
    here.link.restore()
    async with here.connection(seed=4) as connection:
        assert await read_file(connection, path(profile, "big")) == data
        # PX4 of 2026 keeps an idle session for longer than anybody waits in silence.
        assert connection.scheduler.server.resets == (profile == "px4-2026")


async def test_a_close_that_goes_unheard_does_not_fail_the_next_open(autojump: MockClock) -> None:
    here = world("px4", LinkSettings(delay=0.01), first=b"one", second=b"two")
    async with here.connection() as connection:
        assert await read_file(connection, path("px4", "first")) == b"one"
        here.link.cut()

        async def mend() -> None:
            await trio.sleep(8)
            here.link.restore()

        async with trio.open_nursery() as nursery:
            nursery.start_soon(mend)
            assert await read_file(connection, path("px4", "second")) == b"two"


@pytest.mark.holds("promise 4", "rule 14.36")
async def test_silence_fails_one_request_and_then_all_at_once(autojump: MockClock) -> None:
    here = world("px4", small=b"hello")
    async with here.connection() as connection:
        here.link.cut()
        began = trio.current_time()
        with pytest.raises(RequestTimeout):
            await connection.store.list_directory(b"/d")
        assert trio.current_time() - began == pytest.approx(30.0, abs=3.0)
        began = trio.current_time()
        for _ in range(500):
            with pytest.raises(VehicleLost):
                await connection.store.list_directory(b"/d")
        with pytest.raises(VehicleLost):
            await read_file(connection, b"/d/small")
        assert trio.current_time() == began
        here.link.restore()
        await trio.sleep(3)
        assert await read_file(connection, b"/d/small") == b"hello"


async def test_no_vehicle_says_what_was_heard(autojump: MockClock) -> None:
    here = world("px4")
    with pytest.raises(VehicleLost, match="heard only 1/1"):
        async with here.connection(ConnectOptions(target_system=9)):
            raise AssertionError("connected to nobody")


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_refusals_reach_the_caller(profile: str, autojump: MockClock) -> None:
    here = world(profile, small=b"hello")
    async with here.connection() as connection:
        with pytest.raises(FtpNak):
            await connection.store.list_directory(path(profile, "missing"))
        with pytest.raises(FtpNak) as refusal:
            await read_file(connection, path(profile, "missing"))
        assert refusal.value.code == 10
        assert await read_file(connection, path(profile, "small")) == b"hello"
