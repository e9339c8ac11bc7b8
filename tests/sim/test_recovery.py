"""What is done when the server's session is taken, lost or somebody else's. Virtual time."""

from __future__ import annotations

import random
from collections.abc import Callable
from itertools import pairwise

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode, decode_request, request
from mavftpfs.session.connection import Connection
from mavftpfs.session.reader import REOPENS, STALL
from mavftpfs.session.serversession import SILENCE_ARDUPILOT
from mavftpfs.session.store import TIME_PROBE_LIMIT
from mavftpfs.shared.errors import FileChanged, MavftpfsError, SessionBusy, SessionLost
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.worlds import MemorySink, World, begin_to_read, path, read_file, world

RIVAL = Address(255, 190)
RIVALS_SESSION = 77
LINK = LinkSettings(delay=0.02)
SLOW = LinkSettings(rate=20_000.0, delay=0.02)
DATA = random.Random(1).randbytes(60_000)
OTHER = random.Random(2).randbytes(60_000)

EVERY_PROFILE = sorted(PROFILES)
CHECK_PERIOD = STALL / 2
"""How often a reading looks whether it stalled."""


class Log:
    """When the server was asked what by us, and what it should do after that."""

    def __init__(self, here: World, *, after: Callable[[int], None] = lambda opcode: None) -> None:
        self.asked: list[tuple[float, int]] = []
        self._handle = here.vehicle.server.handle
        self._after = after
        here.vehicle.server.handle = self._take  # type: ignore[method-assign]

    def _take(self, wire: bytes, source: Address, now: float) -> None:
        self._handle(wire, source, now)
        if source.system == 254:
            opcode = decode_request(wire).opcode
            self.asked.append((now, opcode))
            self._after(opcode)

    def count(self, opcode: Opcode) -> int:
        return sum(asked == opcode for _, asked in self.asked)

    def last(self, opcode: Opcode) -> float:
        return max(now for now, asked in self.asked if asked == opcode)

    @property
    def silences(self) -> list[float]:
        return [later - earlier for (earlier, _), (later, _) in pairwise(self.asked)]


def rival_asks(here: World, opcode: Opcode, data: bytes = b"", *, seq: int, heard: bool = True) -> None:
    """Let another client of the vehicle ask something, so that we hear it on our link or not."""
    session = 0 if here.profile.startswith("px4") and opcode != Opcode.OPEN_FILE_RO else RIVALS_SESSION
    wire = request(seq, opcode, session=session, size=100 if not data else len(data), data=data).encode()
    now = trio.current_time()
    if heard:
        here.vehicle.foreign_request(wire, RIVAL, now)
    else:
        here.vehicle.server.handle(wire, RIVAL, now)
    here.link.kick()


# --- a session that is taken


@pytest.mark.holds("fault stale session", "rule 14.10")
async def test_a_killed_clients_session_is_got_over_by_saying_nothing(autojump: MockClock) -> None:
    """ArduPilot gives a session away after 3 s in which it answered nobody, with a refusal neither."""
    here = world("ardupilot", LINK, f=DATA, stale=OTHER)
    async with here.connection() as connection, trio.open_nursery() as nursery:
        rival_asks(here, Opcode.OPEN_FILE_RO, path("ardupilot", "stale"), seq=5, heard=False)
        await trio.sleep(0.1)
        assert here.vehicle.server.open_sessions == 1
        log = Log(here)

        async def list_often() -> None:
            while True:
                await connection.store.list_directory(path("ardupilot", "")[:-1])
                await trio.sleep(0.3)

        nursery.start_soon(_tolerate_refusals, list_often)
        assert await read_file(connection, path("ardupilot", "f")) == DATA
        nursery.cancel_scope.cancel()
    assert connection.scheduler.server.quiet_periods <= 2  # the listings' and the file's, at the same time
    assert connection.scheduler.server.resets == 0
    assert sum(silence > SILENCE_ARDUPILOT - 0.1 for silence in log.silences) == 1
    assert log.count(Opcode.OPEN_FILE_RO) == 2


