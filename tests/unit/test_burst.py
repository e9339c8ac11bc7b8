"""The packets that belong to a burst, and its end."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.burst import Burst
from mavftpfs.protocol.payload import Opcode, Payload

SEQ = 65000
RTO = 0.2


def make(size: int = 10_000, *, asked: int = 239) -> Burst:
    return Burst(SEQ, 0, size, asked, 0.0, RTO)


def data(index: int, count: int = 239, *, step: int = 239) -> Payload:
    seq = (SEQ + 1 + index) & 0xFFFF
    content = bytes([index % 251]) * count
    return Payload(seq, 0, Opcode.ACK, count, 15, 0, index * step, content)


def control(index: int, opcode: int, content: bytes = b"", offset: int = 0) -> Payload:
    return Payload((SEQ + 1 + index) & 0xFFFF, 0, opcode, len(content), 15, 0, offset, content)


@pytest.mark.holds("rule 14.15")
def test_packets_are_placed_by_offset_across_the_wrap_of_seq() -> None:
    burst = make(239 * 1000)
    for index in range(999):
        assert burst.take(data(index), 0.001 * index) == bytes([index % 251]) * 239
    assert not burst.over
    assert burst.take(data(999), 1.0) is not None
    assert burst.over
    assert burst.highest == 239_000
    assert burst.packet == 239


def test_the_size_is_what_the_server_sends() -> None:
    burst = make(asked=110)
    assert burst.take(data(0), 0.0) is not None
    assert burst.packet == 239
    assert burst.take(data(1, 110, step=110), 0.0) is None


def test_the_size_is_learnt_from_a_later_packet_when_the_first_was_lost() -> None:
    burst = make()
    assert burst.take(data(3, 80, step=80), 0.0) is not None
    assert burst.packet == 80
    assert burst.take(data(0, 80, step=80), 0.0) is not None


@pytest.mark.parametrize(
    "reply",
    [
        data(1, 239, step=238),
        data(1, 239, step=240),
        data(2, 100, step=239),
        data(2)._replace(offset=2 * 239 + 1),
        data(3)._replace(seq=SEQ + 1),
        data(0)._replace(offset=1),
        data(5)._replace(offset=0),
        data(3, 10, step=400),
    ],
)
def test_incoherent_first_packets_are_refused(reply: Payload) -> None:
    burst = make(5000)
    assert burst.take(reply, 0.0) is None
    assert burst.empty
    assert burst.packet == 0


def test_a_grown_file_is_clipped_to_its_size() -> None:
    burst = make(300)
    burst.take(data(0), 0.0)
    assert burst.take(data(1), 0.0) == b"\x01" * 61
    assert burst.over
    assert burst.highest == 300
    assert burst.take(data(2), 0.0) == b""


def test_control_packets_of_another_burst_are_refused() -> None:
    burst = make()
    burst.take(data(0), 0.0)
    assert burst.take(control(60, Opcode.NAK, b"\x06"), 0.1) is None
    assert burst.take(control(-1, Opcode.NAK, b"\x06"), 0.1) is None
    assert burst.take(control(60, Opcode.ACK), 0.1) is None
    assert burst.take(control(1, 77), 0.1) is None
    assert not burst.over


@pytest.mark.holds("promise 8", "rule 14.19")
def test_endless_empty_packets() -> None:
    burst = make()
    burst.take(data(0), 0.0)
    burst.take(control(1, Opcode.ACK, offset=239), 0.1)
    burst.take(data(2), 0.1)
    assert not burst.endless
    burst.take(control(3, Opcode.ACK, offset=239), 0.1)
    assert not burst.endless
    burst.take(control(4, Opcode.ACK, offset=239), 0.1)
    assert burst.endless


def test_quiet_follows_the_packets() -> None:
    burst = make()
    for index in range(20):
        burst.take(data(index), 0.01 * index)
    assert burst.quiet_deadline() == pytest.approx(0.19 + 1.0)
    slow = make()
    for index in range(20):
        slow.take(data(index), 0.14 * index)
    assert slow.quiet_deadline() == pytest.approx(0.14 * 19 + 2.0)
    crawling = make()
    for index in range(20):
        crawling.take(data(index), 1.0 * index)
    assert crawling.quiet_deadline() > 19 + 6
