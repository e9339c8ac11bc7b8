"""oneshot: fetch, get and sync on a tree in memory, whose answers can be spoilt."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import Any, cast

import pytest
import trio

from mavftpfs.client.compare import BY_CRC32, GENERATED, Comparison, Match, Verify
from mavftpfs.client.download import Downloads, Outcome, Reports
from mavftpfs.client.fetch import (
    Fetched,
    Fetcher,
    NotProvenYet,
    Part,
    Wanted,
    known_time,
)
from mavftpfs.client.files import Files, Session
from mavftpfs.client.logs import SyncRequest, check, sync
from mavftpfs.client.progress import Progress
from mavftpfs.shared.errors import (
    Armed,
    DataUnproven,
    ExitCode,
    FileBusy,
    FtpNak,
    MavftpfsError,
    NotADirectory,
    NotFound,
    RequestTimeout,
    SessionBusy,
    UsageError,
    VehicleLost,
    exit_code_for,
)
from mavftpfs.shared.model import ROOT
from tests.ops.faketree import MTIME, FakeFile, FakeTree, session_of

BIG = bytes(range(251)) * 2000


class SpoiltTree(FakeTree):
    """A tree that can hand out wrong bytes, refuse checksums, and of which dropping the caches is counted."""

    bad = 0
    forgotten = 0
    crc_error: Exception | None = None
    reads = 0

    async def open(
        self, path: bytes, *, write: bool = False, truncate: bool = False, **more: object
    ) -> FakeFile:
        file = await super().open(path)
        self.reads += 1
        if self.bad:
            self.bad -= 1
            file.content = bytes([file.content[0] ^ 1]) + file.content[1:]
        return file

    async def crc32(self, path: bytes) -> int:
        if self.crc_error is not None:
            raise self.crc_error
        return await super().crc32(path)

    async def refresh(self) -> None:
        self.forgotten += 1


@pytest.fixture
def tree() -> SpoiltTree:
    """A vehicle with one file."""
    return SpoiltTree({b"/big": BIG})


def fetcher_of(tree: FakeTree, root: bytes = b"/", verify: Verify = "auto") -> Fetcher:
    return Fetcher(session_of(tree, root), Progress(), verify)


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def wanted(tree: FakeTree, path: bytes, local: Path) -> Wanted:
    found = tree.stat_now(path)
    mtime = known_time(found.mtime)
    return Wanted(path, path.decode(errors="replace"), found.size, mtime, local)


async def get(tree: FakeTree, path: bytes, local: Path, verify: Verify = "auto") -> Fetched:
    return await fetcher_of(tree, verify=verify).fetch(wanted(tree, path, local))


async def test_wrong_bytes_are_fetched_again_without_the_caches(tmp_path: Path, tree: SpoiltTree) -> None:
    tree.bad = 1
    fetched = await get(tree, b"/big", tmp_path / "big")
    assert (tmp_path / "big").read_bytes() == BIG
    assert tree.forgotten
    assert int((tmp_path / "big").stat().st_mtime) == MTIME
    assert (fetched.size, fetched.resumed, fetched.verified) == (len(BIG), 0, BY_CRC32)
    assert all(file.closed for file in tree.opened)
    assert names_in(tmp_path) == ["big"]


@pytest.mark.holds("promise 1")
async def test_wrong_bytes_twice_leave_nothing_and_keep_the_old_file(
    tmp_path: Path, tree: SpoiltTree
) -> None:
    tree.bad = 2
    (tmp_path / "big").write_bytes(b"old")
    with pytest.raises(DataUnproven, match=r"/big.*CRC32"):
        await get(tree, b"/big", tmp_path / "big")
    assert (tmp_path / "big").read_bytes() == b"old"
    assert names_in(tmp_path) == ["big"]


# -- going on -------------------------------------------------------------------------------------


@pytest.mark.parametrize("returns", [True, False])
async def test_a_vehicle_that_is_lost_is_waited_for(tmp_path: Path, tree: SpoiltTree, returns: bool) -> None:
    reads, asked = 0, 0

    def lose(name: str, path: bytes) -> None:
        nonlocal reads
        reads += name == "read"
        if name == "read" and reads in (3, 9):
            raise RequestTimeout("no data came")

    async def status() -> dict[str, Any]:
        nonlocal asked
        asked += 1
        return {"link": {"state": "fine" if asked % 2 == 0 and returns else "lost"}}

    tree.on_call = lose
    fetcher = Fetcher(Session(cast(Files, tree), status, ROOT, None, 1.0), Progress())
    if returns:
        fetched = await fetcher.fetch(wanted(tree, b"/big", tmp_path / "big"))
        assert (tmp_path / "big").read_bytes() == BIG
        assert fetched.resumed > 0
        assert (asked, fetched.verified) == (4, BY_CRC32)
        return
    with pytest.raises(VehicleLost):
        await fetcher.fetch(wanted(tree, b"/big", tmp_path / "big"))
    assert names_in(tmp_path) == ["big.part"]


@pytest.mark.parametrize("error", [None, FtpNak(14, 7)], ids=["by its checksum", "for want of checksums"])
async def test_a_part_of_another_file_is_not_gone_on_with(
    tmp_path: Path, tree: SpoiltTree, error: Exception | None
) -> None:
    tree.crc_error = error
    (tmp_path / "big.part").write_bytes(b"x" * 1000)
    fetched = await get(tree, b"/big", tmp_path / "big")
    assert (fetched.resumed, (tmp_path / "big").read_bytes()) == (0, BIG)


@pytest.mark.parametrize("error", [Armed("x"), RequestTimeout("x"), SessionBusy("x"), FileBusy("x")])
async def test_what_was_resumed_waits_for_its_proof(
    tmp_path: Path, tree: SpoiltTree, error: Exception
) -> None:
    tree.crc_error = error
    (tmp_path / "big.part").write_bytes(BIG[:1000])
    with pytest.raises(NotProvenYet, match="is here"):
        await get(tree, b"/big", tmp_path / "big")
    assert names_in(tmp_path) == ["big.part"]
    assert (tmp_path / "big.part").read_bytes() == BIG
    tree.crc_error = None
    await get(tree, b"/big", tmp_path / "big")
    assert names_in(tmp_path) == ["big"]


@pytest.mark.parametrize(
    ("error", "lacking", "later"),
    [
        (Armed("the vehicle is armed, and computes checksums only on the ground"), "armed", True),
        (FtpNak(14, 7), "the vehicle computes no checksums", False),
        (RequestTimeout("nobody answered within 30 s"), "no answer", True),
    ],
)
async def test_without_a_checksum_it_says_what_was_proven(
    tmp_path: Path, tree: SpoiltTree, error: Exception, lacking: str, later: bool
) -> None:
    tree.crc_error = error
    fetched = await get(tree, b"/big", tmp_path / "big")
    assert fetched.verified == Comparison(Match.UNKNOWN, "size", lacking, later)


@pytest.mark.parametrize(
    ("path", "root", "proven"),
    [(b"/@SYS/uarts.txt", b"/", False), (b"/uarts.txt", b"/@SYS", False), (b"/@MAV_LOG/1.ulg", b"/", True)],
)
async def test_what_is_made_anew_at_each_opening_is_not_proven(
    tmp_path: Path, path: bytes, root: bytes, proven: bool
) -> None:
    tree = SpoiltTree({path: b"now"})
    fetched = await fetcher_of(tree, root).fetch(wanted(tree, path, tmp_path / "x"))
    assert (tmp_path / "x").read_bytes() == b"now"
    assert (("crc32", path) in tree.calls) is proven
    assert fetched.verified == (BY_CRC32 if proven else GENERATED)


async def test_a_read_that_ends_early_is_no_file(tmp_path: Path, tree: SpoiltTree) -> None:
    tree.short_read = 0
    with pytest.raises(DataUnproven, match="ended"):
        await get(tree, b"/big", tmp_path / "big")
    assert names_in(tmp_path) == []


async def test_two_programs_do_not_write_one_part(tmp_path: Path, tree: SpoiltTree) -> None:
    tree.delays["read"] = 0.05
    async with trio.open_nursery() as nursery:
        nursery.start_soon(get, tree, b"/big", tmp_path / "big")
        await trio.sleep(0.06)
        with pytest.raises(UsageError, match="another program"):
            await get(tree, b"/big", tmp_path / "big")
    assert (tmp_path / "big").read_bytes() == BIG


async def test_a_part_that_just_got_its_name_is_not_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another program finishes the file between our open and our lock."""
    local, lock = tmp_path / "big", fcntl.flock
    local.with_name("big.part").write_bytes(BIG)

    def finish_and_lock(fd: int, how: int) -> None:
        local.with_name("big.part").replace(local)
        lock(fd, how)

    monkeypatch.setattr(fcntl, "flock", finish_and_lock)
    with pytest.raises(UsageError, match="another program"):
        Part(local.with_name("big.part"), local)
    assert local.read_bytes() == BIG


