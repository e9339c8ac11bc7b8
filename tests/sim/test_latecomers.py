"""Requests that come once more, after newer ones, and that servers carry out: what is believed then.

Each is repeated at one exact place, within the time in which such copies are feared (`session.echoes.QUIET`).
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode, request
from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.session.echoes import QUIET
from mavftpfs.shared.errors import RequestTimeout
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.sim.test_stragglers import double
from tests.support.faults import Faults
from tests.support.latecomers import Latecomer
from tests.support.mounting import writable_tree
from tests.support.takingturns import taking_turns
from tests.support.uploads import append, probe, put
from tests.support.worlds import MemorySink, World, content, path, read_file, world

EVERY_PROFILE = sorted(PROFILES)
DOUBLING = LinkSettings(delay=0.02, duplicate=0.3, reorder=0.1)


@pytest.mark.parametrize(
    ("what", "after"),
    [
        (Opcode.WRITE_FILE, Opcode.OPEN_FILE_WO),  # fills what was emptied
        (Opcode.CREATE_FILE, Opcode.TERMINATE_SESSION),  # empties what was not
    ],
)
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_copy_does_not_teach_what_the_server_does_not_do(
    profile: str, what: Opcode, after: Opcode, autojump: MockClock
) -> None:
    plain = world(profile)
    async with plain.connection() as connection:
        await probe(connection, profile)
        truth = connection.store.traits
    here = world(profile, DOUBLING)
    async with here.connection() as connection:
        await connection.store.list_directory(path(profile, ""))  # answered twice
        copy = Latecomer(here, what, after=after)
        await probe(connection, profile)
        assert copy.late is not None
        assert copy.late < QUIET[0]
        assert connection.store.traits == truth


@pytest.mark.parametrize("profile", ["mavsdk", "mavsdk-old"])
async def test_a_late_write_does_not_hide_that_reopening_empties_files(
    profile: str, autojump: MockClock
) -> None:
    """Two copies at once on a fresh mount: the first is interrupted to see whether that can be done."""
    here = world(profile, replace(DOUBLING, rate=100_000.0))
    files = {path(profile, name): content(60_000, seed) for seed, name in enumerate(("f", "g"))}
    async with here.connection() as connection:
        await connection.store.list_directory(path(profile, ""))
        copy = Latecomer(here, Opcode.WRITE_FILE, after=Opcode.OPEN_FILE_WO)
        async with trio.open_nursery() as nursery:
            for name, data in files.items():
                nursery.start_soon(put, connection, name, data)
        assert copy.late is not None
        assert copy.late < QUIET[1]
        assert connection.store.traits.wo_truncates is True
    for name, data in files.items():
        assert here.tree.data(name) == data


async def read_or_doubt(connection: Connection, target: bytes, expected: bytes) -> None:
    """Read a file whole: its own bytes, or doubt about them within a second."""
    sink = MemorySink(len(expected))
    reader = await connection.store.open_reader(target, sink)
    reader.want(0, reader.size, demand=True)
    data = await sink.wait_for(0, reader.size)
    await trio.sleep(1)
    assert data == expected or sink.suspicions
    reader.close()


@pytest.mark.parametrize("nth", [8, 9, 12])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_late_open_of_another_file_gives_no_wrong_bytes(
    profile: str, nth: int, autojump: MockClock
) -> None:
    """MAVSDK closes what is open and opens that one, under the same id; files of one size hide it."""
    one, two = content(1500, 1), content(1500, 2)
    here = world(profile, DOUBLING, one=one, two=two)
    async with here.connection(ConnectOptions(window=1)) as connection:
        await connection.store.list_directory(path(profile, ""))
        copy = Latecomer(here, Opcode.OPEN_FILE_RO, after=Opcode.READ_FILE, nth=nth, first=True)
        assert await read_file(connection, path(profile, "one")) == one
        await read_or_doubt(connection, path(profile, "two"), two)
        assert copy.late is not None


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_late_open_that_was_given_up_gives_no_wrong_bytes(profile: str, autojump: MockClock) -> None:
    """Nobody knows its seq: no answer ever came."""
    one, two = content(1500, 1), content(1500, 2)
    here = world(profile, LinkSettings(delay=0.02), one=one, two=two)
    faults = Faults(here)
    async with here.connection(ConnectOptions(window=1, op_deadline=2.0)) as connection:
        copy = Latecomer(here, Opcode.OPEN_FILE_RO, after=Opcode.READ_FILE, nth=3, first=True)
        faults.cut_after(0)
        with pytest.raises(RequestTimeout):
            await read_file(connection, path(profile, "one"))
        faults.cut_after(None)
        await read_or_doubt(connection, path(profile, "two"), two)
        assert copy.late is not None


async def open_and_leave(connection: Connection, profile: str, opcode: Opcode) -> None:
    """Make a file, or read one, and wait until its session is closed."""
    if opcode is Opcode.CREATE_FILE:
        await put(connection, path(profile, "new"), content(500))
    else:
        await read_file(connection, path(profile, "f"))
    await trio.sleep(8)


@pytest.mark.parametrize("opcode", [Opcode.OPEN_FILE_RO, Opcode.CREATE_FILE])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_a_late_open_left_open_is_closed(
    profile: str, opcode: Opcode, autojump: MockClock
) -> None:
    """On a server of several sessions the copy has one of its own, and its answer alone tells which."""
    here = world(profile, f=content(1500))
    async with here.connection() as connection:
        await connection.store.list_directory(path(profile, ""))
        copy = Latecomer(here, opcode, after=Opcode.TERMINATE_SESSION)
        await open_and_leave(connection, profile, opcode)
        assert copy.late is not None
        assert here.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("opcode", [Opcode.OPEN_FILE_RO, Opcode.CREATE_FILE])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_an_open_that_came_twice_at_once_left_open_is_closed(
    profile: str, opcode: Opcode, autojump: MockClock
) -> None:
    """Both answers are there before it is known what was opened."""
    here = world(profile, f=content(1500))
    async with here.connection() as connection:
        server = here.vehicle.server
        handle = server.handle

        def twice(wire: bytes, source: Address, now: float) -> None:
            handle(wire, source, now)
            if wire[3] == opcode:
                server.handle = handle  # type: ignore[method-assign]
                handle(request(0, Opcode.NONE).encode(), source, now)  # no mere replay of the last answer
                handle(wire, source, now)

        server.handle = twice  # type: ignore[method-assign]
        await open_and_leave(connection, profile, opcode)
        assert server.open_sessions == 0


class Held:
    """Keeps a kind of request from the server (`deaf`), until it hands over the last of them, or does so once
    more."""

    def __init__(self, here: World, opcode: Opcode) -> None:
        self.deaf = True
        self.delivered = False
        self._here = here
        self._opcode = opcode
        self._kept: tuple[bytes, Address] | None = None
        self._handle = here.vehicle.server.handle
        here.vehicle.server.handle = self._on_request  # type: ignore[method-assign]

    def deliver(self, now: float) -> None:
        """Have it carried out."""
        assert self._kept is not None
        self._handle(*self._kept, now)
        self._here.link.kick()
        self.delivered = True

    def deliver_behind_the_next(self) -> None:
        """Have it carried out right after the next of its kind, and the later answer come first."""
        server = self._here.vehicle.server
        outgoing = server.outgoing

        def on_request(wire: bytes, source: Address, now: float) -> None:
            self._handle(wire, source, now)
            if wire[3] == self._opcode:
                server.handle = self._handle  # type: ignore[method-assign]
                self.deliver(now)

        held: list[tuple[Address, bytes]] = []

        def swapped(now: float) -> list[tuple[Address, bytes]]:
            found = outgoing(now)
            held.extend(reply for reply in found if reply[1][5] == self._opcode)
            others = [reply for reply in found if reply[1][5] != self._opcode]
            if len(held) < 2:
                return others
            server.outgoing = outgoing  # type: ignore[method-assign]
            return [*others, *held[::-1]]

        server.handle, server.outgoing = on_request, swapped  # type: ignore[method-assign]

    def _on_request(self, wire: bytes, source: Address, now: float) -> None:
        if wire[3] == self._opcode:
            self._kept = (wire, source)
            if self.deaf:
                return
        self._handle(wire, source, now)


@pytest.mark.parametrize("opcode", [Opcode.OPEN_FILE_RO, Opcode.CREATE_FILE])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_an_open_that_was_given_up_left_open_is_closed(
    profile: str, opcode: Opcode, autojump: MockClock
) -> None:
    """It comes when we have made sure that nothing is open; no server but PX4 would close it by itself."""
    here = world(profile, LinkSettings(delay=0.02), f=content(1500))
    async with here.connection(ConnectOptions(op_deadline=2.0)) as connection:
        await connection.store.list_directory(path(profile, ""))
        held = Held(here, opcode)
        with pytest.raises(RequestTimeout):
            await open_and_leave(connection, profile, opcode)
        held.deaf = False
        await trio.sleep(8)
        held.deliver(trio.current_time())
        await trio.sleep(8)
        assert here.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_a_late_open_left_open_as_we_leave_is_closed(profile: str, autojump: MockClock) -> None:
    """It comes when all is said and done, within the time in which such copies are feared."""
    here = world(profile, replace(DOUBLING, reorder=0.0), f=content(1500))
    async with trio.open_nursery() as nursery, here.connection() as connection:
        for _ in range(5):
            await connection.store.list_directory(path(profile, ""))
        assert connection.engine.stats.strays
        await trio.sleep(3)
        here.model.settings = replace(DOUBLING, duplicate=0.0, reorder=0.0)
        held = Held(here, Opcode.OPEN_FILE_RO)
        held.deaf = False
        await read_file(connection, path(profile, "f"))

        async def deliver() -> None:
            await trio.sleep(0.15)
            held.deliver(trio.current_time())

        nursery.start_soon(deliver)
    assert held.delivered
    assert here.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_what_is_being_opened_as_we_leave_is_closed(profile: str, autojump: MockClock) -> None:
    here = world(profile, LinkSettings(delay=0.1), f=content(1500))
    async with here.connection() as connection:
        await read_file(connection, path(profile, "f"))
        await trio.sleep(8)
        with trio.move_on_after(0.05):
            await read_file(connection, path(profile, "f"))
    assert here.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_an_open_that_was_given_up_comes_behind_the_next_and_is_answered_before_it(
    profile: str, autojump: MockClock
) -> None:
    """MAVSDK has the first file open then, under the id that the second was told."""
    one, two = content(1500, 1), content(1500, 2)
    here = world(profile, LinkSettings(delay=0.02), one=one, two=two)
    async with here.connection(ConnectOptions(window=1, op_deadline=2.0)) as connection:
        held = Held(here, Opcode.OPEN_FILE_RO)
        with pytest.raises(RequestTimeout):
            await read_file(connection, path(profile, "one"))
        held.deliver_behind_the_next()
        await read_or_doubt(connection, path(profile, "two"), two)
        await trio.sleep(8)
        assert here.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("nth", [8, 9, 12])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_late_open_of_another_file_while_one_is_read_whole(
    profile: str, nth: int, autojump: MockClock
) -> None:
    one, two = content(6 * 239, 1), content(6 * 239, 2)
    here = world(profile, DOUBLING, one=one)
    here.tree.add(b"/@two", two)
    async with here.connection(ConnectOptions(window=1)) as connection:
        await connection.store.list_directory(path(profile, ""))
        Latecomer(here, Opcode.OPEN_FILE_RO, after=Opcode.READ_FILE, nth=nth, first=True)
        assert await read_file(connection, path(profile, "one")) == one
        if not PROFILES[profile].virtual_trees:  # else there is no such file
            assert await connection.store.read_whole(b"/@two", 10_000) == two


@pytest.mark.parametrize("nth", [2, 20])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_file_that_a_late_create_emptied_in_mid_upload_is_compared(
    profile: str, nth: int, autojump: MockClock
) -> None:
    """MAVSDK writes on at the offsets it is told, so that the size is right and zeros come first."""
    here = world(profile, DOUBLING)
    data = content(6000)
    async with here.connection(ConnectOptions(window=1)) as connection:
        tree = writable_tree(connection, verify="size")
        await tree.list(path(profile, "")[:-1])
        copy = Latecomer(here, Opcode.CREATE_FILE, after=Opcode.WRITE_FILE, nth=nth)
        file = await tree.create(path(profile, "new"), exclusive=True)
        await file.write(0, data)
        await file.release()
        file.close()
        assert copy.late is not None
    assert here.tree.data(path(profile, "new")) == data


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_late_reads_are_not_taken_for_a_full_card(profile: str, autojump: MockClock) -> None:
    """MAVSDK closes what is written when a ReadFile comes, and refuses as where the card is full."""
    here = world(profile, DOUBLING, f=content(1500))
    async with here.connection() as connection:
        await connection.store.list_directory(path(profile, ""))
        copies = [Latecomer(here, Opcode.READ_FILE, after=Opcode.CREATE_FILE, nth=nth) for nth in (1, 2)]
        await read_file(connection, path(profile, "f"))
        await put(connection, path(profile, "new"), content(3000, 5))
        assert copies[0].late is not None
    assert here.tree.data(path(profile, "new")) == content(3000, 5)


SOON = [0.02, 0.1, 0.2]
"""Seconds after which a request comes once more; a round trip takes 4 ms."""


@pytest.mark.parametrize("late", SOON)
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_directory_that_was_removed_does_not_come_back(
    profile: str, late: float, autojump: MockClock
) -> None:
    here = world(profile, replace(DOUBLING, delay=0.002, duplicate=1.0))
    async with trio.open_nursery() as nursery, here.connection() as connection:
        await connection.store.list_directory(path(profile, ""))
        double(here, Opcode.CREATE_DIRECTORY, late, nursery.start_soon)
        await connection.store.make_directory(path(profile, "new"))
        await connection.store.remove_directory(path(profile, "new"))
        await trio.sleep(1)
    assert b"new" not in {entry.name for entry in here.tree.entries(path(profile, "")[:-1])}


KEEPING = ["px4", "px4-2026", "spec", "ardupilot", "ardupilot5", "littlefs"]
"""Servers whose OpenFileWO empties nothing."""


@pytest.mark.parametrize("late", SOON)
@pytest.mark.parametrize("profile", taking_turns(KEEPING))
async def test_a_file_is_not_emptied_again_after_it_was_written(
    profile: str, late: float, autojump: MockClock
) -> None:
    here = world(profile, replace(DOUBLING, delay=0.002, duplicate=1.0), f=content(100))
    async with trio.open_nursery() as nursery, here.connection() as connection:
        connection.store.traits.wo_truncates = False
        await connection.store.list_directory(path(profile, ""))
        double(here, Opcode.CREATE_FILE, late, nursery.start_soon)
        await connection.store.create_empty(path(profile, "f"))
        await append(connection, path(profile, "f"), b"hello", 0)
        await trio.sleep(1)
    assert here.tree.data(path(profile, "f")) == b"hello"


@pytest.mark.parametrize("late", SOON)
@pytest.mark.parametrize("profile", ["px4", "px4-2026", "spec"])
async def test_a_file_is_not_cut_again_after_it_was_appended_to(
    profile: str, late: float, autojump: MockClock
) -> None:
    here = world(profile, replace(DOUBLING, delay=0.002, duplicate=1.0), f=content(1000))
    async with trio.open_nursery() as nursery, here.connection() as connection:
        connection.store.traits.wo_truncates = False
        await connection.store.list_directory(path(profile, ""))
        double(here, Opcode.TRUNCATE_FILE, late, nursery.start_soon)
        await connection.store.truncate(path(profile, "f"), 500)
        await append(connection, path(profile, "f"), b"hello", 500)
        await trio.sleep(1)
    assert here.tree.data(path(profile, "f")) == content(1000)[:500] + b"hello"