async def _tolerate_refusals(work: Callable[[], object]) -> None:
    """A listing is refused, too, while another id has the session."""
    while True:
        try:
            await work()  # type: ignore[misc]
        except MavftpfsError:
            await trio.sleep(0.3)


@pytest.mark.holds("promise 6", "rule 14.39")
@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_another_clients_session_is_left_alone(profile: str, autojump: MockClock) -> None:
    """Whoever is heard is alive: no ResetSessions, no Terminate, and its file stays open (promise 6)."""
    here = world(profile, LINK, f=DATA, theirs=OTHER)
    async with here.connection() as connection, trio.open_nursery() as nursery:
        log = Log(here)
        rival_asks(here, Opcode.OPEN_FILE_RO, path(profile, "theirs"), seq=5)

        async def rival_reads() -> None:
            for seq in range(100, 2000, 2):
                await trio.sleep(1.0)
                rival_asks(here, Opcode.READ_FILE, seq=seq)

        nursery.start_soon(rival_reads)
        await trio.sleep(2.0)
        with pytest.raises(SessionBusy):
            await read_file(connection, path(profile, "f"))
        await trio.sleep(3.0)
        assert here.vehicle.server.open_paths == [path(profile, "theirs")]
        assert log.count(Opcode.RESET_SESSIONS) == log.count(Opcode.TERMINATE_SESSION) == 0
        assert connection.scheduler.server.quiet_periods == 2
        nursery.cancel_scope.cancel()


# --- a session that is lost


@pytest.mark.holds("rule 14.9")
@pytest.mark.parametrize("outage", [3.2, 3.5, 4.0, 6.0, 9.0])
async def test_after_a_silence_nothing_is_believed_before_the_file_was_opened_again(
    outage: float, autojump: MockClock
) -> None:
    """Meanwhile the session of a PX4, which all share, may have become another client's."""
    here = world("px4", SLOW, f=DATA, theirs=OTHER)
    async with here.connection() as connection:
        log = Log(here)
        _, sink = await begin_to_read(connection, path("px4", "f"), 10_000)
        here.link.cut()
        await trio.sleep(0.2)
        rival_asks(here, Opcode.TERMINATE_SESSION, seq=5, heard=False)
        rival_asks(here, Opcode.OPEN_FILE_RO, path("px4", "theirs"), seq=7, heard=False)
        assert here.vehicle.server.open_paths == [path("px4", "theirs")]
        assert outage > STALL + CHECK_PERIOD
        await trio.sleep(outage)
        here.link.restore()
        assert await sink.wait_for(0, len(DATA)) == DATA
        assert log.count(Opcode.OPEN_FILE_RO) == 2


@pytest.mark.holds("fault idle close")
async def test_a_session_that_is_lost_each_time_is_an_error_in_the_end(autojump: MockClock) -> None:
    here = world("px4", LINK, f=DATA)

    def close_at_once(opcode: int) -> None:
        if opcode == Opcode.OPEN_FILE_RO:
            rival_asks(here, Opcode.TERMINATE_SESSION, seq=60_000 + len(log.asked), heard=False)

    async with here.connection() as connection:
        log = Log(here, after=close_at_once)
        with trio.fail_after(100), pytest.raises(SessionLost):
            await read_file(connection, path("px4", "f"))
        assert log.count(Opcode.OPEN_FILE_RO) == 1 + REOPENS


@pytest.mark.holds("promise 5", "fault idle close")
@pytest.mark.parametrize(("profile", "outage"), [("px4", 12.0), ("ardupilot5", 23.0)])
async def test_a_server_that_closed_an_idle_session_during_an_outage(
    profile: str, outage: float, autojump: MockClock
) -> None:
    here = world(profile, SLOW, f=DATA)
    async with here.connection() as connection:
        log = Log(here)
        _, sink = await begin_to_read(connection, path(profile, "f"), 10_000)
        here.link.cut()
        await trio.sleep(outage)
        here.link.kick()
        await trio.sleep(0.01)
        assert here.vehicle.server.open_sessions == 0
        here.link.restore()
        assert await sink.wait_for(0, len(DATA)) == DATA
        assert sink.suspicions == []
        assert log.count(Opcode.OPEN_FILE_RO) == 2