async def test_neither_a_link_nor_a_pipe_is_taken_for_a_part(tmp_path: Path) -> None:
    (tmp_path / "victim").write_bytes(b"mine")
    (tmp_path / "big.part").symlink_to(tmp_path / "victim")
    os.mkfifo(tmp_path / "pipe.part")
    for name in ("big", "pipe"):
        with pytest.raises(UsageError):
            await get(SpoiltTree({b"/big": BIG}), b"/big", tmp_path / name)
    assert (tmp_path / "victim").read_bytes() == b"mine"


async def test_a_name_that_ends_in_part_is_not_taken_from_the_vehicle(tmp_path: Path) -> None:
    """Otherwise it would be resumed as the unfinished download of another file."""
    tree = SpoiltTree({b"/d/a": b"1", b"/d/a.part": b"22"})
    outcome, said = await get_all(tree, b"/d", to=tmp_path)
    assert names_in(tmp_path / "d") == ["a"]
    assert list(outcome.failed) == [b"/d/a.part"]
    assert "would be taken for an unfinished download" in said[0]
    await get_all(tree, b"/d/a.part", to=tmp_path / "b")
    assert (tmp_path / "b").read_bytes() == b"22"


# -- get ------------------------------------------------------------------------------------------


class Noted(Reports):
    """Keeps what a run tells."""

    def __init__(self, told: list[str], said: list[str]) -> None:
        self.told, self.said = told, said

    def arrived(self, fetched: Fetched) -> None:
        self.told.append(fetched.wanted.name)

    def says(self, line: str) -> None:
        self.said.append(line)


