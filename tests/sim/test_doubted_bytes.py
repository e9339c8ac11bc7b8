"""Bytes that were ACKed and are not what the card has: an older copy came late, another client was there, or
the power went.

The size tells nothing of these, so what is in doubt is read back, whatever verify= says (promise 2).
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.faults import Faults, power_goes_at_close
from tests.support.mounting import mounted
from tests.support.takingturns import taking_turns
from tests.support.worlds import ROOTS, World

pytestmark = pytest.mark.holds("fault duplicate")

KEEPING = sorted(name for name in PROFILES if not PROFILES[name].write_only_truncates)
DOUBLING = LinkSettings(delay=0.02, duplicate=0.3)
CLEAN = LinkSettings(delay=0.02)
STRANGER = Address(255, 190)
SWIFTEST = 2.5
"""No vehicle restarts twice in so many seconds."""


def on_write(world: World, act: Callable[[int, bytes, Address], None]) -> Callable[[bytes], None]:
    """Have something happen at each WriteFile of ours; return how to hand the server a request of others."""
    server, count = world.vehicle.server, 0
    handle = server.handle

    def watch(wire: bytes, source: Address, now: float) -> None:
        nonlocal count
        if wire[3] == Opcode.WRITE_FILE:
            count += 1
            act(count, wire, source)
        handle(wire, source, now)

    server.handle = watch  # type: ignore[method-assign]
    return lambda wire: handle(wire, STRANGER, trio.current_time())


def come_late(world: World, nursery: trio.Nursery, late: float) -> trio.Event:
    """Have the first WriteFile from now on come once more; the event tells when it came."""
    came = trio.Event()
    handle = world.vehicle.server.handle

    async def arrive(wire: bytes, source: Address) -> None:
        await trio.sleep(late)
        handle(wire, source, trio.current_time())

    def act(count: int, wire: bytes, source: Address) -> None:
        if count == 1:
            nursery.start_soon(arrive, wire, source)
            came.set()

    on_write(world, act)
    return came


@pytest.mark.parametrize("late", [0.12, 0.15, 0.2, 0.25])
@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_an_older_copy_of_a_part_that_was_written_twice(
    profile: str, late: float, autojump: MockClock
) -> None:
    world = World(profile, DOUBLING)
    root = ROOTS.get(profile, b"") + b"/d"
    world.tree.add(root + b"/f", b"x" * 300_000)
    async with mounted(world, root) as (_, tree), trio.open_nursery() as nursery:
        file = await tree.open(root + b"/f", write=True)
        await file.write(0, b"A" * 100)
        await file.fsync()
        await trio.sleep(20)
        came = come_late(world, nursery, late)
        await file.write(0, b"B" * 70_000)
        await came.wait()
        await trio.sleep(0.08)
        await file.write(0, b"C" * 100)
        await file.flush()
        assert bytes(world.tree.data(root + b"/f"))[:200] == b"C" * 100 + b"B" * 100
        file.close()


@pytest.mark.parametrize("verify", ["auto", "size", "none"])
@pytest.mark.parametrize("late", [0.15, 0.2])
async def test_the_head_of_a_large_new_file_written_at_the_end(
    verify: str, late: float, autojump: MockClock
) -> None:
    world = World("px4", DOUBLING)
    world.tree.add(b"/d/k", b"x")
    opened = mounted(world, b"/d", verify=verify, verify_max=50_000)
    async with opened as (_, tree), trio.open_nursery() as nursery:
        came = come_late(world, nursery, late)
        file = await tree.create(b"/d/new", exclusive=True)
        await file.write(0, b"B" * 100_000)
        await came.wait()
        await trio.sleep(0.08)
        await file.write(0, b"C" * 100)
        await file.flush()
        assert bytes(world.tree.data(b"/d/new"))[:200] == b"C" * 100 + b"B" * 100
        file.close()


@pytest.mark.holds("rule 14.39")
@pytest.mark.parametrize("leaves", [False, True])
@pytest.mark.parametrize("profile", ["px4", "px4-2026", "px4-nuttx"])
async def test_another_clients_file_took_the_bytes(profile: str, leaves: bool, autojump: MockClock) -> None:
    """PX4 has one session, 0, whoever asks: our ACKs may be for the other one's file."""
    world = World(profile, CLEAN)
    root = ROOTS.get(profile, b"") + b"/d"
    world.tree.add(root + b"/f", b"x" * 300_000)
    new = bytes(range(1, 240)) * 500
    async with mounted(world, root) as (connection, tree):
        file = await tree.open(root + b"/f", write=True)
        await file.write(0, b"A" * 100)
        await file.fsync()
        seq = 30_000

        def wire(opcode: Opcode, data: bytes) -> bytes:
            nonlocal seq
            seq += 10
            return struct.pack("<HBBBBBBI", seq, 0, opcode, len(data), 0, 0, 0, 0) + data.ljust(239, b"\0")

        def act(count: int, _wire: bytes, source: Address) -> None:
            if count == 100:
                stranger(wire(Opcode.RESET_SESSIONS, b""))
                stranger(wire(Opcode.CREATE_FILE, root + b"/theirs"))
                connection.vehicle.foreign_at = trio.current_time()
                connection.vehicle.on_foreign(bytes(251), True)
            if count == 200 and leaves:
                stranger(wire(Opcode.TERMINATE_SESSION, b""))

        stranger = on_write(world, act)
        await file.write(0, new)
        for _ in range(3):  # it may be told that the session is shared just now
            try:
                await file.flush()
            except MavftpfsError:
                await trio.sleep(20)
                continue
            break
        else:
            pytest.fail("it never ended well")
        assert bytes(world.tree.data(root + b"/f")) == new + b"x" * (300_000 - len(new))
        file.close()