@pytest.mark.holds("rule 14.12")
@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_a_session_is_closed_within_two_seconds_of_its_last_use(
    profile: str, autojump: MockClock
) -> None:
    here = world(profile, LINK, f=DATA)
    async with here.connection() as connection:
        log = Log(here)
        sink = MemorySink(len(DATA))
        reader = await connection.store.open_reader(path(profile, "f"), sink)
        for offset in (0, 20_000):
            reader.want(offset, offset + 1000, demand=True)
            await sink.wait_for(offset, offset + 1000)
            await trio.sleep(1.0)
        assert log.count(Opcode.TERMINATE_SESSION) == 0
        await trio.sleep(5.0)
        assert log.last(Opcode.TERMINATE_SESSION) - log.last(Opcode.READ_FILE) < 2.0
        assert here.vehicle.server.open_sessions == 0
        reader.want(40_000, 41_000, demand=True)
        assert await sink.wait_for(40_000, 41_000) == DATA[40_000:41_000]
        assert log.count(Opcode.OPEN_FILE_RO) == 2


@pytest.mark.holds("fault growing file")
@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_a_file_that_shrank_while_it_was_closed_is_another_one(
    profile: str, autojump: MockClock
) -> None:
    here = world(profile, LINK, f=DATA)
    async with here.connection() as connection:
        sink = MemorySink(len(DATA))
        reader = await connection.store.open_reader(path(profile, "f"), sink)
        reader.want(0, 1000, demand=True)
        await sink.wait_for(0, 1000)
        await trio.sleep(5.0)
        here.tree.add(path(profile, "f"), OTHER[:50_000])
        reader.want(20_000, 21_000, demand=True)
        with pytest.raises(FileChanged):
            await sink.wait_for(20_000, 21_000)
        assert sink.have.total == 1000
        await trio.sleep(5.0)
        assert here.vehicle.server.open_sessions == 0


# --- silence as an answer


@pytest.mark.holds("rule 14.31")
async def test_two_silences_prove_that_listings_show_no_times(autojump: MockClock) -> None:
    """One may be loss; MAVSDK's old server never answers an opcode that it does not know."""
    here = world("mavsdk-old", LINK, f=DATA)
    async with here.connection() as connection:
        log = Log(here)
        for known in (None, False, False):
            assert await _listed(connection) == [b"f"]
            assert connection.store.lists_times is known
        asked = [opcode for _, opcode in log.asked]
        assert asked[-1] == Opcode.LIST_DIRECTORY
        times = [now for now, opcode in log.asked if opcode == Opcode.LIST_DIRECTORY_WITH_TIME]
        plain = [now for now, opcode in log.asked if opcode == Opcode.LIST_DIRECTORY]
        assert times[-1] < plain[-3]
        assert plain[-1] - plain[0] < 2 * TIME_PROBE_LIMIT


@pytest.mark.holds("rule 14.31")
async def test_an_answer_after_one_silence_is_taken(autojump: MockClock) -> None:
    here = world("ardupilot5", LINK, f=DATA)
    async with here.connection() as connection:
        here.link.cut()
        with trio.CancelScope() as scope:
            async with trio.open_nursery() as nursery:
                nursery.start_soon(_listed, connection)
                await trio.sleep(TIME_PROBE_LIMIT)
                here.link.restore()
        assert not scope.cancelled_caught
        assert connection.store.lists_times is None
        assert await _listed(connection) == [b"f"]
        assert connection.store.lists_times is True


async def _listed(connection: Connection) -> list[bytes]:
    return [entry.name for entry in (await connection.store.list_directory(b"/d")).entries]