async def get_all(
    tree: FakeTree,
    *paths: bytes,
    to: Path,
    into: bool = False,
    verify: Verify = "auto",
) -> tuple[Outcome, list[str]]:
    outcome, said = Outcome(), list[str]()
    downloads = Downloads(fetcher_of(tree, verify=verify), outcome, Noted([], said))
    await downloads.get(paths, to, into=into, recursive=True)
    return outcome, said


async def test_what_the_local_disk_refuses_is_told_in_a_line(tmp_path: Path) -> None:
    tree = SpoiltTree({b"/d/a": b"1"})
    (tmp_path / "file").write_bytes(b"in the way")
    for path, to, line in (
        (b"/d/a", tmp_path / "none" / "a", f"/d/a: {tmp_path / 'none' / 'a'}: No such file or directory"),
        (b"/d", tmp_path / "file", f"{tmp_path / 'file' / 'd'}: Not a directory"),
    ):
        outcome, said = await get_all(tree, path, to=to)
        assert said == [line]
        assert [exit_code_for(error) for error in outcome.failed.values()] == [ExitCode.USAGE]
    assert (tmp_path / "file").read_bytes() == b"in the way"


@pytest.mark.parametrize("call", [("open", b"/d/b"), ("list", b"/d/b")])
async def test_a_directory_goes_on_after_what_fails(tmp_path: Path, call: tuple[str, bytes]) -> None:
    inner = b"/d/b/x" if call[0] == "list" else b"/d/b"
    tree = SpoiltTree({b"/d/a": b"1", inner: b"2", b"/d/c": b"3"})
    tree.failing[call] = RequestTimeout("no answer")
    outcome, said = await get_all(tree, b"/d", to=tmp_path / "d")
    assert (len(outcome.fetched), list(outcome.failed), said) == (2, [b"/d/b"], ["/d/b: no answer"])
    assert not outcome.complete
    assert (tmp_path / "d/d/c").read_bytes() == b"3"