@pytest.mark.parametrize(("downtime", "beat_after"), [(0.0, 0.0), (3.0, 0.0), (4.0, 0.9), (12.0, 0.9)])
@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_the_power_went_between_the_last_answer_and_the_close(
    profile: str, downtime: float, beat_after: float, autojump: MockClock
) -> None:
    """The last sector was in its memory. Who restarted may ACK the Terminate, too, before we hear of that."""
    world = World(profile, CLEAN)
    root = ROOTS.get(profile, b"") + b"/d"
    world.tree.add(root + b"/f", b"x" * 300_000)
    async with mounted(world, root) as (_, tree):
        file = await tree.open(root + b"/f", write=True)
        await file.write(0, b"A" * 100)
        await file.fsync()
        await trio.sleep(30)
        before = bytes(world.tree.data(root + b"/f"))
        await file.write(1000, b"B" * 100)
        power_goes_at_close(world, root + b"/f", before, downtime=downtime, beat_after=beat_after)
        await file.fsync()
        assert bytes(world.tree.data(root + b"/f")) == before[:1000] + b"B" * 100 + before[1100:]
        file.close()


@pytest.mark.holds("promise 2", "fault killed program")
@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(2, 60))]
)
@pytest.mark.parametrize("profile", ["px4-nuttx", "ardupilot5"])
async def test_fsync_is_true_though_the_vehicle_restarts_at_any_request(
    profile: str, seed: int, autojump: MockClock
) -> None:
    """FAT has a sector in memory until the file is closed."""
    rng = random.Random(seed)
    settings = LinkSettings(delay=rng.choice([0.02, 0.1, 0.4]), loss=rng.choice([0.0, 0.05]))
    world = World(profile, settings, seed=seed)
    path = ROOTS.get(profile, b"") + b"/d/f"
    model = bytearray(rng.randbytes(20_000))
    world.tree.add(path, bytes(model))
    faults, last = Faults(world), -SWIFTEST
    async with mounted(world, verify=rng.choice(["auto", "size", "none"])) as (_, tree):
        file = await tree.open(path, write=True)
        for _ in range(12):
            await trio.sleep(rng.uniform(1, 40))
            for _ in range(rng.randrange(1, 4)):
                at, data = rng.randrange(19_000), rng.randbytes(rng.choice([1, 50, 300, 900]))
                model[at : at + len(data)] = data
                await file.write(at, data)
            downtime, beat_after = rng.choice([(0.0, 0.0), (2.6, 0.5), (3.0, 0.9), (5.0, 0.0), (9.0, 0.9)])

            def restart(downtime: float = downtime, beat_after: float = beat_after) -> None:
                nonlocal last
                if trio.current_time() - last >= SWIFTEST:  # else one that was left from before just struck
                    last = trio.current_time()
                    world.vehicle.reboot(last, downtime, beat_after=beat_after)

            faults.after(rng.randrange(1, 14), restart)
            for _ in range(8):
                try:
                    await file.fsync()
                    break
                except MavftpfsError:
                    await trio.sleep(10)
            assert bytes(world.tree.data(path)) == bytes(model)
        file.close()


async def test_what_is_beyond_doubt_costs_nothing(autojump: MockClock) -> None:
    """On a link that loses and doubles nothing what was written twice is believed like all else."""
    world = World("px4", CLEAN)
    world.tree.add(b"/d/f", b"x" * 300_000)
    faults = Faults(world)
    async with mounted(world, b"/d") as (_, tree):
        file = await tree.open(b"/d/f", write=True)
        await file.write(0, b"A" * 100)
        await file.fsync()
        faults.requests.clear()
        await file.write(0, b"B" * 70_000)
        await trio.sleep(0.1)
        await file.write(0, b"C" * 100)
        await file.flush()
        assert faults.requests.count(Opcode.READ_FILE) == 0
        file.close()
