"""The 251-byte payload: layout, ranges, refusal of what does not fit."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.payload import (
    PAYLOAD_SIZE,
    Payload,
)
from mavftpfs.shared.errors import LocalProtocolError
from tests.support.replies import decode_reply


def test_layout_is_the_guides() -> None:
    wire = Payload(0x1234, 5, 4, 3, 7, 1, 0xAABBCCDD, b"xyz").encode()
    assert wire[:12] == bytes.fromhex("3412 05 04 03 07 01 00 ddccbbaa")
    assert wire[12:15] == b"xyz"
    assert wire[15:] == bytes(PAYLOAD_SIZE - 15)


@pytest.mark.holds("rule 14.5")
def test_a_reply_holds_exactly_size_bytes() -> None:
    wire = bytearray(Payload(1, 0, 128, 2, 5, 0, 0, b"ab").encode())
    wire[14:20] = b"stray!"
    assert decode_reply(bytes(wire)).data == b"ab"


@pytest.mark.parametrize(
    "bad", [Payload(65536, 0, 0, 0), Payload(0, -1, 0, 0), Payload(0, 0, 0, 0, data=bytes(240))]
)
def test_what_does_not_fit_is_our_fault(bad: Payload) -> None:
    with pytest.raises(LocalProtocolError):
        bad.encode()