@pytest.mark.parametrize("there", [True, False])
async def test_the_same_command_goes_on_in_the_same_place(tmp_path: Path, there: bool) -> None:
    """The first run makes LOCAL, so later runs find a directory there."""
    tree, to = SpoiltTree({b"/log/d/a": BIG, b"/log/b": b"2"}), tmp_path / "gg"
    if there:
        to.mkdir()
    reads = 0

    def interrupt(name: str, path: bytes) -> None:
        nonlocal reads
        reads += name == "read"
        if reads == 5:
            raise VehicleLost("gone")

    tree.on_call = interrupt
    with pytest.raises(VehicleLost):
        await get_all(tree, b"/log", to=to)
    tree.on_call = lambda name, path: None
    outcome, _ = await get_all(tree, b"/log", to=to)
    assert sum(one.resumed for one in outcome.fetched) > 0
    assert names_in(to) == ["log"]
    assert (to / "log/d/a").read_bytes() == BIG
    tree.calls.clear()
    outcome, said = await get_all(tree, b"/log", to=to)
    assert (len(outcome.here), outcome.fetched, said) == (2, [], [])
    assert {name for name, _ in tree.calls} == {"stat", "list", "crc32"}


@pytest.mark.parametrize(
    ("change", "how", "fetched"),
    [
        ("nothing", "crc32", False),
        ("nothing", "armed", False),
        ("nothing", "verify=none", False),
        ("a byte", "crc32", True),
        ("a byte", "armed", False),
        ("its time", "crc32", False),
        ("its time", "armed", True),
        ("its time", "verify=none", True),
    ],
)
async def test_what_is_here_is_skipped_if_it_is_the_same(
    tmp_path: Path, change: str, how: str, fetched: bool
) -> None:
    tree, local = SpoiltTree({b"/d/a": BIG}), tmp_path / "a"
    await get_all(tree, b"/d/a", to=tmp_path)
    times = local.stat().st_mtime
    if change == "a byte":
        local.write_bytes(b"?" + BIG[1:])
    os.utime(local, (times, times + 10 * (change == "its time")))
    tree.crc_error = Armed("in flight") if how == "armed" else None
    verify: Verify = "none" if how == "verify=none" else "auto"
    outcome, _ = await get_all(tree, b"/d/a", to=tmp_path, verify=verify)
    assert ([one.wanted.name for one in outcome.fetched] == ["/d/a"]) is fetched
    assert (outcome.here == []) is fetched
    if fetched:
        assert local.read_bytes() == BIG
    assert outcome.lacking == ({"armed": 1} if how == "armed" else {})


async def test_what_is_made_anew_at_each_opening_is_never_skipped(tmp_path: Path) -> None:
    tree = SpoiltTree({b"/@SYS/uarts.txt": b"1"})
    await get_all(tree, b"/@SYS/uarts.txt", to=tmp_path)
    tree.files[b"/@SYS/uarts.txt"] = b"2"
    await get_all(tree, b"/@SYS/uarts.txt", to=tmp_path)
    assert (tmp_path / "uarts.txt").read_bytes() == b"2"


@pytest.mark.parametrize(
    ("pattern", "come"),
    [
        (b"/l/*.ulg", ["a.ulg", "b.ulg"]),
        (b"/l/[b-c].*", ["b.ulg"]),
        (b"/?/a.ulg", ["l/a.ulg"]),
        (b"/l/*", ["[odd]", "a.ulg", "b.ulg"]),
        (b"/*/.*", ["l/.x"]),
        (b"/l/[odd]", ["[odd]"]),
    ],
)
async def test_patterns(tmp_path: Path, pattern: bytes, come: list[str]) -> None:
    files = {b"/l/a.ulg": b"1", b"/l/b.ulg": b"2", b"/l/.x": b"3", b"/l/[odd]": b"4", b"/f": b"5"}
    for _ in range(2):
        outcome, _ = await get_all(SpoiltTree(dict(files)), pattern, to=tmp_path / "new", into=True)
    new = tmp_path / "new"
    assert sorted(str(path.relative_to(new)) for path in new.rglob("*") if path.is_file()) == come
    assert len(outcome.here) == len(come)


TWINS = {b"/fs/log/1/a.ulg": b"one", b"/fs/log/2/a.ulg": b"two", b"/fs/log/2/b.ulg": b"three"}


@pytest.mark.parametrize("pattern", [b"/fs/log/*/*.ulg", b"/fs/log/*", b"/fs/l*"])
async def test_a_pattern_keeps_the_directories_from_its_first_wildcard_on(
    tmp_path: Path, pattern: bytes
) -> None:
    """Logs of two days often have one name."""
    await get_all(SpoiltTree(dict(TWINS)), pattern, to=tmp_path / "logs")
    top = tmp_path / "logs" / ("log" if pattern.endswith(b"l*") else "")
    assert [(top / name).read_bytes() for name in ("1/a.ulg", "2/a.ulg", "2/b.ulg")] == [*TWINS.values()]


