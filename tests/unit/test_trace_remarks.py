"""Remarks in the payload trace."""

from __future__ import annotations

from mavftpfs.protocol.payload import Opcode, Payload, request
from mavftpfs.protocol.stats import EngineStats
from mavftpfs.session.driver import Remarks


def test_a_repeated_request_is_marked_until_it_is_answered() -> None:
    stats = EngineStats()
    remarks = Remarks(stats)
    first = request(10, Opcode.READ_FILE, session=1, offset=239, size=239).encode()
    again = request(14, Opcode.READ_FILE, session=1, offset=239, size=239).encode()
    other = request(15, Opcode.READ_FILE, session=1, offset=478, size=239).encode()
    assert remarks.on_request(first) == ""
    assert remarks.on_request(first) == "retransmit"
    assert remarks.on_request(again) == "retransmit of 10"
    assert remarks.on_request(other) == ""
    remarks.before_reply()
    assert remarks.after_reply(Payload(15, 1, Opcode.ACK, 1, Opcode.READ_FILE, offset=239)) == ""
    assert remarks.on_request(first) == ""


def test_what_the_engine_did_not_believe_is_named() -> None:
    stats = EngineStats()
    remarks = Remarks(stats)
    reply = Payload(15, 1, Opcode.ACK, 0, Opcode.READ_FILE)
    for counter, words in (("unknown", "late"), ("stale", "stale"), ("incoherent", "fit")):
        remarks.before_reply()
        setattr(stats, counter, getattr(stats, counter) + 1)
        assert words in remarks.after_reply(reply)
