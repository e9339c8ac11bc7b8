"""client.fetch, compare, selection and names: what to fetch, skip, resume and prove, and how it is named."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import pytest

from mavftpfs.client import compare, fetch
from mavftpfs.client.fetch import Wanted
from mavftpfs.client.names import parse_paths
from mavftpfs.client.selection import Selection, latest_in, newest_first, parse_date
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
    wanted = Wanted(b"/a", "a", 100, None, tmp_path / "a", keep_old=True)
    for path, size in ((wanted.local, here), (wanted.part, part)):
        if size is not None:
            path.write_bytes(bytes(size))
    assert wanted.here is (begun is None)
    assert wanted.here or wanted.begun == begun


def test_only_files_up_to_some_size_are_proven_by_default() -> None:
    sizes = (compare.VERIFIED_BY_DEFAULT, compare.VERIFIED_BY_DEFAULT + 1)
    assert [compare.wants_checksum("auto", size) for size in sizes] == [True, False]


def log(below: str, mtime: int | None = None) -> Wanted:
    return Wanted(b"/log/" + below.encode(), below, 1, mtime, Path(below))


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
    assert [one.name for one in newest_first(logs)] == ordered


def test_which_logs_are_wished_for() -> None:
    logs = newest_first([log("a", MAY), log("b", JUNE), log("c")])
    assert [one.name for one in Selection(newest=1).of_logs(logs)] == ["b"]
    assert [one.name for one in Selection(since=MAY + 1).of_logs(logs)] == ["b", "c"]  # c may be a new one
    assert Selection(newest=9).of_logs(logs) == logs


@pytest.mark.parametrize(
    ("path", "time"),
    [
        (b"/log/2024-05-01/12_34_56.ulg", MAY),
        (b"/logs/2024-05-01_12-34-56.bin", MAY),
        (b"/log/2023-01-01/2024-05-01T12-34-56.bin", MAY),
        (b"/log/2024-05-01/note.txt", 1_714_607_999),  # the end of that day
        (b"/log/2024-13-01/12_34_56.ulg", None),
        (b"/log/sess001/log001.ulg", None),
        (b"/APM/LOGS/00000012.BIN", None),
        (b"/log/12024-05-01", None),
    ],
)
def test_times_in_paths(path: bytes, time: int | None) -> None:
    assert latest_in(path) == time


def test_patterns_see_the_path_and_the_name() -> None:
    some = Selection(include=("*.ulg", "sess001/*"), exclude=("2024-05-01/*", "log002.*"))
    taken = [b"a/b.ulg", b"sess001/x/y.txt", b"sess001/log001.ulg"]
    left = [b"a/b.ULG", b"2024-05-01/10_00_00.ulg", b"sess001/log002.ulg", b"sess002/x.txt"]
    assert [path for path in taken + left if some.takes(path)] == taken
    assert Selection().takes(b"anything")


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
    now = datetime(2026, 5, 2, 14, 30)
    assert parse_date("2024-05-01T12:34:56+00:00", now, "since") == MAY
    assert parse_date("today", now, "since") == parse_date("2026-05-02", now, "since")
    assert parse_date("yesterday", now, "since") == parse_date("2026-05-01", now, "since")
    assert parse_date("2h", now, "since") == parse_date("2026-05-02T12:30", now, "since")
    assert parse_date("90min", now, "since") == parse_date("2026-05-02T13:00", now, "since")
    assert parse_date("1w", now, "since") == now.timestamp() - 7 * 86_400


@pytest.mark.parametrize("text", ["soon", "2", "h", "-2h", "2m"])
def test_words_that_are_no_date(text: str) -> None:
    with pytest.raises(UsageError, match="2026-05-01"):
        parse_date(text, datetime.now(), "since")
