"""When another client may have a file open, by what was heard of it."""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.session.others import CLIENT_MEMORY, LEFT_OPEN, MOST_PAUSE, OtherClients

pytestmark = pytest.mark.holds("promise 6")


def asks(opcode: Opcode) -> bytes:
    return Payload(1, 0, opcode, 0).encode()


def acks(opcode: Opcode) -> bytes:
    return Payload(2, 0, Opcode.ACK, 0, opcode).encode()


def refuses(opcode: Opcode, code: NakCode) -> bytes:
    return Payload(2, 0, Opcode.NAK, 1, opcode, data=bytes([code])).encode()


def until(*heard: bytes, seed: int = 1) -> float:
    """Return until when a file may be open after these payloads, one each second from 0 on."""
    others = OtherClients(random.Random(seed))
    for at, payload in enumerate(heard):
        others.hear(payload, float(at))
    return others.file_open_until


OPEN, READ, CLOSE = Opcode.OPEN_FILE_RO, Opcode.READ_FILE, Opcode.TERMINATE_SESSION


def test_a_file_is_open_from_the_first_request_until_it_is_closed_or_left() -> None:
    assert until(asks(OPEN)) == LEFT_OPEN
    assert until(asks(OPEN), acks(OPEN), asks(READ)) == 2 + LEFT_OPEN
    assert until(asks(OPEN), acks(OPEN), asks(Opcode.LIST_DIRECTORY)) == 2 + LEFT_OPEN
    assert until(asks(OPEN), acks(OPEN), asks(CLOSE)) <= 2 + MOST_PAUSE


def test_a_client_that_left_its_file_long_ago_and_lists_has_none() -> None:
    others = OtherClients(random.Random(1))
    others.hear(acks(OPEN), 0.0)
    others.hear(asks(Opcode.LIST_DIRECTORY), LEFT_OPEN + 1)
    assert others.file_open_until <= LEFT_OPEN + 1


def test_a_client_that_only_lists_is_present_for_a_while() -> None:
    others = OtherClients(random.Random(1))
    assert not others.are_heard(0.0)
    others.hear(asks(Opcode.LIST_DIRECTORY), 0.0)
    assert others.are_heard(CLIENT_MEMORY - 1)
    assert not others.are_heard(CLIENT_MEMORY)


@pytest.mark.parametrize("code", [NakCode.FILE_NOT_FOUND, NakCode.NO_SESSIONS_AVAILABLE])
def test_a_refused_open_changes_nothing(code: NakCode) -> None:
    assert until(asks(OPEN), refuses(OPEN, code)) <= 0.0
    # Two others came before the file of a third one was closed.
    came = (asks(OPEN), acks(OPEN), asks(OPEN), asks(OPEN), refuses(OPEN, code), refuses(OPEN, code))
    assert until(*came) == 5 + LEFT_OPEN
    assert until(*came, asks(CLOSE)) <= 6 + MOST_PAUSE


def test_each_program_waits_another_time_after_a_file_was_closed() -> None:
    closed = (acks(OPEN), asks(CLOSE))
    waits = {until(*closed, seed=seed) - 1 for seed in range(20)}
    assert len(waits) == 20
    assert min(waits) < MOST_PAUSE / 4
    assert max(waits) <= MOST_PAUSE
    assert until(asks(CLOSE)) <= 0.0, "nobody waited"


def test_the_ack_of_our_own_open_shows_that_no_other_file_is_open() -> None:
    others = OtherClients(random.Random(1))
    others.hear(acks(OPEN), 0.0)
    others.on_ours_opened()
    assert others.file_open_until <= 0.0
    others.hear(acks(READ), 1.0)
    assert others.file_open_until == 1.0 + LEFT_OPEN
