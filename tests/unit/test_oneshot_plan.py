"""oneshot.fetch, download, names and scan: what to fetch, skip, resume and prove; what words mean."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from mavftpfs.cli.verbs import parse_date
from mavftpfs.client import download, fetch, proof
from mavftpfs.client.connect import process_name
from mavftpfs.client.fetch import Wanted
from mavftpfs.client.names import parse_paths
from mavftpfs.client.proof import Verify
from mavftpfs.link.messages import Address, AutopilotVersion, Heartbeat
from mavftpfs.link.peers import describe_peer
from mavftpfs.link.rendezvous import leads_back, same_link
from mavftpfs.link.uri import parse_source
from mavftpfs.shared.errors import UsageError

MAY, JUNE = 1_714_566_896, 1_717_245_296


@pytest.mark.parametrize(
    ("here", "part", "begun"),
    [
        (None, None, 0),
        (100, 40, None),
        (None, 40, 40),
        (None, 100, 100),
        (None, 101, 0),
        (None, 0, 0),
        (60, None, 60),
        (60, 80, 80),
        (0, None, 0),
        (101, None, 0),
    ],
)
def test_what_is_here_of_a_file_of_100_bytes(
    tmp_path: Path, here: int | None, part: int | None, begun: int | None
) -> None:
    wanted = Wanted(b"/a", "a", 100, None, tmp_path / "a", tmp_path / "a.part", keep_old=True)
    for path, size in ((wanted.local, here), (wanted.part, part)):
        if size is not None:
            path.write_bytes(bytes(size))
    assert wanted.here is (begun is None)
    assert wanted.here or wanted.begun == begun


@pytest.mark.parametrize(
    ("verify", "resumed", "size", "needed"),
    [
        ("auto", False, proof.PROVEN_BY_DEFAULT, True),
        ("auto", False, proof.PROVEN_BY_DEFAULT + 1, False),
        ("auto", True, proof.PROVEN_BY_DEFAULT + 1, True),
        ("all", False, proof.PROVEN_BY_DEFAULT + 1, True),
        ("none", False, 1, False),
        ("none", True, 1, True),
    ],
)
def test_what_is_proven(verify: Verify, resumed: bool, size: int, needed: bool) -> None:
    assert proof.proof_needed(verify, resumed=resumed, size=size) is needed


def log(below: str, mtime: int | None = None) -> Wanted:
    return Wanted(b"/log/" + below.encode(), below, 1, mtime, Path(below), Path(below))


@pytest.mark.parametrize(
    ("logs", "ordered"),
    [
        (
            [log("s/log9"), log("a", MAY), log("s/log10"), log("b", JUNE), log("c", MAY)],
            ["b", "c", "a", "s/log10", "s/log9"],
        ),
        # ArduPilot's number of the last log is none, with times and without
        ([log("1.BIN"), log("LASTLOG.TXT"), log("2.BIN")], ["2.BIN", "1.BIN", "LASTLOG.TXT"]),
        (
            [log("1.BIN", MAY), log("LASTLOG.TXT", JUNE), log("2.BIN", JUNE)],
            ["2.BIN", "1.BIN", "LASTLOG.TXT"],
        ),
    ],
)
def test_the_newest_come_first_by_time_then_by_number(logs: list[Wanted], ordered: list[str]) -> None:
    assert [one.name for one in download.newest_first(logs)] == ordered


def test_which_logs_are_wished_for() -> None:
    logs = download.newest_first([log("a", MAY), log("b", JUNE), log("c")])
    assert [one.name for one in download.select(logs, newest=1, since=None)] == ["b"]
    since = download.select(logs, newest=None, since=MAY + 1)
    assert [one.name for one in since] == ["b", "c"]  # c may be a new one
    assert download.select(logs, newest=9, since=None) == logs


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
    ("endpoint", "source", "back"),
    [
        ("udpout:127.0.0.1:14550", "udpin:0.0.0.0:14550", True),
        ("udpout:localhost:14550", "udpin:127.0.0.1:14550", True),
        ("udpout:[::1]:14550", "udpin:[::]:14550", True),
        ("udpout:127.0.0.1:14551", "udpin:0.0.0.0:14550", False),
        ("udpout:203.0.113.9:14550", "udpin:0.0.0.0:14550", False),
        ("udpout:127.0.0.2:14550", "udpin:127.0.0.1:14550", False),
        ("udpout:station.invalid:14550", "udpin:0.0.0.0:14550", False),
        ("udpin:127.0.0.1:14550", "udpout:127.0.0.1:14550", True),
        ("tcp:127.0.0.1:5760", "tcpin:0.0.0.0:5760", True),
        ("tcp:127.0.0.1:5760", "udpin:0.0.0.0:5760", False),
        ("/dev/null", "/dev/null", True),
    ],
)
def test_an_endpoint_that_leads_back(endpoint: str, source: str, back: bool) -> None:
    assert leads_back(parse_source(endpoint), parse_source(source)) is back


@pytest.mark.parametrize(
    ("argv", "name"),
    [
        (["/usr/bin/mavftpfs", "udpin:0.0.0.0:14550", "drone", "-o", "ro"], "udpin:0.0.0.0:14550 drone"),
        (["/lib/mavftpfs/__main__.py", "ls", "-l", "drone"], "ls drone"),
        (["/home/me/survey.py", "--token", "secret"], "survey.py"),
        (["/home/me/survey/__main__.py"], "survey"),
        (["-c"], "python"),
        ([""], "python"),
        ([], "python"),
    ],
)
def test_what_a_hub_calls_a_program(monkeypatch: pytest.MonkeyPatch, argv: list[str], name: str) -> None:
    monkeypatch.setattr(sys, "argv", argv)
    assert process_name() == f"{name} (process {os.getpid()})"


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
    assert (version.firmware, version.board) == (words, "0000000000001234")
    assert replace(version, uid2=b"\1" * 18).board == "01" * 18
    assert replace(version, uid=0).board is None
