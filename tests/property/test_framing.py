"""Framing: the fast path equals pymavlink, splitting changes nothing, nothing raises."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavftpfs.link.fastframe import FtpFrameCodec
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address, FtpRun, Message, Other
from mavftpfs.sim.vehicle import telemetry
from tests.support.frames import feed, singly

EXTRA = dialect.MAVLink_file_transfer_protocol_message.crc_extra
KEY = bytes(32)

addresses = st.builds(Address, st.integers(0, 255), st.integers(0, 255))
payloads = st.one_of(
    st.binary(min_size=251, max_size=251),
    st.binary(max_size=40).map(lambda start: start.ljust(251, b"\0")),
    st.tuples(st.binary(max_size=120), st.binary(max_size=40)).map(
        lambda parts: (parts[0] + parts[1].rjust(100, b"\0")).ljust(251, b"\0")[:251]
    ),
)


def pymavlink(source: Address, *, seq: int = 0, key: bytes | None = None) -> Any:
    mav = dialect.MAVLink(None, *source)
    mav.seq = seq
    mav.signing.secret_key = key
    mav.signing.sign_outgoing = key is not None
    return mav


def reference_frame(source: Address, target: Address, payload: bytes, **how: Any) -> bytes:
    old = how.pop("old", False)
    mav = pymavlink(source, **how)
    message = mav.file_transfer_protocol_encode(0, *target, list(payload))
    frame: bytes = message.pack(mav, force_mavlink1=old)
    return frame


@given(addresses, addresses, st.integers(0, 255), st.lists(payloads, max_size=4))
def test_fast_encoding_is_pymavlinks_byte_for_byte(
    source: Address, target: Address, seq: int, several: list[bytes]
) -> None:
    assert FtpFrameCodec(source, EXTRA).encode(seq, target, several) == [
        reference_frame(source, target, payload, seq=(seq + index) & 0xFF)
        for index, payload in enumerate(several)
    ]


@given(st.lists(st.tuples(addresses, addresses, payloads), max_size=8), st.integers(0, 255))
@example([(Address(1, 1), Address(0, 0), bytes(251)), (Address(1, 1), Address(1, 1), b"\1" * 251)], 0)
def test_fast_decoding_of_several_is_pymavlinks(
    several: list[tuple[Address, Address, bytes]], seq: int
) -> None:
    frames = [reference_frame(*one, seq=(seq + index) & 0xFF) for index, one in enumerate(several)]
    data, wanted = b"".join(frames), [FtpRun(one[0], one[1], [one[2]]) for one in several]
    found = feed(Framer(Address(9, 9), stream=True), data)
    assert found == wanted
    if all(len(frame) >= 15 for frame in frames):
        out: list[Message] = []
        assert FtpFrameCodec(Address(9, 9), EXTRA).decode_runs(data, 0, out) == len(data)
        assert singly(out) == wanted


@pytest.mark.holds("fault corrupt")
@given(addresses, payloads, st.integers(0, 265), st.integers(1, 255))
def test_no_changed_byte_gets_through(target: Address, payload: bytes, at: int, flip: int) -> None:
    frame = bytearray(reference_frame(Address(1, 1), target, payload))
    frame[at % len(frame)] ^= flip
    framer = Framer(Address(9, 9), stream=True)
    found = feed(framer, bytes(frame) + b"\xfd")
    # Of a message that the dialect lacks nobody can check the CRC; it is believed for nothing.
    assert all(isinstance(message, Other) for message in found)


def some_frame(draw: st.DrawFn) -> bytes:
    framer = Framer(Address(1, draw(st.integers(0, 3))), stream=True)
    kind = draw(st.sampled_from(["ftp", "beat", "other", "v1", "signed", "unknown", "cut", "damaged"]))
    if kind == "beat":
        return framer.encode_heartbeat(2, 12)
    if kind == "other":
        return framer.encode(*telemetry(draw(st.integers(0, 4)), 5))
    payload = draw(payloads)
    frame = reference_frame(
        Address(1, 1), Address(2, 2), payload, old=kind == "v1", key=KEY if kind == "signed" else None
    )
    if kind == "unknown":
        return frame[:7] + b"\x61\xea\x00" + frame[10:]
    if kind == "cut":
        return frame[: draw(st.integers(0, len(frame)))]
    if kind == "damaged":
        at = draw(st.integers(0, len(frame) - 1))
        return frame[:at] + bytes([frame[at] ^ 0x41]) + frame[at + 1 :]
    return frame


@st.composite
def streams(draw: st.DrawFn) -> bytes:
    """Frames of all sorts, whole or not, with garbage between."""
    parts: list[bytes] = []
    for _ in range(draw(st.integers(0, 8))):
        parts.append(draw(st.binary(max_size=12) | st.sampled_from([b"\xfd", b"\xfe\xff", b"\xfd\xff\x00"])))
        parts.append(some_frame(draw))
    return b"".join(parts)


def fed(pieces: list[bytes], key: bytes | None) -> tuple[list[Message], Framer]:
    framer = Framer(Address(9, 9), stream=True, signing_key=key)
    return [message for piece in pieces for message in feed(framer, piece)], framer


@given(streams(), st.lists(st.integers(0, 3000), max_size=20), st.sampled_from([None, KEY]))
def test_splitting_changes_nothing(data: bytes, cuts: list[int], key: bytes | None) -> None:
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    pieces = [data[a:b] for a, b in pairwise(edges)]
    whole, one = fed([data], key)
    split, other = fed(pieces, key)
    single, third = fed([data[n : n + 1] for n in range(len(data))], key)
    assert whole == split == single
    assert one.stats == other.stats == third.stats
    assert one._tail == other._tail == third._tail


@given(streams(), st.binary(max_size=600))
def test_after_anything_the_stream_recovers(data: bytes, garbage: bytes) -> None:
    framer = Framer(Address(9, 9), stream=True)
    feed(framer, data + garbage)
    beat = Framer(Address(7, 7), stream=True).encode_heartbeat(2, 12)
    found = feed(framer, beat * 30)
    # One claimed frame (292 bytes at most) may swallow the beginning.
    assert len([m for m in found if m.source == (7, 7)]) >= 15


@pytest.mark.holds("promise 10")
@given(st.lists(st.binary(max_size=400) | streams(), max_size=8), st.booleans(), st.sampled_from([None, KEY]))
@settings(max_examples=200)
def test_nothing_raises_and_little_is_kept(pieces: list[bytes], stream: bool, key: bytes | None) -> None:
    framer = Framer(Address(9, 9), stream=stream, signing_key=key)
    for piece in pieces:
        feed(framer, piece)
        assert len(framer._tail) <= 292
