"""The engine against every simulated server over a modelled link, on virtual time."""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.burst import BurstTransfer
from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.operations import ListDirectory, OpenRequest, Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.protocol.reading import ReadToEof, ReadTransfer
from mavftpfs.shared.errors import FtpNak, SessionLost
from mavftpfs.sim.linkmodel import Direction, LinkSettings
from mavftpfs.sim.profiles import PROFILES, Family
from mavftpfs.sim.tree import MemoryTree
from mavftpfs.sim.vehicle import FtpServer
from tests.support.takingturns import taking_turns
from tests.support.virtual import MemorySink, VirtualLink

CHUNK = 239
BAD = LinkSettings(delay=0.02, loss=0.2, duplicate=0.02, reorder=0.05)
SIZES = (0, 1, 5, 238, 239, 240, 478, 4096, 35_850, 40_152, 119_500, 131_073)
NAMES = taking_turns(sorted(PROFILES))
KINDS = [ReadTransfer, BurstTransfer]


class Rig:
    """One server with its tree, and an engine over a link to it."""

    def __init__(self, profile: str, settings: LinkSettings | None = None, *, seed: int = 1) -> None:
        self.tree = MemoryTree()
        self.profile = PROFILES[profile]
        self.server = FtpServer(self.tree, self.profile, rng=random.Random(seed))
        self.link = VirtualLink(self.server, settings, seed=seed)
        if settings is not None and settings.rate is not None:
            self.server.firmware.tx_room = lambda: self.link.model.room(Direction.TO_CLIENT)
        self.session = 0

    @property
    def is_ardupilot(self) -> bool:
        return self.profile.family is Family.ARDUPILOT

    def open(self, path: bytes) -> int:
        """Open a file, insisting: a lost ACK leaves it open over there (servers.md 14.10)."""
        engine = self.link.engine
        for _ in range(10):
            op = OpenRequest(Opcode.OPEN_FILE_RO, path, session=engine.home_session)
            self.link.run(op)
            if op.error is None:
                self.session = engine.session = op.session
                assert op.size is not None
                return op.size
            assert isinstance(op.error, FtpNak), op.error
            assert op.error.retransmitted, op.error
            self.link.run(
                Simple(Opcode.TERMINATE_SESSION, session=engine.home_session if self.is_ardupilot else 0)
            )
        raise AssertionError("never opened")

    def close(self) -> None:
        op = Simple(Opcode.TERMINATE_SESSION, session=self.session)
        self.link.run(op)
        if isinstance(op.error, FtpNak):  # sticky EEXIST, or a repeated Terminate
            assert op.error.retransmitted or op.error.code == NakCode.INVALID_SESSION
        else:
            assert op.error is None, op.error
        self.link.engine.session = self.link.engine.home_session

    def start(
        self, path: bytes, kind: type[ReadTransfer] = ReadTransfer, chunk: int = CHUNK
    ) -> tuple[ReadTransfer, MemorySink]:
        """Open a file, and return a transfer that wants nothing yet, and where its bytes go."""
        size = self.open(path)
        sink = MemorySink(size)
        transfer = kind(self.session, size, sink, ChunkSize(chunk))
        self.link.engine.start(transfer, self.link.now)
        return transfer, sink

    def read(self, path: bytes, kind: type[ReadTransfer], *, chunk: int = CHUNK) -> bytes:
        transfer, sink = self.start(path, kind, chunk)
        size = transfer.size
        transfer.want(0, size, True)
        self.link.run_until(lambda: transfer.idle or transfer.done, 3600.0)
        assert transfer.error is None, transfer.error
        self.link.engine.drop(transfer)
        self.close()
        assert sink.held.covers(0, size)
        return bytes(sink.data)

    def nothing_is_open(self) -> bool:
        """Whether another client can open a file at once."""
        self.link.model.settings = LinkSettings()
        engine = self.link.engine
        op = OpenRequest(Opcode.OPEN_FILE_RO, b"/big", session=(engine.home_session % 200) + 1)
        self.link.run(op)
        if op.error is None:
            self.link.run(Simple(Opcode.TERMINATE_SESSION, session=op.session))
        return op.error is None


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_every_size_comes_whole(name: str, kind: type[ReadTransfer]) -> None:
    rig = Rig(name, LinkSettings(delay=0.005))
    for size in SIZES:
        rig.tree.add(b"/s%d" % size, random.Random(size).randbytes(size))
    for size in SIZES:
        assert rig.read(b"/s%d" % size, kind) == random.Random(size).randbytes(size)


