"""report: facts as a person reads them."""

from __future__ import annotations

import pytest

from mavftpfs.report import describe, rows
from mavftpfs.shared.readable import printable, readable_size, readable_time


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("rtt", 0.02, "20 ms"),
        ("uptime", 12.34, "12.3 s"),
        ("bytes_held", 1536, "1.5 kB"),
        ("armed", True, "yes"),
        ("anything", None, "unknown"),
        ("anything", [], "none"),
        ("transfers", [], "none"),
        ("anything", {}, "none"),
        ("names", ["a", "b"], "a, b"),
        ("rate", None, "unknown"),
        ("loss", 0.052, "5.2 %"),
        ("session_open", None, "none"),
        ("session_open", "/logs/1", "/logs/1"),
        ("autopilot", 12, "PX4"),
        ("autopilot", 3, "ArduPilot"),
        ("autopilot", 0, "generic autopilot"),
        ("autopilot", 77, "autopilot type 77"),
        ("autopilot", None, "unknown"),
        ("vehicle", [1, 191], "system 1, component 191"),
        ("vehicle", None, "unknown"),
        ("dirty_max", 65536, "65.5 kB"),
        ("uploads", [], "none"),
    ],
)
def test_describe(key: str, value: object, text: str) -> None:
    assert describe(key, value) == text


def test_transfers_show_how_far_they_are() -> None:
    sending = {"path": "/a", "size": 4096, "bytes_left": 1024, "sending": True, "eta": 3.4}
    waiting = {"path": "/b", "size": 0, "bytes_left": 0, "sending": False, "eta": None}
    assert describe("transfers", [sending, waiting]) == (
        "/a sending, 75 % of 4.1 kB, 3 s left; /b waiting, empty of 0 B"
    )


def test_uploads_show_how_far_they_are() -> None:
    upload = {"path": "/a", "running": True, "reached": 2048, "unproven": 512, "clean": True, "error": None}
    waiting = {**upload, "path": "/b", "running": False, "reached": 0, "error": "the vehicle is armed"}
    assert describe("uploads", [upload, waiting]) == (
        "/a running, 2.0 kB sent; /b waiting, 0 B sent (the vehicle is armed)"
    )


def test_what_a_person_looks_for_comes_first() -> None:
    """A small terminal that shows the status again and again cuts its end."""
    facts = {
        "pid": 7,
        "connection": {"rtt": 0.1, "uploads": []},
        "cache": {"bytes_cached": 3, "errors": {"/x": "no"}, "transfers": [], "bytes_held": 9, "hits": 1},
        "kernel": {"inodes": 1},
    }
    names = [name for name, _ in rows(facts)]
    first = ["cache: bytes held", "cache: transfers", "cache: errors: /x"]
    assert names == [*first, "process", "connection: round trip", "cache: bytes cached", "cache: hits"]
    assert [name for name, _ in rows({"problem": "gone"})] == ["problem"]
    assert [name for name, _ in rows({"cache": "gone"})] == ["cache"]


def test_what_says_nothing_is_left_to_programs() -> None:
    link: dict[str, object] = {
        "rtt": None,
        "reboots": 0,
        "lost": False,
        "uploads": [],
        "session_open": None,
        "vehicle": None,
    }
    facts = {"connection": {**link, "write_traits": {"renames": True}}, "cache": {"bytes_held": 0, "hits": 0}}
    assert dict(rows(facts)) == {
        "cache: bytes held": "0 B",
        "connection: lost": "no",
        "connection: vehicle": "unknown",
    }


def test_sizes_and_names() -> None:
    sizes = [readable_size(n) for n in (0, 999, 999.7, 1000, 999_949, 999_999, 5e9)]
    assert sizes == ["0 B", "999 B", "1.0 kB", "1.0 kB", "999.9 kB", "1.0 MB", "5.0 GB"]
    times = [readable_time(s) for s in (0.0401, 1, 9.97, 59.4, 59.9, 200, 7500)]
    assert times == ["40 ms", "1.0 s", "10 s", "59 s", "1 min 0 s", "3 min 20 s", "2 h 5 min"]
    assert printable("a\x1b[31mb") == "a?[31mb"
