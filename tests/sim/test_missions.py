"""Missions as texts, over simulated links: reading, and saving on each kind of vehicle."""

from __future__ import annotations

import pytest
import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.parameters.missions import parse
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    Armed,
    InvalidText,
    MavftpfsError,
    NotFound,
    NotTaken,
    RequestTimeout,
    VehicleLost,
)
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.missions import Missions
from tests.support.rigs import Rig, read_file, rig

MISSION, FENCE, RALLY = (b"/@MISSION/%b.waypoints" % name for name in (b"mission", b"fence", b"rally"))
ERRORS = b"/@MISSION/last_error.txt"
PROFILES = pytest.mark.parametrize("profile", ["ardupilot", "ardupilot5"])
PLAN = """QGC WPL 110
0\t0\t0\t16\t0\t0\t0\t0\t0\t0\t0\t1
1\t0\t3\t22\t0\t0\t0\t0\t0\t0\t20\t1
2\t0\t3\t16\t3\t0\t0\t0\t-35.3610000\t149.1610000\t30\t1
3\t0\t3\t20\t0\t0\t0\t0\t0\t0\t0\t1
"""


def of(here: Rig) -> Missions:
    return here.server._storage.virtual.missions


async def save(tree: Tree, path: bytes, text: str) -> None:
    file = await tree.open(path, write=True, truncate=True)
    try:
        await file.write(0, text.encode())
        await file.flush()
    finally:
        await file.release()


def commands(here: Rig, kind: int = 0) -> list[int]:
    return [int(item[8]) for item in of(here).items[kind]]


@PROFILES
@pytest.mark.parametrize("loss", [0.0, 0.1])
async def test_a_mission_is_written_and_read_back(profile: str, loss: float) -> None:
    async with rig(profile, link=LinkSettings(delay=0.02, loss=loss)) as here:
        tree = here.mount()
        names = {name for name, _ in await tree.list(b"/@MISSION")}
        assert names >= {b"mission.dat", b"mission.waypoints", b"rally.waypoints", b"last_error.txt"}
        assert len((await read_file(tree, MISSION)).splitlines()) == 2
        await save(tree, MISSION, PLAN)
        assert commands(here) == [16, 22, 16, 20]
        items, problems = parse((await read_file(tree, MISSION)).decode())
        assert problems == []
        assert (items[2].x, items[2].parameters[0], items[2].z) == (-353610000, 3.0, 30.0)
        assert items[0].x == -353632610  # home is the vehicle's
        assert await read_file(tree, ERRORS) == b""


async def test_a_mission_that_is_there_sends_nothing() -> None:
    async with rig("ardupilot5") as here:
        tree = here.mount()
        await save(tree, MISSION, PLAN)
        for text in (PLAN, (await read_file(tree, MISSION)).decode()):
            with pytest.raises(InvalidText):
                await save(tree, MISSION, PLAN + "x\n")
            assert await read_file(tree, ERRORS) != b""
            await save(tree, MISSION, text)
            assert await read_file(tree, ERRORS) == b""
        assert here.count(Opcode.CREATE_FILE) == 1


async def test_a_fence_and_rally_points() -> None:
    async with rig("ardupilot5") as here:
        tree = here.mount()
        await save(tree, RALLY, "QGC WPL 110\n0 0 3 5100 0 0 0 0 -35.3 149.1 30.5 1\n")
        corners = "".join(f"{i} 0 3 5001 3 0 0 0 -35.{i} 149.1 0 1\n" for i in range(3))
        await save(tree, FENCE, "QGC WPL 110\n" + corners)
        assert (commands(here, 1), commands(here, 2)) == ([5001] * 3, [5100])
        assert b"5100" in await read_file(tree, RALLY)
        await save(tree, RALLY, "QGC WPL 110\n")
        assert commands(here, 2) == []


@PROFILES
async def test_a_refused_one_leaves_the_old_and_is_an_error(profile: str) -> None:
    async with rig(profile) as here:
        tree = here.mount()
        await save(tree, MISSION, PLAN)
        of(here).limit = 4
        more = PLAN + "4\t0\t3\t16\t0\t0\t0\t0\t-35.4\t149.1\t30\t1\n"
        with pytest.raises(NotTaken, match="wanted 4 items, got 3") as caught:
            await save(tree, MISSION, more)
        assert errno_for(caught.value) == 5
        assert commands(here) == [16, 22, 16, 20]
        assert b"wanted 4 items, got 3" in await read_file(tree, ERRORS)


async def test_what_the_vehicle_has_no_room_for_is_said() -> None:
    async with rig("ardupilot5") as here:
        tree = here.mount()
        await save(tree, MISSION, PLAN.replace("\t16\t3\t0\t0\t0\t", "\t16\t3\t0\t0\t90\t"))
        assert b"item 2: parameter 4: wanted 90, got 0 (the vehicle does not keep it)" in await read_file(
            tree, ERRORS
        )


async def test_bad_lines_are_named_and_nothing_is_sent() -> None:
    async with rig("ardupilot5") as here:
        tree = here.mount()
        file = await tree.open(MISSION, write=True, truncate=True)
        await file.write(0, b"\xff\n")
        with pytest.raises(InvalidText):
            await file.flush()
        assert b"mission.waypoints:1: this is no text" in await read_file(tree, ERRORS)
        file = await tree.open(MISSION, write=True, append=True)
        await file.write(0, PLAN.splitlines(keepends=True)[1].encode())
        with pytest.raises(InvalidText):
            await file.flush()
        assert here.count(Opcode.CREATE_FILE) == 0


async def test_armed_and_cut() -> None:
    async with rig("ardupilot5") as here:
        tree = here.mount()
        await tree.stat(MISSION)
        await here.arm()
        with pytest.raises(Armed):
            await save(tree, MISSION, PLAN)
        await here.disarm()
        here.faults.at(Opcode.WRITE_FILE, here.link.cut)
        with pytest.raises((RequestTimeout, VehicleLost)):
            await save(tree, MISSION, PLAN)
        assert b"not known" in await read_file(tree, ERRORS)
        await here.find()
        await trio.sleep(30)
        await save(tree, MISSION, PLAN)
        assert commands(here) == [16, 22, 16, 20]


async def test_a_vehicle_without_missions_has_no_such_directory() -> None:
    async with rig("px4-2026") as here:
        tree = here.mount()
        assert b"@MISSION" not in dict(await tree.list(b"/"))
        for path in (b"/@MISSION", MISSION):
            with pytest.raises((NotFound, MavftpfsError)):
                await tree.stat(path)
