"""oneshot: fetching with proof, on a tree in memory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest

from mavftpfs import oneshot
from mavftpfs.cache.tree import Tree
from mavftpfs.link.messages import Address, Heartbeat
from mavftpfs.oneshot import Fetched, _Getter
from mavftpfs.report import SilentMeter
from mavftpfs.shared.errors import Armed, DataUnproven, FtpNak, RequestTimeout, UsageError
from tests.ops.faketree import MTIME, FakeFile, FakeTree

BIG = bytes(range(251)) * 2000


class SpoiltTree(FakeTree):
    """Spoils the first `bad` files that are opened; forgetting the caches is counted."""

    bad = 0
    forgotten = 0
    crc_error: Exception | None = None

    async def open(self, path: bytes, *, write: bool = False, truncate: bool = False) -> FakeFile:
        file = await super().open(path)
        if self.bad:
            self.bad -= 1
            file.content = bytes([file.content[0] ^ 1]) + file.content[1:]
        return file

    async def crc32(self, path: bytes) -> int:
        if self.crc_error is not None:
            raise self.crc_error
        return await super().crc32(path)

    def forget_caches(self) -> None:
        self.forgotten += 1


def getter(tree: FakeTree, *, virtual_root: bool = False) -> _Getter:
    return _Getter(cast(Tree, tree), SilentMeter(), virtual_root)


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


async def get(tree: FakeTree, path: bytes, local: Path) -> Fetched:
    return await getter(tree).get(path, local, tree.stat_now(path))


async def test_a_file_arrives_proven_with_its_time(tmp_path: Path) -> None:
    tree = SpoiltTree({b"/big": BIG})
    fetched = await get(tree, b"/big", tmp_path / "big")
    assert (tmp_path / "big").read_bytes() == BIG
    assert int((tmp_path / "big").stat().st_mtime) == MTIME
    assert (fetched.size, fetched.proof) == (len(BIG), "size and CRC32")
    assert all(file.closed for file in tree.opened)
    assert names_in(tmp_path) == ["big"]


async def test_an_empty_file(tmp_path: Path) -> None:
    await get(SpoiltTree({b"/none": b""}), b"/none", tmp_path / "none")
    assert (tmp_path / "none").read_bytes() == b""


async def test_wrong_bytes_are_fetched_again_without_the_caches(tmp_path: Path) -> None:
    tree = SpoiltTree({b"/big": BIG})
    tree.bad = 1
    await get(tree, b"/big", tmp_path / "big")
    assert (tmp_path / "big").read_bytes() == BIG
    assert tree.forgotten == 1


async def test_wrong_bytes_twice_leave_nothing_and_keep_the_old_file(tmp_path: Path) -> None:
    tree = SpoiltTree({b"/big": BIG})
    tree.bad = 2
    (tmp_path / "big").write_bytes(b"old")
    with pytest.raises(DataUnproven, match="CRC32"):
        await get(tree, b"/big", tmp_path / "big")
    assert (tmp_path / "big").read_bytes() == b"old"
    assert names_in(tmp_path) == ["big"]


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (Armed("x"), "armed"),
        (FtpNak(14, 7), "refused"),
        (RequestTimeout("x"), "did not answer"),
    ],
)
async def test_without_a_checksum_it_says_what_was_proven(
    tmp_path: Path, error: Exception, words: str
) -> None:
    tree = SpoiltTree({b"/big": BIG})
    tree.crc_error = error
    fetched = await get(tree, b"/big", tmp_path / "big")
    assert fetched.proof.startswith("size (")
    assert words in fetched.proof


@pytest.mark.parametrize(("path", "virtual_root"), [(b"/@SYS/uarts.txt", False), (b"/uarts.txt", True)])
async def test_generated_files_are_not_checksummed(tmp_path: Path, path: bytes, virtual_root: bool) -> None:
    tree = SpoiltTree({path: b"now"})
    tree.crc_error = AssertionError("asked")
    await getter(tree, virtual_root=virtual_root).get(path, tmp_path / "x", tree.stat_now(path))
    assert (tmp_path / "x").read_bytes() == b"now"


async def test_a_read_that_ends_early_is_no_file(tmp_path: Path) -> None:
    tree = SpoiltTree({b"/big": BIG})
    tree.short_read = 0
    with pytest.raises(DataUnproven, match="ended"):
        await get(tree, b"/big", tmp_path / "big")
    assert names_in(tmp_path) == []


async def test_no_file_of_the_users_is_taken_for_a_part(tmp_path: Path) -> None:
    (tmp_path / "big.part").write_bytes(b"the user's")
    await get(SpoiltTree({b"/big": BIG}), b"/big", tmp_path / "big")
    assert (tmp_path / "big.part").read_bytes() == b"the user's"
    assert names_in(tmp_path) == ["big", "big.part"]


async def test_what_the_local_disk_refuses_is_told_in_a_line(tmp_path: Path) -> None:
    tree = SpoiltTree({b"/d/a": b"1"})
    (tmp_path / "file").write_bytes(b"in the way")
    for path, place in ((b"/d/a", tmp_path / "none" / "a"), (b"/d", tmp_path / "file")):
        with pytest.raises(UsageError, match=f"^{place}: (No such file|File exists)"):
            await getter(tree).get_tree(path, place, tree.stat_now(path), lambda _: None)
    assert (tmp_path / "file").read_bytes() == b"in the way"


async def test_a_directory_with_all_below(tmp_path: Path) -> None:
    files = {b"/d/a": b"1", b"/d/e/b": b"2", b"/d/e/f/\xff": b"3"}
    tree = SpoiltTree(dict(files), {b"/d/empty"})
    told: list[Fetched] = []
    await getter(tree).get_tree(b"/d", tmp_path / "d", tree.stat_now(b"/d"), told.append)
    found = {path for path in (tmp_path / "d").rglob("*") if path.is_file()}
    assert {bytes(path.relative_to(tmp_path)): path.read_bytes() for path in found} == {
        path[1:]: content for path, content in files.items()
    }
    assert (tmp_path / "d" / "empty").is_dir()
    assert [fetched.remote for fetched in told] == [b"/d/a", b"/d/e/b", b"/d/e/f/\xff"]


@pytest.mark.parametrize(
    ("local", "single", "expected"),
    [(".", True, "./f"), (".", False, "./f"), ("new", True, "new"), ("new", False, "new/f")],
)
def test_local_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, local: str, single: bool, expected: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert oneshot._local_name(Path(local), b"/a/f", single=single) == Path(expected)


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["/a//b/", "c"], ([b"/a/b", b"/c"], None)),
        (["mftp://comp=5:/a", "mftp://[;comp=5]b", "/c"], ([b"/a", b"/b", b"/c"], 5)),
        (["mftp://@SYS/x"], ([b"/@SYS/x"], None)),
    ],
)
def test_paths(texts: list[str], expected: tuple[list[bytes], int | None]) -> None:
    assert oneshot.parse_paths(texts) == expected


@pytest.mark.parametrize("text", ["../x", "/a/../b", "a\0b", "mftp://comp=0:/x"])
def test_paths_that_cannot_be(text: str) -> None:
    with pytest.raises(UsageError):
        oneshot.parse_paths([text])


@pytest.mark.parametrize(
    ("kind", "autopilot", "mode", "words"),
    [
        (2, 12, 0x80, "PX4, armed"),
        (2, 3, 0, "ArduPilot, disarmed"),
        (6, 8, 0, "ground station"),
        (18, 8, 0, "component (type 18)"),
        (1, 99, 0, "autopilot type 99"),
    ],
)
def test_what_a_heartbeat_says(kind: int, autopilot: int, mode: int, words: str) -> None:
    assert words in oneshot.describe_peer(Heartbeat(Address(1, 1), kind, autopilot, mode, 4))


def test_the_silent_meter_takes_anything() -> None:
    advance: Callable[[int], None] = SilentMeter().start("x", 5)
    advance(3)
