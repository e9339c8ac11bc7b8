"""The wait of a cold `ls` or small read during a bulk copy, on virtual time (docs/benchmarks.md, promise 7).

p95 <= 3 round trips + 0.3 s + bytes asked for / rate beside a download, and one round trip more beside an
upload, because the upload waits for its last ACK before it closes its file. For every server, on links of
every kind.
"""

from __future__ import annotations

import random

import pytest
import trio

from mavftpfs.session.connection import Connection
from mavftpfs.sim.ardupilot import LATENCY
from mavftpfs.sim.linkmodel import Duplex, LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.rigs import Rig
from tests.support.takingturns import ALIKE
from tests.support.transfers import ROOTS, MemorySink, MemorySource, content, read_file

SAMPLES = 20
FEWER = 10
"""On links that carry so much that twenty take long: all but one of them are held to the bound, too."""

BEFORE = 3.0
"""Seconds that the copy has been under way when the first of them comes."""

FRAME = 266
SMALL_FRAME = 40
RADIO = LinkSettings(rate=5760.0, delay=0.03, duplex=Duplex.HALF, queue=8192)
NEAR = LinkSettings(rate=100_000.0, delay=0.015, queue=50_000)
SLOW = LinkSettings(rate=100_000.0, delay=0.05, queue=50_000)
FAST = LinkSettings(rate=250_000.0, delay=0.015, queue=125_000)
FAR_RADIO = LinkSettings(rate=5760.0, delay=0.15, queue=8192)
FAR = LinkSettings(rate=100_000.0, delay=0.15, queue=50_000)
KEEPING = [name for name in sorted(PROFILES) if not PROFILES[name].write_only_truncates]
"""Where an upload can be interrupted: else it keeps the session to its end (servers.md 8)."""
SHORT_QUEUES = ["ardupilot", "ardupilot5", "littlefs"]


class Copy:
    """A bulk copy under way; how long others wait beside it."""

    def __init__(
        self,
        profile: str,
        link: LinkSettings,
        *,
        samples: int = SAMPLES,
        serial: bool = False,
    ) -> None:
        """samples: how many others come. serial: on a serial port."""
        assert link.rate is not None
        self.samples = samples
        self.link = link
        self.rate = link.rate
        self.rig = Rig(profile, link=link, serial=serial)
        self.keeps = not PROFILES[profile].write_only_truncates
        self.root = ROOTS.get(profile, b"") + b"/d"
        self.size = int((samples * 1.7 + BEFORE) * link.rate)
        self.data = content(self.size, 2)  # zeros would not be sent
        self.rig.card.add(self.root + b"/big", self.data)
        for number in range(samples):
            self.rig.card.add(self.root + b"/fresh%d/f" % number, b"%d" % number * 100)
        self.rng = random.Random(5)

    def allowed(self, way: str, frames: int, *, working: float = 0.0) -> float:
        """Return the bound for something that takes so many full frames; a small one takes time both ways.

        working: seconds that an idle server takes to answer, where they are to be part of a round trip.
        """
        round_trip = 2 * (self.link.delay + SMALL_FRAME / self.rate) + working
        return ROUND_TRIPS[way] * round_trip + 0.3 + frames * FRAME / self.rate

    async def waits(self, connection: Connection, kind: str) -> list[float]:
        sink = MemorySink(self.size)
        reader = await connection.store.open_reader(self.root + b"/big", sink)
        reader.want(0, self.size, demand=True)
        for _ in range(2):  # finds out how this server lists
            await connection.store.list_directory(self.root)
        await trio.sleep(BEFORE)
        waits = await self._sample(connection, kind)
        copied = sink.have.total
        await trio.sleep(2.0)
        assert sink.have.total > copied, "the copy goes on"
        assert all(sink.data[start:stop] == self.data[start:stop] for start, stop in sink.have)
        reader.close()
        return waits

    async def waits_beside_upload(self, connection: Connection, kind: str) -> list[float]:
        connection.store.traits.wo_truncates = not self.keeps  # as the probe found out
        source = MemorySource(self.data)
        target = self.root + b"/new"
        upload = connection.store.open_upload(target, source)
        upload.wake()
        for _ in range(2):
            await connection.store.list_directory(self.root)
        await trio.sleep(BEFORE)
        waits = await self._sample(connection, kind)
        acked = source.acked.total + source.proven.total
        await trio.sleep(2.0)
        assert source.acked.total + source.proven.total > acked, "the upload goes on"
        there = self.rig.card.data(target)
        assert all(there[start:stop] == self.data[start:stop] for start, stop in source.proven)
        await upload.end()
        return waits

    async def _sample(self, connection: Connection, kind: str) -> list[float]:
        waits: list[float] = []
        for number in range(self.samples):
            await trio.sleep(self.rng.uniform(0.2, 0.8))
            directory = self.root + b"/fresh%d" % number
            began = trio.current_time()
            if kind == "ls":
                listing = await connection.store.list_directory(directory)
                assert [entry.name for entry in listing.entries] == [b"f"]
            else:
                assert await read_file(connection, directory + b"/f") == b"%d" % number * 100
            waits.append(trio.current_time() - began)
        return sorted(waits)


