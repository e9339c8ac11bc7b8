"""Reading files whose size is a lie."""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.payload import NakCode, Payload
from mavftpfs.protocol.reading import ReadToEof
from mavftpfs.shared.errors import DataUnproven, FtpNak, LocalProtocolError, MavftpfsError, SessionLost
from tests.support.replies import chunk, nak, sent


class Reading:
    """One read to EOF and the requests it has made."""

    def __init__(self, limit: int = 10_000, block: int = 100) -> None:
        self.op = ReadToEof(7, block, limit)
        self.engine = Engine(random.Random(1), Flow())
        self.engine.start(self.op, 0.0)
        self.out: dict[int, Payload] = {}
        self.more()

    def more(self) -> None:
        for request in sent(self.engine, 0.0):
            assert request.size == 100
            assert request.session == 7
            assert request.offset not in self.out
            self.out[request.offset] = request

    def answer(self, offset: int, content: bytes) -> None:
        self.engine.receive(chunk(self.out[offset], content), 0.0)
        self.more()

    def refuse(self, offset: int, *codes: int) -> None:
        self.engine.receive(nak(self.out[offset], *codes), 0.0)
        self.more()

    def all(self, content: bytes) -> None:
        while not self.op.done:
            self.answer(min(self.out), content)
            del self.out[min(self.out)]


@pytest.mark.holds("rule 14.13")
@pytest.mark.parametrize("size", [0, 1, 99, 100, 101, 200, 950, 1000])
def test_reads_what_is_there(size: int) -> None:
    content = random.Random(size).randbytes(size)
    reading = Reading()
    reading.all(content)
    assert reading.op.error is None
    assert reading.op.data == content


def test_nothing_is_asked_far_behind_the_end() -> None:
    reading = Reading()
    reading.answer(0, b"x" * 30)
    assert max(reading.out) == 300
    reading.answer(100, b"x" * 30)
    assert reading.op.data == b"x" * 30


def test_the_limit() -> None:
    reading = Reading(limit=350)
    reading.answer(0, bytes(1000))
    reading.answer(100, bytes(1000))
    reading.answer(200, bytes(1000))
    assert not reading.op.done
    reading.answer(300, bytes(1000))
    assert isinstance(reading.op.error, DataUnproven)


@pytest.mark.parametrize("late", [False, True])
def test_a_short_block_before_another_proves_nothing(late: bool) -> None:
    reading = Reading()
    if late:
        reading.answer(100, bytes(200))
        reading.answer(0, bytes(50))
    else:
        reading.answer(0, bytes(50))
        reading.answer(100, bytes(200))
    assert isinstance(reading.op.error, DataUnproven)
    assert reading.op.shorter == 50, "the server sends no more at once"


def test_eight_is_an_end_only_behind_a_short_block() -> None:
    reading = Reading()
    reading.answer(0, b"x" * 40)
    reading.refuse(100, NakCode.FILE_EXISTS)
    assert reading.op.data == b"x" * 40
    reading = Reading()
    reading.answer(0, b"x" * 100)
    reading.refuse(100, NakCode.FILE_EXISTS)
    assert isinstance(reading.op.error, FtpNak)


@pytest.mark.parametrize(
    ("codes", "error"),
    [((4,), SessionLost), ((10,), SessionLost), ((1,), SessionLost), ((2, 22), FtpNak), ((3,), FtpNak)],
)
def test_refusals(codes: tuple[int, ...], error: type[MavftpfsError]) -> None:
    reading = Reading()
    reading.refuse(0, *codes)
    assert isinstance(reading.op.error, error)


@pytest.mark.holds("rule 14.14")
@pytest.mark.parametrize("block", [0, 240])
def test_block_sizes(block: int) -> None:
    with pytest.raises(LocalProtocolError):
        ReadToEof(0, block, 1)
