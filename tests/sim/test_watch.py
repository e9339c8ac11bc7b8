"""client.watch: days of a companion computer, with simulated vehicles, on virtual time."""

from __future__ import annotations

import gc
import os
import random
import subprocess
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest
import trio

from mavftpfs.client.contact import Heard, MountContact
from mavftpfs.client.files import Session
from mavftpfs.client.logs import SyncRequest
from mavftpfs.client.manifest import NAME, Downloaded, Manifest
from mavftpfs.client.selection import EVERYTHING, Selection
from mavftpfs.client.watch import Keeping, Watch
from mavftpfs.link.messages import Address
from mavftpfs.link.uri import parse_source
from mavftpfs.shared.options import Options
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import MemoryTree
from mavftpfs.sim.vehicle import SimVehicle
from tests.ops.faketree import session_of
from tests.support.memory import MemoryLink
from tests.support.rigs import Rig, wall
from tests.support.takingturns import taking_turns
from tests.support.transfers import content

PLACES = {
    "px4": b"/fs/microsd/log",
    "px4-2026": b"/fs/microsd/log",
    "ardupilot": b"/APM/LOGS",
    "mavsdk": b"/logs",
}
RADIO = LinkSettings(rate=20_000, delay=0.02)
SPEC = parse_source("udpin:127.0.0.1:14550")
MAY = 1_714_521_600
LONG = 20_000.0
"""Virtual seconds for what comes within minutes: time jumps on while a thread waits for the real disk."""