def p95(waits: list[float]) -> float:
    return waits[len(waits) * 95 // 100 - 1]


LINKS = {
    "radio": RADIO,
    "far radio": FAR_RADIO,
    "near": NEAR,
    "slow": SLOW,
    "fast": FAST,
    "far": FAR,
}
ROUND_TRIPS = {"download": 3, "upload": 4}
"""Round trips of the bound, by the way that the copy goes."""

FRAMES = {"ls": 3, "read": 3}
"""The actions beside the copy, and how many full frames each takes."""

DOWNLOADS = [
    *((profile, "radio", what) for profile in sorted(PROFILES) for what in FRAMES),
    ("px4-nuttx", "slow", "ls"),
    ("px4-nuttx", "near", "read"),  # interrupted so often, the copy must not pass for a light user
    ("px4", "fast", "ls"),
    *((profile, "far", "read") for profile in ("px4", "px4-nuttx", *SHORT_QUEUES)),
    *((profile, "far", "ls") for profile in SHORT_QUEUES),
]
UPLOADS = [
    (profile, link, what)
    for profile in KEEPING
    for link, what in (
        *(("radio", "ls"), ("radio", "read"), ("slow", "read"), ("far", "ls")),
        *(("far", "read"), ("far radio", "read")),
    )
]
MUCH = (
    *(("px4", "fast", "ls"), ("px4", "far", "ls"), ("px4", "far", "read"), ("px4", "slow", "read")),
    ("px4-nuttx", "far", "ls"),
)
"""Of these many bytes are copied: they are left to the soak."""

CASES = [
    pytest.param(*case, way, marks=pytest.mark.soak if case[0] in ALIKE or case in MUCH else ())
    for cases, way in ((DOWNLOADS, "download"), (UPLOADS, "upload"))
    for case in cases
]


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize(("profile", "link", "what", "way"), CASES)
async def test_nobody_waits_long_beside_a_copy(way: str, what: str, profile: str, link: str) -> None:
    copy = Copy(profile, LINKS[link], samples=SAMPLES if "radio" in link else FEWER)
    async with copy.rig.connected() as connection:
        waits = await (copy.waits if way == "download" else copy.waits_beside_upload)(connection, what)
    working = LATENCY if link.startswith("far") and profile in SHORT_QUEUES else 0.0
    assert p95(waits) <= copy.allowed(way, FRAMES[what], working=working)


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize(("link", "what"), [("radio", "ls"), ("far radio", "read")])
@pytest.mark.parametrize("way", ["download", "upload"])
async def test_nobody_waits_long_at_a_serial_port(way: str, what: str, link: str) -> None:
    copy = Copy("px4-nuttx", LINKS[link], samples=SAMPLES if link == "radio" else 40, serial=True)
    async with copy.rig.connected() as connection:
        waits = await (copy.waits if way == "download" else copy.waits_beside_upload)(connection, what)
    assert p95(waits) <= copy.allowed(way, FRAMES[what])


@pytest.mark.holds("promise 7")
@pytest.mark.parametrize(("profile", "link"), [("px4-nuttx", FAR), ("ardupilot", SLOW)])
async def test_an_upload_goes_on_beside_endless_small_reads(profile: str, link: LinkSettings) -> None:
    """Three readers never pause, so that one of low usage always waits. The upload once sent nothing."""
    copy = Copy(profile, link)
    root = copy.root
    async with copy.rig.connected() as connection, trio.open_nursery() as nursery:
        connection.store.traits.wo_truncates = False
        source = MemorySource(copy.data)
        upload = connection.store.open_upload(root + b"/new", source)
        upload.wake()

        async def read_for_ever() -> None:
            number = 0
            while True:
                path = root + b"/fresh%d/f" % (number % SAMPLES)
                assert await read_file(connection, path) == b"%d" % (number % SAMPLES) * 100
                number += 1

        for _ in range(3):
            nursery.start_soon(read_for_ever)
        await trio.sleep(20)
        for _ in range(2):
            before = source.proven.total
            await trio.sleep(20)
            assert source.proven.total > before
        nursery.cancel_scope.cancel()
    there = copy.rig.card.data(root + b"/new")
    assert all(there[start:stop] == copy.data[start:stop] for start, stop in source.proven)
