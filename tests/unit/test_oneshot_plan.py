"""oneshot.fetch, names and scan: what to fetch, skip, resume and prove; what words mean."""

from __future__ import annotations

import pytest

from mavftpfs.link.messages import Address, AutopilotVersion, Heartbeat
from mavftpfs.link.uri import parse_source
from mavftpfs.oneshot import fetch
from mavftpfs.oneshot.fetch import Log, Step, Verify
from mavftpfs.oneshot.files import same_link
from mavftpfs.oneshot.names import parse_paths
from mavftpfs.oneshot.scan import describe_peer
from mavftpfs.oneshot.verbs import parse_date
from mavftpfs.report import version_facts
from mavftpfs.shared.errors import UsageError

MAY, JUNE = 1_714_566_896, 1_717_245_296


@pytest.mark.parametrize(
    ("here", "part", "step"),
    [
        (None, None, Step.FETCH),
        (100, None, Step.SKIP),
        (100, 40, Step.SKIP),
        (None, 40, Step.RESUME),
        (None, 100, Step.RESUME),
        (None, 101, Step.FETCH),
        (None, 0, Step.FETCH),
        (60, None, Step.EXTEND),
        (60, 80, Step.RESUME),
        (0, None, Step.FETCH),
        (101, None, Step.FETCH),
    ],
)
def test_what_to_do_about_a_file_of_100_bytes(here: int | None, part: int | None, step: Step) -> None:
    assert fetch.decide(100, here, part) is step


@pytest.mark.parametrize(
    ("verify", "resumed", "size", "needed"),
    [
        ("auto", False, fetch.PROVEN_BY_DEFAULT, True),
        ("auto", False, fetch.PROVEN_BY_DEFAULT + 1, False),
        ("auto", True, fetch.PROVEN_BY_DEFAULT + 1, True),
        ("all", False, fetch.PROVEN_BY_DEFAULT + 1, True),
        ("none", False, 1, False),
        ("none", True, 1, True),
    ],
)
def test_what_is_proven(verify: Verify, resumed: bool, size: int, needed: bool) -> None:
    assert fetch.proof_needed(verify, resumed=resumed, size=size) is needed


def log(below: bytes, mtime: int | None = None) -> Log:
    return Log(b"/log/" + below, below, 1, mtime)


def test_the_newest_come_first_by_time_then_by_number() -> None:
    logs = [log(b"s/log9"), log(b"a", MAY), log(b"s/log10"), log(b"b", JUNE), log(b"c", MAY)]
    assert [one.below for one in fetch.newest_first(logs)] == [b"b", b"c", b"a", b"s/log10", b"s/log9"]


def test_the_newest_log_is_not_the_file_that_holds_its_number() -> None:
    for time in (None, JUNE):  # ArduPilot without and with times
        logs = [log(b"00000001.BIN", time and MAY), log(b"LASTLOG.TXT", time), log(b"00000002.BIN", time)]
        ordered = [one.below for one in fetch.newest_first(logs)]
        assert ordered == [b"00000002.BIN", b"00000001.BIN", b"LASTLOG.TXT"]


def test_which_logs_are_wished_for() -> None:
    logs = fetch.newest_first([log(b"a", MAY), log(b"b", JUNE), log(b"c")])
    assert [one.below for one in fetch.select(logs, newest=1, since=None)] == [b"b"]
    since = fetch.select(logs, newest=None, since=MAY + 1)
    assert [one.below for one in since] == [b"b", b"c"]  # c may be a new one
    assert fetch.select(logs, newest=9, since=None) == logs


def test_a_clock_that_was_not_set_tells_nothing() -> None:
    assert fetch.known_time(315_532_800) is None
    assert fetch.known_time(MAY) == MAY


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["/a//b/", "c"], ([b"/a/b", b"/c"], None)),
        (["mftp://comp=5:/a", "mftp://[;comp=5]b", "/c"], ([b"/a", b"/b", b"/c"], 5)),
        (["mftp://@SYS/x"], ([b"/@SYS/x"], None)),
    ],
)
def test_paths(texts: list[str], expected: tuple[list[bytes], int | None]) -> None:
    assert parse_paths(texts) == expected


@pytest.mark.holds("rule 14.33")
@pytest.mark.parametrize("text", ["../x", "/a/../b", "a\0b", "mftp://comp=0:/x"])
def test_paths_that_cannot_be(text: str) -> None:
    with pytest.raises(UsageError):
        parse_paths([text])


def test_dates() -> None:
    assert parse_date("2024-05-01T12:34:56+00:00") == MAY
    assert parse_date("2024-05-02") - parse_date("2024-05-01") == 86_400
    with pytest.raises(UsageError, match="2026-05-01"):
        parse_date("yesterday")


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("udpin:0.0.0.0:14550", "udpin://127.0.0.1:14550", True),
        ("udpin:0.0.0.0:14550", "udpin:0.0.0.0:14551", False),
        ("udpin:0.0.0.0:14550#/fs", "udpin:0.0.0.0:14550", True),
        ("udpout:10.0.0.1:14550", "udpout:10.0.0.2:14550", False),
        ("udpin:127.0.0.1:14550", "udpout:127.0.0.1:14550", False),
        ("/dev/null,57600", "/dev/../dev/null,921600", True),
        ("/dev/null", "/dev/zero", False),
    ],
)
def test_the_same_link(one: str, other: str, same: bool) -> None:
    assert same_link(parse_source(one), parse_source(other)) is same


@pytest.mark.parametrize(
    ("kind", "component", "autopilot", "armed", "words"),
    [
        (2, 1, 12, True, "PX4 quadrotor, armed"),
        (12, 1, 3, False, "ArduPilot submarine, disarmed"),
        (6, 190, 8, False, "ground station"),
        (30, 100, 8, False, "camera"),
        (0, 154, 8, False, "gimbal"),
        (18, 191, 8, False, "companion computer"),
        (77, 200, 8, False, "component of type 77"),
        (99, 1, 99, False, "autopilot type 99, disarmed"),
    ],
)
def test_what_a_heartbeat_says(kind: int, component: int, autopilot: int, armed: bool, words: str) -> None:
    assert describe_peer(Heartbeat(Address(1, component), kind, autopilot, armed)) == words


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (0x010F04FF, "1.15.4"),
        (0x04060080, "4.6.0 beta"),
        (0x010E00C0, "1.14.0 rc"),
        (0x01100000, "1.16.0 dev"),
    ],
)
def test_firmware_and_board(number: int, words: str) -> None:
    version = AutopilotVersion(Address(1, 1), 0, number, b"", 0x1234, bytes(18))
    assert version_facts(version)["firmware"] == words
    assert version_facts(version)["uid"] == "0000000000001234"
    assert version_facts(AutopilotVersion(Address(1, 1), 0, number, b"", 1, b"\1" * 18))["uid"] == "01" * 18
    assert version_facts(AutopilotVersion(Address(1, 1), 0, number, b"", 0, bytes(18)))["uid"] is None