class Day:
    """A vehicle, and the companion computer whose watch downloads its logs."""

    def __init__(self, local: Path, profile: str = "px4") -> None:
        self.rig = Rig(profile, link=RADIO)
        self.place = PLACES[profile]
        self.rig.card.add_directory(self.place)
        self.local = local
        self.said: list[str] = []
        self.handed: list[str] = []
        self.problem = ""
        self.count = 0
        self.selection = EVERYTHING

    @property
    def vehicle(self) -> SimVehicle:
        return self.rig.link.vehicle

    @property
    def requests(self) -> int:
        """All FTP requests that the vehicle heard."""
        return self.vehicle.server.requests.total()

    @property
    def home(self) -> Path:
        """Where the logs of the first vehicle are."""
        (found,) = (path for path in self.local.iterdir() if path.is_dir())
        return found

    def home_of(self, system: int) -> Path:
        """Return the directory that the watch named for the logs of one vehicle."""
        begin, told = f"vehicle {system} is ", "; its logs go into "
        (place,) = {line.partition(told)[2] for line in self.said if line.startswith(begin) and told in line}
        return Path(place)

    def logs(self) -> dict[str, bytes]:
        """Return what is here, by names below LOCAL without the vehicle's."""
        files = (path for path in self.local.rglob("*") if path.is_file() and path.name != NAME)
        return {str(path.relative_to(self.local)).partition("/")[2]: path.read_bytes() for path in files}

    @asynccontextmanager
    async def watched(self) -> AsyncIterator[None]:
        """Run the watch during the body; a second time stands for another process."""
        hand_on = self._hand_on
        watch = Watch(SyncRequest(self.local, selection=self.selection), self.said.append, hand_on)
        async with trio.open_nursery() as nursery:
            nursery.start_soon(watch.keeping.hand_on_all)
            nursery.start_soon(watch.run_on, self.rig.link, SPEC, Options())
            yield
            nursery.cancel_scope.cancel()

    async def _hand_on(self, file: Path) -> str:
        await trio.sleep(1.0)
        self.handed.append(file.name)
        return self.problem

    def put(self, name: str, data: bytes, mtime: int | None = None) -> None:
        self.rig.card.add(self.place + b"/" + name.encode(), data, mtime)

    async def fly(self, name: str, data: bytes) -> None:
        """Fly for half a minute, and log meanwhile."""
        self.vehicle.arm()
        for second in range(1, 31):
            self.put(name, data[: len(data) * second // 60])
            await trio.sleep(1.0)
        self.put(name, data)
        self.vehicle.disarm()

    def saying(self, text: str) -> int:
        """Return how often something was said."""
        return sum(text in line for line in self.said)

    async def until_handed(self, count: int) -> None:
        """Wait until so many logs were handed on."""
        with trio.fail_after(LONG):
            while len(self.handed) < count:  # noqa: ASYNC110 (by a plain call)
                await trio.sleep(0.1)

    async def until(self, text: str, times: int = 1, limit: float = LONG) -> None:
        """Wait until it was said so often."""
        with trio.move_on_after(limit):
            while self.saying(text) < times:  # noqa: ASYNC110 (it is said by a plain call)
                await trio.sleep(0.1)
            return
        raise AssertionError(f"not said {times} times: {text}\n" + "\n".join(self.said))


@pytest.fixture
def day(tmp_path: Path) -> Day:
    return Day(tmp_path / "logs")


# -- flights --------------------------------------------------------------------------------------


async def test_patterns_and_since_choose_logs_and_what_since_cannot_leave_out_is_said_first(day: Day) -> None:
    day.selection = Selection(since=MAY, include=("*.ulg",))
    day.put("2024-04-30/10_00_00.ulg", content(3000, 1))
    day.put("2024-05-01/10_00_00.ulg", content(3000, 2))
    day.put("sess001/log001.ulg", content(3000, 3))
    day.put("2024-05-01/note.txt", b"note")
    async with day.watched():
        await day.until_handed(2)
    assert set(day.logs()) == {"2024-05-01/10_00_00.ulg", "sess001/log001.ulg"}
    warning = "vehicle 1: --since does not leave out 1 of 2 logs (3.0 kB), because"
    (at,) = (number for number, line in enumerate(day.said) if warning in line)
    assert not any("begins" in line for line in day.said[:at])


@pytest.mark.parametrize("profile", taking_turns(PLACES))
async def test_each_log_of_three_flights_comes_once_whole_and_proven(tmp_path: Path, profile: str) -> None:
    day, flights = Day(tmp_path / "logs", profile), {}
    async with day.watched():
        await trio.sleep(5.0)
        for number in range(1, 4):
            flights[f"log{number:03}.ulg"] = content(20_000 + number, number)
            await day.fly(f"log{number:03}.ulg", flights[f"log{number:03}.ulg"])
            await day.until("is here, verified by size and CRC32", number)
            await trio.sleep(300.0)
    assert day.logs() == flights
    assert day.handed == list(flights)
    assert day.saying("begins") == day.saying("is here, verified") == 3
    assert (day.saying("is armed"), day.saying("is disarmed")) == (3, 3)


async def test_what_is_there_at_the_start_counts_as_new_and_nothing_is_asked_twice(day: Day) -> None:
    day.put("a/1.ulg", content(5000))
    async with day.watched():
        await day.until("is here, verified")
        await trio.sleep(30.0)
        asked = day.requests
        await trio.sleep(1000.0)
        assert day.requests == asked
    assert day.rig.link.vehicle.server.open_sessions == 0
    assert day.logs() == {"a/1.ulg": content(5000)}


@pytest.mark.holds("promise 9")
@pytest.mark.parametrize(
    ("profile", "how"),
    [*((profile, "armed") for profile in PLACES), ("px4", "refused"), ("ardupilot", "denied")],
)
async def test_a_transfer_lets_go_within_a_second(tmp_path: Path, profile: str, how: str) -> None:
    day = Day(tmp_path / "logs", profile)
    day.put("1.ulg", content(150_000))
    async with day.watched():
        await day.until("begins")
        await trio.sleep(3.0)
        assert day.rig.link.vehicle.server.open_sessions == 1
        match how:
            case "armed":
                day.vehicle.arm()
            case "denied":
                day.vehicle.say(3, "Arming denied: high throttle")
            case "refused":
                day.vehicle._ready.append(day.vehicle.framer.encode("command_ack", 400, 4, 0, 0, 255, 190))
        day.vehicle.on_news()
        await trio.sleep(1.0)
        asked = day.requests
        assert day.rig.link.vehicle.server.open_sessions == 0
        assert day.saying("the transfer waits") == 1
        await trio.sleep(50.0)
        assert day.requests == asked
        if how == "armed":
            await trio.sleep(100.0)
            assert day.requests == asked
            day.vehicle.disarm()
        await day.until("is here, verified")
    assert day.logs() == {"1.ulg": content(150_000)}
    assert day.saying("begins, 150.0 kB, from ") == 1


async def test_a_warning_before_arming_is_no_refusal(day: Day) -> None:
    day.put("1.ulg", content(100_000))
    async with day.watched():
        await day.until("begins")
        day.vehicle.say(4, "PreArm: Compass not calibrated")
        await day.until("is here, verified")
    assert day.saying("waits") == 0


async def test_a_vehicle_that_is_switched_off_is_gone_on_with(day: Day) -> None:
    day.put("1.ulg", content(400_000))
    async with day.watched():
        await day.until("begins")
        await trio.sleep(5.0)
        day.vehicle.reboot(trio.current_time(), downtime=1200.0)
        await day.until("is lost")
        await trio.sleep(1200.0)
        await day.until("is here, verified")
    assert day.saying("is back, disarmed") == 1
    assert day.saying("begins, 400.0 kB, from ") == 1
    assert day.logs() == {"1.ulg": content(400_000)}


async def test_a_log_that_never_stops_is_fetched_as_far_as_it_is(day: Day) -> None:
    data = content(2_000_000)
    async with day.watched(), trio.open_nursery() as nursery:

        async def log_on() -> None:
            for second in range(10_000):
                day.put("1.ulg", data[: 100 * second])
                await trio.sleep(1.0)

        nursery.start_soon(log_on)
        await day.until("still grows after the flight")
        asked = day.requests
        await trio.sleep(1500.0)
        assert day.saying("still grows") == 1
        assert day.requests - asked < 150  # it is looked at more and more seldom
        (part,) = day.logs().items()
        assert part[0] == "1.ulg.part"
        assert len(part[1]) > 5000
        assert data.startswith(part[1])
        assert day.handed == []
        nursery.cancel_scope.cancel()
    size = len(day.rig.card.data(day.place + b"/1.ulg"))
    async with day.watched():  # it was switched off, and on
        await day.until("is here, verified")
    assert day.logs() == {"1.ulg": data[:size]}


# -- what is the same -----------------------------------------------------------------------------


@pytest.mark.parametrize("profile", ["px4", "mavsdk"])
@pytest.mark.parametrize("size", [5000, 6000])
async def test_a_formatted_card_has_log001_again(tmp_path: Path, profile: str, size: int) -> None:
    day = Day(tmp_path / "logs", profile)
    day.put("log001.ulg", content(5000, 1), MAY)
    async with day.watched():
        await day.until("is here, verified")
        await day.until_handed(1)
    day.rig.card.remove(day.place + b"/log001.ulg")
    day.put("log001.ulg", content(size, 2), MAY + 9)
    async with day.watched():
        await day.until_handed(2)
    assert day.logs() == {"log001.ulg": content(size, 2), "log001.ulg.~1~": content(5000, 1)}


@pytest.mark.parametrize("profile", ["px4", "mavsdk"])
async def test_a_log_that_was_moved_away_stays_away(tmp_path: Path, profile: str) -> None:
    day = Day(tmp_path / "logs", profile)
    day.put("1.ulg", content(5000))
    async with day.watched():
        await day.until("is here, verified")
    (day.home / "1.ulg").unlink()
    async with day.watched():
        await trio.sleep(100.0)
        day.vehicle.arm()
        await trio.sleep(10.0)
        day.vehicle.disarm()
        await trio.sleep(100.0)
    assert day.saying("is here, verified") == 1
    assert day.logs() == {}


async def test_a_log_that_grew_after_it_was_done_is_gone_on_with(day: Day) -> None:
    day.put("1.ulg", content(9000)[:5000])
    async with day.watched():
        await day.until("is here, verified")
        await day.fly("1.ulg", content(9000))
        await day.until("is here, verified", 2)
    assert day.logs() == {"1.ulg": content(9000)}
    assert day.saying("from 5.0 kB on") == 1


async def test_another_airframe_in_the_place_of_the_first_has_another_directory(day: Day) -> None:
    day.put("log001.ulg", content(5000, 1))
    async with day.watched():
        await day.until("is here, verified")
        tree = MemoryTree(clock=wall)
        tree.add(day.place + b"/log001.ulg", content(5000, 2))
        day.rig.link.vehicle = SimVehicle(tree, PROFILES["px4"], rng=random.Random(99))
        await day.until("is here, verified", 2)
    found = {path.read_bytes() for path in day.local.rglob("log001.ulg")}
    assert found == {content(5000, 1), content(5000, 2)}


class Two(SimVehicle):
    """Two vehicles on one link, of which the first is this."""

    def __init__(self, first: SimVehicle, second: SimVehicle) -> None:
        self.__dict__.update(first.__dict__)
        self.first, self.second = first, second

    def receive(self, data: bytes, now: float) -> None:
        for one in (self.first, self.second):
            one.receive(data, now)

    def outgoing(self, now: float) -> list[bytes]:
        return self.first.outgoing(now) + self.second.outgoing(now)

    def next_deadline(self) -> float:
        return min(self.first.next_deadline(), self.second.next_deadline())


async def test_a_pause_of_one_vehicle_does_not_mix_up_the_names_of_two(day: Day) -> None:
    tree = MemoryTree(clock=wall)
    second = SimVehicle(tree, PROFILES["ardupilot"], rng=random.Random(99), address=Address(2, 1))
    day.rig.link = MemoryLink(Two(day.vehicle, second), day.rig.model)
    day.put("log001.ulg", content(200_000, 1))
    async with day.watched():
        await day.until("log001.ulg begins")
        day.vehicle.say(3, "Arming denied: no")
        tree.add(b"/APM/LOGS/log001.ulg", content(100_000, 2))
        tree.add(b"/APM/LOGS/LASTLOG.TXT", b"1")
        second.arm()
        await trio.sleep(3.0)
        second.disarm()
        await day.until("is here, verified", 2)
        await trio.sleep(60.0)
    assert day.saying("vehicle 2: log001.ulg is here") == 1
    one, two = day.home_of(1), day.home_of(2)
    assert (one / "log001.ulg").read_bytes() == content(200_000, 1)
    assert (two / "log001.ulg").read_bytes() == content(100_000, 2)
    assert not (two / "LASTLOG.TXT").exists()


# -- what is done with a log ----------------------------------------------------------------------


async def test_what_could_not_be_handed_on_is_tried_at_the_next_start(day: Day) -> None:
    day.put("1.ulg", content(5000))
    day.problem = "--exec ended with exit code 1"
    async with day.watched():
        await day.until("tries again at its next start")
        await trio.sleep(600.0)
    assert day.handed == ["1.ulg"]
    day.problem = ""
    for _ in range(2):
        async with day.watched():
            await trio.sleep(100.0)
    assert day.handed == ["1.ulg"] * 2


async def test_watches_that_share_a_directory_hand_on_their_own_logs(tmp_path: Path) -> None:
    handed = list[tuple[int, str]]()

    def keeping(number: int) -> Keeping:
        async def hand_on(file: Path) -> str:
            await trio.sleep(1.0)
            handed.append((number, file.name))
            return ""

        return Keeping(tmp_path, lambda line: None, hand_on)

    watches = [keeping(1), keeping(2)]
    async with trio.open_nursery() as nursery:
        for number, watch in enumerate(watches, 1):
            nursery.start_soon(watch.hand_on_all)
            (tmp_path / f"{number}.ulg").write_bytes(b"log")
            watch.look()
            watch.note(Downloaded(f"/log/{number}.ulg", f"{number}.ulg", 3, None, vehicle=str(number)))
        await trio.sleep(10.0)
        nursery.cancel_scope.cancel()
    assert sorted(handed) == [(1, "1.ulg"), (2, "2.ulg")]


# -- the local disk -------------------------------------------------------------------------------


def run(*words: str | Path) -> None:
    """Run a command of the system."""
    subprocess.run(words, check=True, capture_output=True, timeout=30)


@contextmanager
def stick(place: Path, size: str) -> Iterator[None]:
    """Have a small disk at that place."""
    place.mkdir(exist_ok=True)
    run("mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", place)
    try:
        yield
    finally:
        run("umount", "-l", place)


@pytest.mark.needs("root")
async def test_a_full_disk_is_said_and_waited_for(tmp_path: Path) -> None:
    with stick(tmp_path / "stick", "2m"):
        day = Day(tmp_path / "stick")
        (tmp_path / "stick" / "other").write_bytes(bytes(1_800_000))
        day.put("1.ulg", content(400_000))
        async with day.watched():
            await day.until("No space left on device; waiting for the disk")
            await trio.sleep(600.0)
            assert day.saying("waiting for the disk") == 1
            (tmp_path / "stick" / "other").unlink()
            await day.until("is here, verified")
        assert day.logs() == {"1.ulg": content(400_000)}


@pytest.mark.needs("root")
async def test_a_disk_that_is_pulled_in_mid_transfer(tmp_path: Path) -> None:
    place, disk = tmp_path / "stick", tmp_path / "disk"
    disk.mkdir()
    with stick(disk, "4m"):
        place.mkdir()
        run("mount", "--bind", disk, place)
        day = Day(place)
        day.put("1.ulg", content(400_000))
        try:
            async with day.watched():
                await day.until("begins")
                await trio.sleep(3.0)
                run("umount", "-l", place)
                await day.until("so it is not the same disk; waiting for the disk")
                await trio.sleep(600.0)
                assert list(place.iterdir()) == []
                run("mount", "--bind", disk, place)
                await day.until("is here, verified")
            assert day.logs() == {"1.ulg": content(400_000)}
        finally:
            run("umount", "-l", place)


# -- for long -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("flights", "every"), [(5, 300.0), pytest.param(24, 3600.0, marks=pytest.mark.soak)])
async def test_flight_after_flight_without_growth(day: Day, flights: int, every: float) -> None:
    sizes, files = [], []
    async with day.watched():
        for number in range(flights):
            await day.fly("log.ulg", content(2000, number))
            await day.until_handed(number + 1)  # files are written in real time
            await trio.sleep(every - 30.0)
            gc.collect()
            sizes.append(len(gc.get_objects()))
            files.append(len(os.listdir("/proc/self/fd")))
    assert len(day.handed) == flights
    assert max(sizes[3:]) - sizes[1] < 1000
    assert max(files[3:]) <= files[1]
    assert (day.local / NAME).stat().st_size < 200 * 400
    assert len(Manifest(day.local).logs()) == 1


class ArmsWhileEntered:
    """A contact with a vehicle that is armed just when its files are to be had."""

    system = 1
    uid = None
    replaced = False

    def __init__(self) -> None:
        self._news = [Heard(1, armed=False)]

    async def listen(self) -> list[Heard]:
        await trio.lowlevel.checkpoint()
        news, self._news = self._news, []
        return news

    async def identity(self) -> str | None:
        raise AssertionError("an armed vehicle was asked")

    @asynccontextmanager
    async def session(self) -> AsyncIterator[Session]:
        self._news = [Heard(1, armed=True)]
        await trio.sleep(1.0)
        yield session_of(MemoryTree())


@pytest.mark.holds("promise 9")
async def test_a_vehicle_that_is_armed_while_its_files_are_opened_is_not_asked(tmp_path: Path) -> None:
    said: list[str] = []
    watch, contact = Watch(SyncRequest(tmp_path), said.append), ArmsWhileEntered()
    with trio.move_on_after(9.0):
        while True:
            await watch.serve(contact)
    assert said == ["vehicle 1 is here, disarmed", "vehicle 1 is armed"]


async def test_a_line_an_hour_tells_that_the_watch_is_alive(tmp_path: Path) -> None:
    said: list[str] = []
    contact = ArmsWhileEntered()
    contact._news = [Heard(1, armed=True)]
    watch = Watch(SyncRequest(tmp_path), said.append)
    with trio.move_on_after(3 * 3600.0):
        await watch.serve(contact)
    assert said == [
        "vehicle 1 is here, armed",
        "vehicle 1 is lost",
        *["nothing new for an hour; vehicle 1 is lost"] * 2,
    ]


async def test_a_mount_tells_of_arming_restarts_and_refusals(tmp_path: Path) -> None:
    vehicle = {"system": 1, "uid": "a", "armed": False, "restarts": 3, "arming_refused": 2}
    link = {"state": "fine"}

    async def status() -> dict[str, Any]:
        return {"vehicle": vehicle, "link": link}

    contact = MountContact(Session(session_of(MemoryTree()).files, status))
    assert await contact.listen() == [Heard(1, armed=False)]  # what was before does not count
    vehicle.update(armed=True, restarts=4)
    assert await contact.listen() == [Heard(1, armed=True, restarted=True)]
    vehicle.update(arming_refused=3)
    assert await contact.listen() == [Heard(1, armed=True, refused=True)]
    link["state"] = "replaced"
    assert await contact.listen() == []
