"""client.fetch, download, proof and names: what to fetch, skip, resume and prove, and how it is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from mavftpfs.cli.verbs import parse_date
from mavftpfs.client import download, fetch, proof
from mavftpfs.client.fetch import Wanted
from mavftpfs.client.names import parse_paths
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


def test_only_files_up_to_some_size_are_proven_by_default() -> None:
    sizes = (proof.PROVEN_BY_DEFAULT, proof.PROVEN_BY_DEFAULT + 1)
    assert [proof.proof_needed("auto", resumed=False, size=size) for size in sizes] == [True, False]


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
