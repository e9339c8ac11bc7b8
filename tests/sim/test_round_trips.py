"""The round trips of short work, and the cost of a lost packet. Virtual time."""

from __future__ import annotations

import random
from functools import partial

import pytest
import trio

from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.model import split
from mavftpfs.sim.linkmodel import Direction, LinkModel, LinkSettings
from tests.support.memory import MemoryLink
from tests.support.rigs import Rig, write_file
from tests.support.takingturns import taking_turns
from tests.support.transfers import ROOTS, content, path, read_file

RTT = 0.3
LONG = LinkSettings(delay=RTT / 2)
PROFILES = ["px4", "px4-nuttx", "ardupilot", "ardupilot5", "littlefs", "mavsdk"]

READY = 0.1
"""Seconds that a server may take in addition to the link: ArduPilot looks at its queue every 10 ms."""


@pytest.mark.parametrize("profile", PROFILES)
async def test_a_directory_is_listed_in_two_round_trips_and_at_first_in_three(profile: str) -> None:
    """The names, that there are no more of them, and at first that none is hidden behind the end."""
    here = Rig(profile, link=LONG)
    directory = ROOTS.get(profile, b"") + b"/d"
    for name in (b"a", b"b"):
        here.card.add(directory + b"/" + name, name)
    async with here.connected() as connection:
        store = connection.store

        async def names(known_end: int | None = None) -> tuple[float, set[bytes]]:
            began = trio.current_time()
            listing = await store.list_directory(directory, known_end=known_end)
            return trio.current_time() - began, {entry.name for entry in listing.entries}

        end = (await store.list_directory(directory)).end
        for known_end, trips in ((None, 3), (end, 2)):
            requests = connection.engine.stats.requests
            took, seen = await names(known_end)
            assert (took <= trips * RTT + READY, seen) == (True, {b"a", b"b"})
            assert connection.engine.stats.requests == requests + trips
        await store.make_directory(directory + b"/c")
        await store.remove(directory + b"/a")
        await store.create_empty(directory + b"/e")
        await store.create_empty(directory + b"/f")
        took, seen = await names()
        assert (took <= 3 * RTT + READY, seen) == (True, {b"b", b"c", b"e", b"f"})
        if profile == "littlefs":  # which cannot rename
            return
        requests = connection.engine.stats.requests
        await store.rename(directory + b"/f", directory + b"/e2")  # it might have replaced a file
        await names()
        assert connection.engine.stats.requests == requests + 4
        here.card.add(directory + b"/g", b"of somebody else")
        took, seen = await names()
        assert (took <= 3 * RTT + READY, seen) == (True, {b"b", b"c", b"e", b"e2", b"g"})
        assert (await names())[0] <= 3 * RTT + READY


FIRST_WINDOWS = {"px4": 8, "px4-nuttx": 1, "ardupilot": 4, "ardupilot5": 4, "littlefs": 4, "mavsdk": 8}
"""Writes that may go out before the first answer; a serial port, as of PX4 on NuttX, begins with one."""


@pytest.mark.parametrize(
    ("profile", "chunks"),
    [(profile, chunks) for profile, most in FIRST_WINDOWS.items() for chunks in sorted({1, most})],
)
async def test_a_small_file_is_written_and_proven_in_five_round_trips(profile: str, chunks: int) -> None:
    """CreateFile, its bytes, Terminate, the CRC32 together with a look whether the name is free, and the
    rename; no matter how full the window is. The first two files also find out what the card can."""
    data = bytes(range(239)) * chunks
    here = Rig(profile, {b"/d": None}, LONG)
    async with here.mounted(b"/d") as tree:
        for name in (b"1", b"2", b""):
            began = trio.current_time()
            file = await tree.create(b"/d/f" + name, exclusive=False)
            await file.write(0, data)
            await file.flush()
            took = trio.current_time() - began
            assert here.data(b"/d/f" + name) == data
            await file.release()
        assert tree.status()["verified_by_crc"] in (3, 4)
    assert took <= 5 * RTT + READY


@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "ardupilot5", "mavsdk"])
async def test_the_first_large_file_costs_four_requests_more(profile: str) -> None:
    """An empty file is made and closed, renamed, and removed: so it is known that the card can rename."""
    about = (Opcode.CREATE_FILE, Opcode.TERMINATE_SESSION, Opcode.RENAME, Opcode.REMOVE_FILE)
    here, costs = Rig(profile, {b"/d": None}), []
    async with here.mounted(b"/d") as tree:
        for name in (b"1", b"2", b"3"):
            here.faults.requests.clear()
            await write_file(tree, b"/d/f" + name, bytes(range(1, 240)) * 300)
            costs.append(here.count(*about))
    assert costs[0] == costs[2] + 4
    assert here.litter() == []


WIFI = LinkSettings(rate=625_000.0, delay=0.015, queue=300_000)
FTP = 110

OPCODE, REQ_OPCODE = 16, 18
"""Where they are in a frame."""

LONGEST = 0.6
SMALL = 600