@pytest.mark.parametrize(
    "paths", [(b"/fs/log/1/a.ulg", b"/fs/log/2/a.ulg"), (b"/fs/log/1/*", b"/fs/log/2/*")]
)
async def test_two_files_of_one_local_name_are_refused_before_anything_is_fetched(
    tmp_path: Path, paths: tuple[bytes, ...]
) -> None:
    with pytest.raises(
        UsageError, match=r"/fs/log/1/a\.ulg and /fs/log/2/a\.ulg would both become .*/a\.ulg"
    ):
        await get_all(SpoiltTree(dict(TWINS)), *paths, to=tmp_path)
    assert names_in(tmp_path) == []


async def test_a_file_that_is_named_twice_comes_once(tmp_path: Path) -> None:
    outcome, _ = await get_all(SpoiltTree(dict(TWINS)), b"/fs/log/2/*", b"/fs/log/2/b.ulg", to=tmp_path)
    assert (len(outcome.fetched), names_in(tmp_path)) == (2, ["a.ulg", "b.ulg"])


async def test_a_pattern_for_one_file_means_a_directory_all_the_same(tmp_path: Path) -> None:
    await get_all(SpoiltTree({b"/l/a": b"1"}), b"/l/*", to=tmp_path / "new")
    assert names_in(tmp_path / "new") == ["a"]
    outcome, said = await get_all(SpoiltTree({b"/l/a": b"1"}), b"/l/*.bin", to=tmp_path / "new")
    assert (said, [type(error) for error in outcome.failed.values()]) == (
        ["nothing matches /l/*.bin"],
        [NotFound],
    )


# -- sync -----------------------------------------------------------------------------------------

LOGS = {
    b"/fs/microsd/log/d/1.ulg": b"one",
    b"/fs/microsd/log/d/2.ulg": b"second",
    b"/fs/microsd/x": b"no log",
}


async def synced(
    tree: FakeTree,
    local: Path,
    *,
    root: bytes = b"/",
    verify: Verify = "auto",
) -> tuple[Outcome, list[str], list[str]]:
    outcome, told, said = Outcome(), list[str](), list[str]()
    fetcher = fetcher_of(tree, root, verify)
    downloads = Downloads(fetcher, outcome, Noted(told, said))
    try:
        await sync(downloads, SyncRequest(local))
    except MavftpfsError as exc:
        said.append(repr(exc))
    return outcome, told, said


@pytest.mark.parametrize(
    ("files", "root", "place"),
    [
        (LOGS, b"/", b"/fs/microsd/log"),
        ({b"/APM/LOGS/1.BIN": b"1"}, b"/", b"/APM/LOGS"),
        ({b"/logs/1.BIN": b"1"}, b"/", b"/logs"),
        ({b"/log/d/1.ulg": b"1"}, b"/", b"/log"),
        ({b"/@MAV_LOG/1.ulg": b"1", b"/log/d/1.ulg": b"1"}, b"/", b"/log"),
        ({b"/@MAV_LOG/1.ulg": b"1"}, b"/", b"/@MAV_LOG"),
        ({b"/log/d/1.ulg": b"1"}, b"/fs/microsd", b"/fs/microsd/log"),
        ({b"/1.ulg": b"1"}, b"/fs/microsd/log/sess001", b"/fs/microsd/log/sess001"),
    ],
)
async def test_the_logs_are_found(
    tmp_path: Path, files: dict[bytes, bytes], root: bytes, place: bytes
) -> None:
    outcome, told, _ = await synced(SpoiltTree(dict(files)), tmp_path, root=root)
    assert outcome.place == place
    assert told


async def test_the_card_s_copy_of_our_memory_does_not_replace_it(tmp_path: Path) -> None:
    memory = tmp_path / ".mavftpfs-logs"
    memory.write_text("ours\n")
    _, told, _ = await synced(SpoiltTree({**LOGS, b"/fs/microsd/log/.mavftpfs-logs": b"theirs"}), tmp_path)
    assert told == ["d/2.ulg", "d/1.ulg"]
    assert memory.read_text() == "ours\n"


