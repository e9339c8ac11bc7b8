"""One flipped bit in a frame's length must not silence a quiet stream for the seconds that 280 bytes take."""

from __future__ import annotations

import pytest

from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address, FtpFrame, Heartbeat, singly

US = Address(254, 191)
VEHICLE = Address(1, 1)


def pair() -> tuple[Framer, Framer]:
    """Return the vehicle's framer and ours."""
    return Framer(VEHICLE, stream=True), Framer(US, stream=True)


def damaged(frame: bytes) -> bytes:
    """Return the frame with a length that is far too large."""
    return bytes([frame[0], frame[1] | 0x80]) + frame[2:]


def test_a_damaged_length_hides_what_follows_until_given_up() -> None:
    vehicle, us = pair()
    beat = vehicle.encode_heartbeat(2, 12)
    assert us.feed(damaged(beat) + beat + beat) == []
    assert us.waiting
    found = singly(us.give_up())
    assert [type(message) for message in found] == [Heartbeat, Heartbeat]
    assert not us.waiting
    assert us.stats.frames == 2
    assert us.feed(beat) == found[:1]


def test_a_chunk_behind_it_is_found() -> None:
    vehicle, us = pair()
    chunk = bytes(range(100)) + bytes(151)  # a short frame: MAVLink 2 trims the zeros
    found = us.feed_runs(damaged(vehicle.encode_heartbeat(2, 12)) + vehicle.encode_ftp(US, chunk))
    assert singly(found + us.give_up()) == [FtpFrame(VEHICLE, US, chunk)]


@pytest.mark.parametrize("cut", [1, 5, 9, 12, 20])
def test_a_frame_that_never_ends_is_dropped(cut: int) -> None:
    vehicle, us = pair()
    beat = vehicle.encode_heartbeat(2, 12)
    us.feed(beat[:cut])
    assert us.give_up() == []
    assert not us.waiting
    assert len(us.feed(beat)) == 1


def test_nothing_waits_where_nothing_came_and_datagrams_do_not_wait() -> None:
    vehicle, us = pair()
    assert not us.waiting
    assert us.give_up() == []
    datagrams = Framer(US, stream=False)
    datagrams.feed(vehicle.encode_heartbeat(2, 12)[:7])
    assert not datagrams.waiting
