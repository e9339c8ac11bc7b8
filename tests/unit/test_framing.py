"""The framer: values of each message, signing, damage, limits. Pymavlink is the independent other end."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import (
    Address,
    AutopilotVersion,
    CommandLong,
    FtpRun,
    Heartbeat,
    Message,
    Other,
    StorageInformation,
    SystemTime,
)
from tests.support.frames import feed

pytestmark = pytest.mark.holds("promise 10")

US = Address(254, 191)
DRONE = Address(1, 1)
KEY = bytes(range(32))
PAYLOAD = bytes(range(1, 252))


def drone() -> Any:
    return dialect.MAVLink(None, *DRONE)


def pack(message: Any, mav: Any = None, **how: bool) -> bytes:
    mav = mav or drone()
    frame: bytes = message.pack(mav, **how)
    mav.seq = (mav.seq + 1) % 256
    return frame


def ftp(payload: bytes = PAYLOAD, mav: Any = None, **how: bool) -> bytes:
    return pack(drone().file_transfer_protocol_encode(0, *US, list(payload)), mav, **how)


def heartbeat(mav: Any = None, **how: bool) -> bytes:
    return pack(drone().heartbeat_encode(2, 12, 0x81, 0, 4), mav, **how)


HEARTBEAT = Heartbeat(DRONE, 2, 12, True)
FTP = FtpRun(DRONE, US, [PAYLOAD])

MESSAGES: list[tuple[Any, Message]] = [
    (drone().heartbeat_encode(2, 3, 0x51, 7, 3), Heartbeat(DRONE, 2, 3, False)),
    (drone().file_transfer_protocol_encode(0, 254, 191, list(PAYLOAD)), FTP),
    (drone().system_time_encode(5_000_000_000_000, 1234), SystemTime(DRONE, 1234)),
    (
        drone().command_long_encode(1, 2, 512, 0, 148, 0.5, 0, 0, 0, 0, -1),
        CommandLong(DRONE, Address(1, 2), 512, (148.0, 0.5, 0.0, 0.0, 0.0, 0.0, -1.0)),
    ),
    (
        drone().autopilot_version_encode(
            0x20, 7, 1, 2, 3, list(b"12345678"), [0] * 8, [0] * 8, 4, 5, 99, list(range(18))
        ),
        AutopilotVersion(DRONE, 0x20, 7, 99, bytes(range(18))),
    ),
    (
        drone().storage_information_encode(5, 1, 2, 2, 1024.0, 24.0, 1000.0, 0.0, 0.0),
        StorageInformation(DRONE, 1, 1024.0, 1000.0),
    ),
    (drone().attitude_encode(1, 0, 0, 0, 0, 0, 0), Other(DRONE, 30)),
]


@pytest.mark.parametrize(
    ("message", "value", "old"),
    [(m, v, old) for m, v in MESSAGES for old in (False, True) if not (old and m.get_msgId() > 255)],
)
def test_reads_what_pymavlink_writes(message: Any, value: Message, old: bool) -> None:
    framer = Framer(US, stream=True)
    assert feed(framer, pack(message, force_mavlink1=old)) == [value]


BUILT: list[tuple[Callable[[Framer], bytes], str, dict[str, Any]]] = [
    (
        lambda f: f.encode_heartbeat(18),
        "HEARTBEAT",
        {"type": 18, "autopilot": 8, "base_mode": 0, "system_status": 4},
    ),
    (
        lambda f: f.encode_request_message(DRONE, 261),
        "COMMAND_LONG",
        {"target_system": 1, "target_component": 1, "command": 512, "param1": 261.0},
    ),
    (lambda f: f.encode_request_capabilities(DRONE), "COMMAND_LONG", {"command": 520, "param1": 1.0}),
    (lambda f: f.encode("system_time", 6, 7), "SYSTEM_TIME", {"time_unix_usec": 6, "time_boot_ms": 7}),
    (lambda f: f.encode_ftp(DRONE, PAYLOAD), "FILE_TRANSFER_PROTOCOL", {"payload": list(PAYLOAD)}),
]


@pytest.mark.parametrize(
    ("build", "name", "fields"), BUILT, ids=[f"{n}-{i}" for i, (_, n, _) in enumerate(BUILT)]
)
@pytest.mark.parametrize("key", [None, KEY], ids=["plain", "signed"])
def test_pymavlink_reads_what_we_write(
    build: Callable[[Framer], bytes], name: str, fields: dict[str, Any], key: bytes | None
) -> None:
    framer = Framer(US, stream=True, signing_key=key)
    mav = drone()
    mav.signing.secret_key = key
    for seq in (0, 1):
        message = mav.decode(bytearray(build(framer)))
        assert message.get_type() == name
        assert (message.get_srcSystem(), message.get_srcComponent(), message.get_seq()) == (*US, seq)
        assert {field: getattr(message, field) for field in fields} == fields


def test_seq_counts_through_all_messages_and_wraps() -> None:
    framer = Framer(US, stream=True)
    seqs = []
    for _ in range(200):
        seqs += [framer.encode_ftp(DRONE, PAYLOAD)[4] for _ in range(2)]
        seqs += [framer.encode_heartbeat(18)[4]]
    assert seqs == [n % 256 for n in range(600)]


def test_source_may_change() -> None:
    framer = Framer(US, stream=True)
    framer.source = Address(254, 192)
    assert tuple(framer.encode_ftp(DRONE, PAYLOAD)[5:7]) == (254, 192)
    assert tuple(framer.encode_heartbeat(18)[5:7]) == (254, 192)


# ---------------------------------------------------------------------- the shape of a payload


def with_payload(message_id: int, payload: bytes, extra: int, flags: int = 0) -> bytes:
    header = struct.pack("<BBBBBBBHB", 0xFD, len(payload), flags, 0, 0, *DRONE, message_id, 0)
    crc = dialect.x25crc(header[1:] + payload + bytes([extra])).crc
    return header + payload + struct.pack("<H", crc)


@pytest.mark.parametrize("payload", [b"\0\xfe\xbf" + PAYLOAD + b"\7", b"\5\xfe\xbf" + PAYLOAD])
def test_a_longer_payload_of_a_later_dialect_is_cut_and_the_target_network_does_not_matter(
    payload: bytes,
) -> None:
    assert feed(Framer(US, stream=True), with_payload(110, payload, 84)) == [FTP]


# ---------------------------------------------------------------------- damage


def damaged(at: int = 100, frame: bytes = b"") -> bytes:
    frame = frame or ftp()
    return frame[:at] + bytes([frame[at] ^ 0x90]) + frame[at + 1 :]


@pytest.mark.parametrize(
    ("data", "found", "bad_crc"),
    [
        (damaged() + heartbeat() + ftp(), [HEARTBEAT, FTP], 1),
        (ftp()[:100] + ftp() + ftp(), [FTP, FTP], 0),
        # A recorded flight inside a damaged frame stays inside.
        (damaged(5, ftp((heartbeat() * 20)[:251])) + heartbeat(), [HEARTBEAT], 1),
        # An impossible message id holds nothing up.
        (b"\xfd\xff\0\0\0\1\1\0\0\1" + heartbeat(), [HEARTBEAT], 0),
    ],
)
def test_damage_costs_one_frame(data: bytes, found: list[Message], bad_crc: int) -> None:
    framer = Framer(US, stream=True)
    assert feed(framer, data) == found
    assert framer.stats.bad_crc == bad_crc


def test_a_damaged_last_frame_waits_for_what_follows_but_in_a_datagram() -> None:
    stream, datagrams = Framer(US, stream=True), Framer(US, stream=False)
    assert feed(stream, damaged()) == feed(datagrams, damaged()) == []
    assert (stream.stats.bad_crc, datagrams.stats.bad_crc) == (0, 1)
    assert (stream.waiting, datagrams.waiting) == (True, False)
    assert feed(stream, heartbeat()) == [HEARTBEAT]
    assert stream.stats.bad_crc == 1


def test_a_frame_split_over_datagrams_by_a_bridge_is_joined_but_never_holds_up_another() -> None:
    framer = Framer(US, stream=False)
    frame = ftp()
    assert feed(framer, heartbeat() + frame[:99]) == [HEARTBEAT]
    assert feed(framer, frame[99:] + heartbeat()) == [FTP, HEARTBEAT]
    assert feed(framer, frame[:50]) == []
    assert feed(framer, heartbeat()) == [HEARTBEAT]


def test_unknown_incompatible_flags_are_refused_and_a_signature_is_waited_for() -> None:
    framer = Framer(US, stream=True)
    assert feed(framer, with_payload(110, b"\0\xfe\xbf" + PAYLOAD, 84, flags=0x02) + heartbeat()) == [
        HEARTBEAT
    ]
    assert feed(framer, with_payload(110, b"\0\xfe\xbf" + PAYLOAD, 84, flags=0x01)) == []
    assert feed(framer, bytes(13) + heartbeat()) == [FTP, HEARTBEAT]


def test_message_unknown_to_the_dialect_is_other_if_a_frame_follows() -> None:
    framer = Framer(US, stream=True)
    assert feed(framer, with_payload(60_001, b"private", 77)) == []
    assert feed(framer, heartbeat()) == [Other(DRONE, 60_001), HEARTBEAT]


def test_messages_whose_fields_make_no_sense_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    framer = Framer(US, stream=True)

    def refuse(*_: object) -> None:
        raise dialect.MAVError("no")

    monkeypatch.setattr(framer._decoder, "decode", refuse)
    assert feed(framer, heartbeat() + ftp()) == [FTP]


# ---------------------------------------------------------------------- a length that is far too large


def test_one_flipped_bit_in_a_length_hides_what_follows_only_until_given_up() -> None:
    """280 bytes take many seconds on a quiet stream."""
    framer, chunk = Framer(US, stream=True), ftp(bytes(range(100)) + bytes(151))
    assert feed(framer, damaged(1, heartbeat()) + heartbeat() + chunk) == []
    assert framer.waiting
    assert framer.on_silence() == [HEARTBEAT, FtpRun(DRONE, US, [bytes(range(100)) + bytes(151)])]
    assert not framer.waiting
    assert feed(framer, heartbeat()) == [HEARTBEAT]
    assert framer.on_silence() == []


# ---------------------------------------------------------------------- hooks


def test_on_frame_sees_each_frame_once_in_both_directions() -> None:
    framer, seen = Framer(US, stream=True), list[bytes]()
    framer.on_frame = seen.append
    ours = [framer.encode_ftp(DRONE, PAYLOAD), framer.encode_heartbeat(18)]
    theirs = [ftp(), ftp(bytes(251)), heartbeat(), pack(drone().attitude_encode(1, 0, 0, 0, 0, 0, 0)), ftp()]
    feed(framer, b"garbage".join(theirs))
    assert seen == ours + theirs


# ---------------------------------------------------------------------- signing


def signer(timestamp: int = 1000, key: bytes = KEY, link_id: int = 0) -> Any:
    mav = drone()
    mav.signing.secret_key = key
    mav.signing.sign_outgoing = True
    mav.signing.timestamp = timestamp
    mav.signing.link_id = link_id
    return mav


def test_signed_frames_are_accepted_without_a_key() -> None:
    assert feed(Framer(US, stream=True), ftp(mav=signer()) + heartbeat(signer())) == [FTP, HEARTBEAT]


def test_with_a_key_only_right_signatures_pass() -> None:
    framer = Framer(US, stream=True, signing_key=KEY)
    mav = signer()
    good = ftp(mav=mav) + heartbeat(mav)
    bad = ftp() + heartbeat() + heartbeat(force_mavlink1=True) + heartbeat(signer(key=bytes(32)))
    assert feed(framer, good + bad + heartbeat(mav)) == [FTP, HEARTBEAT, HEARTBEAT]
    assert framer.stats.bad_signature == 4
    assert framer.stats.bad_time == 0


def test_a_radios_own_report_needs_no_signature() -> None:
    framer = Framer(US, stream=True, signing_key=KEY)
    report = pack(drone().radio_status_encode(1, 2, 3, 4, 5, 6, 7))
    assert feed(framer, report) == [Other(DRONE, 109)]


def test_replayed_frames_are_refused() -> None:
    framer = Framer(US, stream=True, signing_key=KEY)
    frame = heartbeat(signer())
    assert feed(framer, frame) == [HEARTBEAT]
    assert feed(framer, frame + heartbeat(signer(timestamp=999))) == []
    assert framer.stats.bad_signature == 2
    assert framer.stats.bad_time == 2


def test_a_new_stream_may_be_a_minute_old_but_not_older() -> None:
    minute = 6_000_000
    now = 10 * minute
    framer = Framer(US, stream=True, signing_key=KEY, signing_clock=lambda: now)
    assert feed(framer, heartbeat(signer(now - minute - 1, link_id=1))) == []
    assert feed(framer, heartbeat(signer(now - minute, link_id=2))) == [HEARTBEAT]


def test_a_forged_timestamp_locks_nobody_out() -> None:
    framer = Framer(US, stream=True, signing_key=KEY)
    forged = bytearray(heartbeat(signer()))
    forged[-12:-6] = b"\xff" * 6
    assert feed(framer, bytes(forged)) == []
    assert feed(framer, heartbeat(signer())) == [HEARTBEAT]


def test_our_timestamps_follow_the_clock_and_what_we_heard() -> None:
    clock = 5000
    framer = Framer(US, stream=True, signing_key=KEY, signing_clock=lambda: clock)

    def timestamp(frame: bytes) -> int:
        return int.from_bytes(frame[-12:-6], "little")

    assert [timestamp(framer.encode_heartbeat(18)) for _ in range(3)] == [5000, 5001, 5002]
    feed(framer, heartbeat(signer(9000)))
    assert timestamp(framer.encode_ftp(DRONE, PAYLOAD)) == 9000
    clock = 20_000
    assert timestamp(framer.encode_heartbeat(18)) == 20_000


def test_streams_are_bounded() -> None:
    framer = Framer(US, stream=True, signing_key=KEY)
    accepted = 0
    for component in range(2):
        for link_id in range(200):
            mav = signer(link_id=link_id)
            mav.srcComponent = component
            accepted += len(feed(framer, heartbeat(mav)))
    assert accepted == 256