class OneLoss(LinkModel):
    """Loses one of the frames that carry FTP, or just those about one opcode; counts them from 0."""

    def __init__(self, victim: int, about: int | None = None) -> None:
        super().__init__(random.Random(1), WIFI)
        self.victim = victim
        self.about = about
        self.ftp = 0

    def push(self, direction: Direction, frame: bytes, now: float) -> bool:
        asked = frame[OPCODE if direction is Direction.TO_VEHICLE else REQ_OPCODE]
        if int.from_bytes(frame[7:10], "little") != FTP or self.about not in (None, asked):
            return super().push(direction, frame, now)
        self.ftp += 1
        return self.ftp - 1 == self.victim or super().push(direction, frame, now)


async def first_steps(profile: str, victim: int) -> tuple[float, int]:
    """Mount, list and read a small file at once; return how long that took, and how many frames it was."""
    here, model = Rig(profile, {b"/d/f": content(SMALL)}, WIFI), OneLoss(victim)
    here.link = MemoryLink(here.vehicle, model)
    target = path(profile, "f")
    async with here.mounted() as tree:
        began = trio.current_time()
        assert dict(await tree.list(target[:-2])).keys() == {b"f"}
        handle = await tree.open(target)
        assert await handle.read(0, SMALL) == content(SMALL)
        took, frames = trio.current_time() - began, model.ftp
        await handle.release()
    return took, frames


@pytest.mark.holds("rule 14.38")
@pytest.mark.parametrize("profile", ["ardupilot", "mavsdk", "px4"])
async def test_no_one_loss_costs_a_second(profile: str) -> None:
    """The very first listing, of a server of which no round trip was known, was asked for again after 1 s."""
    usual, frames = await first_steps(profile, -1)
    assert frames > 6
    cost = [(await first_steps(profile, victim))[0] - usual for victim in range(frames)]
    assert max(cost) <= LONGEST


async def upload(profile: str, victim: int) -> float:
    """Return how long a close takes of a new file; victim: which frame about its checksum is lost."""
    data = content(200_000)
    here = Rig(profile, {b"/d": None}, WIFI)
    here.link = MemoryLink(here.vehicle, model := OneLoss(victim, Opcode.CALC_FILE_CRC32))
    target = path(profile, "new")
    async with here.mounted(target[:-4]) as tree:
        file = await tree.create(target, exclusive=False)
        await file.write(0, data)
        began = trio.current_time()
        await file.flush()
        took = trio.current_time() - began
        assert here.card.data(target) == data
        await file.release()
    assert model.ftp > max(1, victim)
    return took


@pytest.mark.holds("rule 14.38")
@pytest.mark.parametrize("profile", taking_turns(("ardupilot", "mavsdk", "px4"), soak=("mavsdk",)))
async def test_nor_does_that_of_a_checksum_cost_what_the_slowest_card_takes(profile: str) -> None:
    """Request or reply. The request was once repeated after 6.3 s, where the whole copy takes one or two."""
    usual = await upload(profile, -1)
    for victim in (0, 1):
        assert await upload(profile, victim) - usual <= 1.0


async def test_changing_many_names_of_a_long_directory_seldom_lists_it() -> None:
    """Over a slow link each rename, and every seventh removal, listed the directory: five seconds each."""
    count = 100
    here = Rig("px4", {b"/d/a_file_with_a_long_name_%d" % number: b"x" for number in range(count)}, LONG)
    directory = split(path("px4", "f"))[0]
    async with here.mounted(directory) as tree:
        names = [f"a_file_with_a_long_name_{number}".encode() for number in range(count)]
        began = trio.current_time()
        for name in names[: count // 2]:
            await tree.rename(directory + b"/" + name, directory + b"/" + name[-4:], noreplace=True)
        for name in names[count // 2 :]:
            await tree.unlink(directory + b"/" + name)
        took = trio.current_time() - began
    assert len(here.card.entries(directory)) == 2 + count // 2  # "." and ".."
    assert took <= 1.5 * count * RTT


class Swallowing(LinkModel):
    """The vehicle's parser takes the next `left` bytes of ours for the rest of a frame."""

    def __init__(self) -> None:
        super().__init__(random.Random(1), WIFI)
        self.left = 0

    def push(self, direction: Direction, frame: bytes, now: float) -> bool:
        if direction is Direction.TO_VEHICLE and self.left > 0:
            self.left -= len(frame)
            return True
        return super().push(direction, frame, now)


@pytest.mark.holds("rule 14.38")
@pytest.mark.parametrize("profile", PROFILES)
async def test_a_parser_that_lost_the_thread_costs_no_second(profile: str) -> None:
    """A dozen short frames had to be lost on it, of which the last came every 3 s."""
    here = Rig(profile, {b"/d/f": content(100), b"/d/g": content(100)}, WIFI)
    here.link = MemoryLink(here.vehicle, model := Swallowing())
    async with here.connected() as connection:
        store = connection.store
        await store.list_directory(split(path(profile, "f"))[0])
        await read_file(connection, path(profile, "f"))
        await trio.sleep(3)
        for work in (
            partial(store.list_directory, split(path(profile, "f"))[0]),
            partial(store.stat_size, path(profile, "f")),
            partial(store.make_directory, path(profile, "new")),
            partial(store.remove, path(profile, "g")),
        ):
            model.left, began = 255, trio.current_time()
            await work()
            assert trio.current_time() - began <= 2.0
