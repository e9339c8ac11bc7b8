"""Properties of codec, listings, extents and engine, for all inputs hypothesis can think of."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mavftpfs.link.messages import Address
from mavftpfs.protocol.burst import BurstTransfer
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.operations import ListDirectory, OpenRequest, Simple, parse_page
from mavftpfs.protocol.payload import (
    MAX_DATA,
    PAYLOAD_SIZE,
    Opcode,
    Payload,
)
from mavftpfs.protocol.reading import ReadToEof, ReadTransfer
from mavftpfs.protocol.requests import Operation
from mavftpfs.shared.errors import MavftpfsError, RemoteProtocolError
from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.model import usable_name
from mavftpfs.sim.linkmodel import Direction, LinkModel, LinkSettings
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import MemoryTree
from mavftpfs.sim.vehicle import FtpServer
from tests.support.replies import decode_reply, sent
from tests.support.transfers import MemorySink

BYTE = st.integers(0, 255)
PAYLOADS = st.builds(
    Payload,
    seq=st.integers(0, 65535),
    session=BYTE,
    opcode=BYTE | st.sampled_from([128, 129]),
    size=st.integers(0, MAX_DATA),
    req_opcode=BYTE | st.sampled_from(list(Opcode)),
    burst_complete=BYTE,
    offset=st.integers(0, 2**32 - 1) | st.integers(0, 40).map(lambda index: index * MAX_DATA),
    data=st.binary(max_size=MAX_DATA),
)


# --- codec, checksum, listings, extents


@given(st.binary(max_size=300) | st.binary(min_size=PAYLOAD_SIZE, max_size=PAYLOAD_SIZE))
def test_any_bytes_decode_or_are_the_peers_fault(wire: bytes) -> None:
    try:
        reply = decode_reply(wire)
    except RemoteProtocolError:
        assert len(wire) != PAYLOAD_SIZE or wire[4] > MAX_DATA
    else:
        assert len(reply.data) == reply.size
        assert reply.data == wire[12 : 12 + reply.size]


@given(
    st.binary(max_size=MAX_DATA)
    | st.lists(st.sampled_from([b"F", b"D", b"S", b"a", b"\0", b"\t", b"7", b"/"])).map(b"".join),
    st.booleans(),
)
@example(b"Fx\t" + b"9" * 30 + b"\0", False)
def test_the_listing_parser_is_total(data: bytes, with_time: bool) -> None:
    page = parse_page(data, with_time=with_time)
    assert page.strings == sum(1 for text in data.split(b"\0") if text)
    assert len(page.entries) <= page.strings
    for entry in page.entries:
        assert usable_name(entry.name)
        assert entry.size >= 0


RANGES = st.tuples(st.integers(0, 60), st.integers(0, 60))


@given(st.lists(st.tuples(st.sampled_from(["add", "discard"]), RANGES)), RANGES)
def test_an_extent_set_is_a_set_of_ints(
    steps: list[tuple[str, tuple[int, int]]], probe: tuple[int, int]
) -> None:
    extents, model = ExtentSet(), set[int]()
    for action, (start, stop) in steps:
        if action == "add":
            extents.add(start, stop)
            model |= set(range(start, stop))
        else:
            extents.discard(start, stop)
            model -= set(range(start, stop))
    assert {each for start, stop in extents for each in range(start, stop)} == model
    assert extents.total == len(model)
    assert extents.empty == (not model)
    assert extents.end == max(model, default=-1) + 1
    wanted = set(range(*probe))
    assert extents.covers(*probe) == (wanted <= model)
    assert {each for part in extents.missing(*probe) for each in range(*part)} == wanted - model
    assert {each for part in extents.intersection(*probe) for each in range(*part)} == wanted & model
    bounds = [edge for extent in extents for edge in extent]
    assert bounds == sorted(set(bounds)), "extents are disjoint, apart, in order and not empty"


# --- the engine and whatever comes in

CONTENT = random.Random(3).randbytes(MAX_DATA * 9 + 50)


def busy_engine(seed: int, kind: type[ReadTransfer]) -> tuple[Engine, list[Operation], MemorySink]:
    engine = Engine(random.Random(seed), Flow(limit=12))
    sink = MemorySink(len(CONTENT))
    transfer = kind(0, len(CONTENT), sink)
    operations = [
        transfer,
        OpenRequest(Opcode.OPEN_FILE_RO, b"/f", session=7),
        ListDirectory(b"/d"),
        Simple(Opcode.TERMINATE_SESSION, session=3),
        Simple(Opcode.CALC_FILE_CRC32, b"/f"),
        ReadToEof(0, 100, 100_000),
    ]
    for operation in operations:
        engine.start(operation, 0.0)
    transfer.want(0, len(CONTENT), True)
    return engine, operations, sink


@pytest.mark.holds("promise 10")
@settings(max_examples=200, deadline=None)
@given(
    st.integers(0, 2**32),
    st.sampled_from([ReadTransfer, BurstTransfer]),
    st.lists(st.tuples(PAYLOADS, st.integers(-3, 20), st.floats(0, 3, allow_nan=False)), max_size=60),
)
def test_receive_never_raises(
    seed: int, kind: type[ReadTransfer], replies: list[tuple[Payload, int, float]]
) -> None:
    engine, operations, sink = busy_engine(seed, kind)
    now, newest = 0.0, 0
    for reply, ahead, pause in replies:
        for request in sent(engine, now):
            newest = request.seq
        now += pause
        engine.receive(reply._replace(seq=(newest + ahead) & 0xFFFF), now)
        deadline = engine.next_deadline()
        if deadline is not None and deadline <= now:
            engine.on_deadline(now)
        assert 0 <= engine.in_flight <= 40
        assert 1 <= engine.flow.window <= 12
    for operation in operations:
        assert operation.error is None or isinstance(operation.error, MavftpfsError)
    assert sink.have.end <= len(CONTENT)


# --- the engine and every server over a hostile link

FIELDS = ("seq", "session", "opcode", "req_opcode", "burst_complete", "offset")


CLIENT = Address(254, 191)
MAX_STEPS = 2_000_000


class Way:
    """An engine, a bad link and a server, on virtual time.

    spoil: of so many of the replies header fields are changed, as by a foreign or broken server.
    """

    def __init__(self, server: FtpServer, settings: LinkSettings, seed: int) -> None:
        self.server = server
        self.rng = random.Random(seed)
        self.model = LinkModel(random.Random(seed + 1), settings)
        self.engine = Engine(random.Random(seed + 2), Flow(), op_deadline=30.0)
        self.now = 100.0
        self.spoil = 0.0

    def run_until(self, finished: Callable[[], bool]) -> None:
        """Go on until `finished`, for 2000 s at most."""
        end = self.now + 2000.0
        for _ in range(MAX_STEPS):
            self._exchange(self.now)
            if finished():
                return
            deadlines = [side.next_deadline() for side in (self.engine, self.server, self.model)]
            self.now = max(self.now, min(time for time in deadlines if time is not None))
            assert self.now <= end
        raise AssertionError("time does not go on")

    def _exchange(self, now: float) -> None:
        for wire in self.model.pop(Direction.TO_CLIENT, now):
            self.engine.receive(decode_reply(wire), now)
        deadline = self.engine.next_deadline()
        if deadline is not None and deadline <= now:
            self.engine.on_deadline(now)
        for wire in self.engine.outgoing(now):
            self.model.push(Direction.TO_VEHICLE, wire, now)
        for wire in self.model.pop(Direction.TO_VEHICLE, now):
            self.server.handle(wire, CLIENT, now)
        for _, wire in self.server.outgoing(now):
            spoilt = self.rng.random() < self.spoil
            if not spoilt or self.rng.random() < 0.5:
                self.model.push(Direction.TO_CLIENT, wire, now)
            if spoilt:  # in place of the right one, or beside it
                self.model.push(Direction.TO_CLIENT, self._spoil(wire), now)

    def _spoil(self, wire: bytes) -> bytes:
        payload = decode_reply(wire)
        # Never seq and offset at once: such a lie can be coherent, and nobody could tell.
        kept = self.rng.choice(("seq", "offset"))
        for field in self.rng.sample([field for field in FIELDS if field != kept], self.rng.randint(1, 2)):
            old = getattr(payload, field)
            small = (old + self.rng.choice((-1, 1, 239, 256))) % (
                1 << 16 if field in ("seq", "offset") else 1 << 8
            )
            payload = payload._replace(**{field: small})
        return payload.encode()


@pytest.mark.holds("promise 1")
@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.sampled_from(sorted(PROFILES)),
    st.sampled_from([ReadTransfer, BurstTransfer]),
    st.integers(0, 2**32),
    st.sampled_from([0.0, 0.02, 0.1, 0.2]),
    st.sampled_from([0.0, 0.02, 0.1]),
    st.sampled_from([0.0, 0.1, 0.3]),
    st.sampled_from([0.0, 0.01, 0.1]),
    st.sampled_from([0, 500, 20_000, 70_000]),
)
def test_a_transfer_ends_with_the_right_bytes_or_an_error(
    name: str,
    kind: type[ReadTransfer],
    seed: int,
    loss: float,
    duplicate: float,
    reorder: float,
    spoil: float,
    size: int,
) -> None:
    rng = random.Random(seed)
    tree = MemoryTree()
    content = rng.randbytes(size)
    tree.add(b"/f", content)
    server = FtpServer(tree, PROFILES[name], rng=random.Random(rng.random()))
    wire = LinkSettings(delay=0.02, loss=loss, duplicate=duplicate, reorder=reorder, jitter=0.01)
    link = Way(server, wire, seed)
    opened = OpenRequest(Opcode.OPEN_FILE_RO, b"/f", session=link.engine.home_session)
    link.engine.start(opened, link.now)
    link.run_until(lambda: opened.done)
    if opened.error is not None:
        return  # the ACK was lost and the file is open over there: the session layer's business
    link.engine.session = opened.session
    link.spoil = spoil
    sink = MemorySink(size)
    transfer = kind(opened.session, size, sink)
    link.engine.start(transfer, link.now)
    before = link.engine.stats.requests
    for _ in range(3):
        start = rng.randrange(size + 1)
        transfer.want(start, start + rng.randrange(size + 1), rng.random() < 0.7)
        transfer.want(0, size // 2, False)
        link.run_until(lambda: transfer.idle or transfer.done)
        if isinstance(transfer, BurstTransfer):
            transfer.by_requests = rng.random() < 0.5
    transfer.want(0, size, True)
    link.run_until(lambda: transfer.idle or transfer.done)
    for start, stop in sink.have:
        assert bytes(sink.data[start:stop]) == content[start:stop]
    chunks = -(-size // MAX_DATA) + 8
    lossless = 1.5 * chunks / ((1 - loss) * (1 - spoil)) ** 2
    assert link.engine.stats.requests - before <= lossless + 60
    if transfer.error is None:
        assert sink.have.covers(0, size)
    else:
        assert spoil > 0.0, transfer.error