@pytest.mark.holds("fault lost")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_a_megabyte_over_a_bad_link(name: str, kind: type[ReadTransfer]) -> None:
    size = 1_000_000
    content = random.Random(5).randbytes(size)
    rig = Rig(name, BAD)
    rig.tree.add(b"/big", content)
    assert rig.read(b"/big", kind) == content
    stats = rig.link.engine.stats
    asked = stats.by_opcode.get(Opcode.READ_FILE, 0) + stats.by_opcode.get(Opcode.BURST_READ_FILE, 0)
    assert asked <= 1.5 * (-(-size // CHUNK)) / (1 - BAD.loss) ** 2
    assert rig.nothing_is_open()


def test_a_card_that_pauses_is_not_asked_twice_over_usb() -> None:
    """What goes out in a pause, as if it were over already, only overflows the buffer of a server so near."""
    rig = Rig("px4-nuttx", LinkSettings(delay=0.001))
    content = random.Random(5).randbytes(4_000_000)
    rig.tree.add(b"/big", content)
    assert rig.read(b"/big", ReadTransfer) == content
    asked = rig.link.engine.stats.by_opcode[Opcode.READ_FILE]
    assert asked <= 1.25 * (-(-len(content) // CHUNK))


@pytest.mark.parametrize("name", NAMES)
def test_listings_over_a_bad_link(name: str) -> None:
    rig = Rig(name, BAD)
    names = {b"file %03d.bin" % index for index in range(150)}
    for each in sorted(names):
        rig.tree.add(b"/d/" + each, b"x" * int(each[5:8]))
    rig.tree.add_directory(b"/d/sub")
    op = ListDirectory(b"/d")
    rig.link.run(op)
    assert op.error is None
    assert op.complete
    found = {entry.name: entry for entry in op.entries}
    assert set(found) == names | {b"sub"}
    assert all(found[each].size == int(each[5:8]) for each in names)


@pytest.mark.parametrize("name", NAMES)
def test_reading_to_eof_over_a_bad_link(name: str) -> None:
    """Where a read may cross the end, the bytes are right; where it may not (MAVSDK), that is an error."""
    content = random.Random(9).randbytes(10_000)
    rig = Rig(name, BAD)
    rig.tree.add(b"/f", content)
    rig.open(b"/f")
    op = ReadToEof(rig.session, CHUNK, 20_000)
    rig.link.run(op)
    if rig.profile.family is Family.MAVSDK:
        assert isinstance(op.error, SessionLost)
    else:
        assert op.error is None
        assert op.data == content


def spend(link: VirtualLink, seconds: float) -> None:
    """Let time pass while something is under way."""
    end = link.now + seconds
    link.run_until(lambda: link.now >= end, seconds + 10.0)


def test_a_slow_link_that_becomes_fast_is_used() -> None:
    """The pace of a radio is kept while that is the way; then the cable is plugged in."""
    rig = Rig("px4", LinkSettings(rate=5760.0, queue=4096, delay=0.05))
    data = random.Random(3).randbytes(4_000_000)
    rig.tree.add(b"/f", data)
    link, size = rig.link, rig.open(b"/f")
    transfer = ReadTransfer(rig.session, size, MemorySink(size))
    link.engine.start(transfer, link.now)
    transfer.want(0, size, True)
    for rate in (100_000.0, 5760.0):
        spend(link, 15.0)
        link.model.settings = LinkSettings(rate=rate, queue=16_384, delay=0.01)
        spend(link, 5.0)
        before = transfer.received_bytes
        spend(link, 5.0)
        assert transfer.received_bytes - before > 0.8 * 5.0 * rate * CHUNK / 266