@pytest.mark.parametrize("new", [b"other and longer", b"x"])
async def test_another_log_of_that_name_does_not_destroy_the_old_one(tmp_path: Path, new: bytes) -> None:
    """ArduPilot counts from 1 again after its logs were erased."""
    tree = SpoiltTree({b"/APM/LOGS/1.BIN": b"flight of May"})
    await synced(tree, tmp_path)
    tree.files[b"/APM/LOGS/1.BIN"] = new
    outcome, _, _ = await synced(tree, tmp_path)
    assert outcome.complete
    assert (tmp_path / "1.BIN").read_bytes() == new
    assert (tmp_path / "1.BIN.~1~").read_bytes() == b"flight of May"
    assert outcome.fetched[0].kept_words == "; another one of that name is kept as 1.BIN.~1~"


async def test_a_log_that_was_fetched_while_armed_is_proven_later(tmp_path: Path) -> None:
    tree = SpoiltTree({b"/log/1": b"one", b"/log/2": b"two"})
    tree.crc_error = Armed("in flight")
    for moved in (6, 0):
        outcome, _, said = await synced(tree, tmp_path)
        assert sum(one.size - one.resumed for one in outcome.fetched) == moved
        assert (outcome.lacking, said, outcome.complete) == ({"armed": 2}, [], True)
    (tmp_path / "2").write_bytes(b"TWO")
    tree.crc_error = None
    outcome, _, _ = await synced(tree, tmp_path)
    assert {name: (tmp_path / name).read_bytes() for name in names_in(tmp_path) if name[0] != "."} == {
        "1": b"one",
        "2": b"two",
        "2.~1~": b"TWO",
    }
    assert outcome.verified == {b"/log/1": BY_CRC32, b"/log/2": BY_CRC32}
    tree.calls.clear()
    await synced(tree, tmp_path)
    assert not any(name == "crc32" for name, _ in tree.calls)


async def test_all_that_is_here_is_proven_if_that_is_wished_for(tmp_path: Path) -> None:
    tree = SpoiltTree({b"/log/1": b"one", b"/log/2": b"two"})
    await synced(tree, tmp_path)
    assert names_in(tmp_path) == ["1", "2"]
    (tmp_path / "2").write_bytes(b"TWO")
    assert len((await synced(tree, tmp_path))[0].here) == 2
    outcome, _, _ = await synced(tree, tmp_path, verify="all")
    assert ([log.name for log in outcome.here], [one.wanted.name for one in outcome.fetched]) == (
        ["1"],
        ["2"],
    )
    assert names_in(tmp_path) == ["1", "2", "2.~1~"]
    assert (tmp_path / "2").read_bytes() == b"two"


async def checked(tree: FakeTree, local: Path) -> Outcome:
    outcome = Outcome()
    fetcher = fetcher_of(tree, verify="none")
    await check(Downloads(fetcher, outcome), SyncRequest(local))
    return outcome


async def test_check_compares_and_fetches_nothing(tmp_path: Path) -> None:
    tree = SpoiltTree({b"/log/1": b"one", b"/log/2": b"two", b"/log/3": b"three", b"/log/4": b"four"})
    for name, data in (("1", b"one"), ("2", b"TWO"), ("3", b"thr")):
        (tmp_path / name).write_bytes(data)
    outcome = await checked(tree, tmp_path)
    assert tree.reads == 0
    assert names_in(tmp_path) == ["1", "2", "3"]
    assert [log.remote for log in outcome.wanted] == [b"/log/4"]
    assert outcome.differing.keys() == {b"/log/2", b"/log/3"}
    assert b"/log/1" in {log.remote for log in outcome.here}
    assert outcome.differing[b"/log/3"] == "3 bytes here, 5 on the vehicle"
    assert not outcome.complete
    for path, data in tree.files.items():
        (tmp_path / path.decode().rpartition("/")[2]).write_bytes(data)
    assert (await checked(tree, tmp_path)).complete


@pytest.mark.parametrize("what", ["LOCAL", "--from"])
async def test_a_file_where_a_directory_is_needed_is_said(tmp_path: Path, what: str) -> None:
    (tmp_path / "file").write_bytes(b"1")
    tree = SpoiltTree({b"/log/1": b"one"})
    downloads = Downloads(fetcher_of(tree), Outcome())
    place, local = (b"/log/1", tmp_path) if what == "--from" else (None, tmp_path / "file")
    with pytest.raises((UsageError, NotADirectory), match="is a file"):
        await sync(downloads, SyncRequest(local, place))
