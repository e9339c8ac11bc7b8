"""oneshot: put, rm, mkdir, rmdir and mv, on a tree in memory."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, cast

import pytest
import trio
import trio.testing

from mavftpfs.client import names
from mavftpfs.client.files import Files, Session
from mavftpfs.client.progress import Progress
from mavftpfs.client.upload import collect, put_paths
from mavftpfs.shared.errors import (
    AlreadyExists,
    CrossDevice,
    DirectoryNotEmpty,
    ExitCode,
    InvalidMove,
    IsADirectory,
    LinkClosed,
    MavftpfsError,
    NotADirectory,
    NotDelivered,
    NotFound,
    RequestTimeout,
    UsageError,
    VehicleLost,
    exit_code_for,
)
from mavftpfs.shared.model import EntryKind, split
from tests.ops.faketree import FakeTree, session_of

BIG = bytes(range(251)) * 2000


class Card(FakeTree):
    """A tree with the refusals of mkdir and rmdir; can be unable to rename."""

    renames = True

    async def mkdir(self, path: bytes, *, on_card: bool = False) -> None:
        try:
            self.kind_of(path)
        except NotFound:
            if self.kind_of(split(path)[0]) is EntryKind.DIRECTORY:
                await super().mkdir(path)
                return
        raise AlreadyExists(f"{path!r} is there")

    async def rmdir(self, path: bytes) -> None:
        if await self.list(path):
            raise DirectoryNotEmpty(f"{path!r} is not empty")
        await super().rmdir(path)

    async def rename(self, old: bytes, new: bytes, *, noreplace: bool = False, on_card: bool = False) -> None:
        if not self.renames:
            raise CrossDevice("this server cannot rename")
        await super().rename(old, new, noreplace=noreplace)


@pytest.fixture
def local(tmp_path: Path) -> Path:
    """A directory with something of everything."""
    root = tmp_path / "d"
    (root / "e" / "f").mkdir(parents=True)
    (root / "a").write_bytes(BIG)
    (root / "e" / "none").write_bytes(b"")
    with open(os.fsencode(root / "e") + b"/\xff", "wb") as file:
        file.write(b"3")
    return root


async def put(
    tree: Card, *locals_: Path, to: bytes, recursive: bool = False, into: bool = False
) -> list[bytes]:
    told: list[bytes] = []
    batches = [(local, collect(local, recursive=recursive)) for local in locals_]
    progress = Progress()
    await put_paths(
        session_of(tree), batches, to, progress, lambda remote, _, __: told.append(remote), into=into
    )
    assert (progress.files_done, progress.name, progress.done) == (len(told), "", progress.total)
    assert all(file.closed for file in tree.opened)
    return told


@pytest.mark.parametrize(("to", "place"), [(b"/there", b"/there/d"), (b"/new", b"/new")])
async def test_a_directory_with_all_below(local: Path, to: bytes, place: bytes) -> None:
    tree = Card({}, {b"/there"})
    told = await put(tree, local, to=to, recursive=True)
    expected = {place + b"/a": BIG, place + b"/e/none": b"", place + b"/e/\xff": b"3"}
    assert tree.files == expected
    assert place + b"/e/f" in tree.directories
    assert set(told) == expected.keys()


async def test_two_files_of_one_name_are_refused_before_anything_is_sent(local: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    (other / "d").mkdir(parents=True)
    (other / "d" / "a").write_bytes(b"another")
    tree = Card({}, {b"/there"})
    for locals_ in ((local / "a", other / "d" / "a"), (local, other / "d")):
        with pytest.raises(UsageError, match=f"{local}/a and {other}/d/a would both become /there/"):
            await put(tree, *locals_, to=b"/there", recursive=True)
    assert (tree.files, tree.directories - {b"/"}) == ({}, {b"/there"})
    (other / "d" / "a").rename(other / "d" / "b")
    told = await put(tree, local, other / "d", local, to=b"/there", recursive=True)
    assert {b"/there/d/a", b"/there/d/b"} < set(told)


@pytest.mark.parametrize(("to", "error"), [(b"/f", NotADirectory), (b"/none", NotFound)])
async def test_a_path_that_ends_in_a_slash_is_a_directory(
    local: Path, to: bytes, error: type[MavftpfsError]
) -> None:
    tree = Card({b"/f": b"old", b"/x": b"x"}, {b"/there"})
    with pytest.raises(error, match=f"{to.decode()}/"):
        await put(tree, local / "a", to=to, into=True)
    with pytest.raises(error, match=f"{to.decode()}/"):
        await names.move_paths(session_of(tree), [b"/x"], to, into=True)
    assert tree.files == {b"/f": b"old", b"/x": b"x"}
    assert await put(tree, local / "a", to=b"/there", into=True) == [b"/there/a"]
    assert len(await put(tree, local, to=b"/new", recursive=True, into=True)) == 3


@pytest.mark.parametrize("what", ["directory", "missing", "fifo", "link to a directory"])
def test_what_cannot_be_put_is_said_before_anything_is_sent(local: Path, tmp_path: Path, what: str) -> None:
    place = local
    match what:
        case "missing":
            place = tmp_path / "nothing"
        case "fifo":
            os.mkfifo(place := tmp_path / "fifo")
        case "link to a directory":
            (local / "e" / "link").symlink_to(local)
    with pytest.raises(UsageError) as caught:
        collect(place, recursive=what == "link to a directory")
    assert "directory" in str(caught.value) or "does not exist" in str(caught.value)


@pytest.mark.parametrize("call", ["create", "write", "fsync"])
async def test_what_does_not_arrive_is_undelivered(local: Path, call: str) -> None:
    tree = Card({}, {b"/d"})
    tree.failing[call, b"/d/d/e/\xff"] = RequestTimeout("no answer")
    with pytest.raises(NotDelivered, match=r"xff was not delivered: no answer; 2 file\(s\)") as caught:
        await put(tree, local, to=b"/d", recursive=True)
    assert exit_code_for(caught.value) is ExitCode.UNDELIVERED
    assert all(file.closed for file in tree.opened)


@pytest.mark.parametrize("to", [b"/d/x", b"/d"])
async def test_a_link_that_is_gone_before_anything_is_sent_is_undelivered_too(local: Path, to: bytes) -> None:
    tree = Card({b"/d/x": b"old"}, {b"/d"})
    tree.failing["stat", to] = VehicleLost("silent")
    with pytest.raises(NotDelivered, match=f"{to.decode()} was not delivered: silent") as caught:
        await put(tree, local, to=to, recursive=True)
    assert caught.value.there is False
    assert tree.files == {b"/d/x": b"old"}


async def test_a_missing_directory_is_that_and_no_undelivered_file(local: Path) -> None:
    tree = Card({}, {b"/d"})

    def look(name: str, path: bytes) -> None:
        if name == "create":
            tree.kind_of(split(path)[0])

    tree.on_call = look
    with pytest.raises(NotFound, match="/none/a was not delivered") as caught:
        await put(tree, local / "a", to=b"/none/a")
    assert exit_code_for(caught.value) is ExitCode.USAGE


# -- names ----------------------------------------------------------------------------------------


async def rm(tree: Card, *paths: bytes, recursive: bool = False) -> None:
    await names.remove_paths(session_of(tree), paths, recursive=recursive)


@pytest.mark.parametrize(
    ("paths", "recursive", "error"),
    [
        ([b"/a", b"/d"], False, IsADirectory),
        ([b"/a", b"/nothing"], True, NotFound),
    ],
)
async def test_rm_looks_before_it_removes(
    paths: list[bytes], recursive: bool, error: type[MavftpfsError]
) -> None:
    tree = Card({b"/a": b"", b"/d/x": b""})
    with pytest.raises(error):
        await rm(tree, *paths, recursive=recursive)
    assert tree.files == {b"/a": b"", b"/d/x": b""}


async def mv(tree: Card, *paths: bytes, to: bytes) -> None:
    await names.move_paths(session_of(tree), paths, to)


async def test_mv_copies_where_the_server_cannot_rename() -> None:
    tree = Card({b"/d/a": BIG, b"/d/e/b": b"", b"/x": b"1"}, {b"/d", b"/d/e"})
    tree.renames = False
    await mv(tree, b"/d", to=b"/new")
    assert tree.files == {b"/new/a": BIG, b"/new/e/b": b"", b"/x": b"1"}
    assert b"/d" not in tree.directories
    assert all(file.closed for file in tree.opened)


@pytest.mark.holds("promise 3")
@pytest.mark.parametrize("renames", [True, False])
async def test_the_root_is_not_moved_into_a_part_of_itself(renames: bool) -> None:
    tree = Card({b"/d/a": b"1", b"/e/b": b"2"})
    tree.renames = renames
    with pytest.raises(InvalidMove, match="root"):
        await mv(tree, b"/", to=b"/d/new")
    assert tree.files == {b"/d/a": b"1", b"/e/b": b"2"}
    assert tree.directories == set()


async def test_mv_ends_where_the_source_has_shrunk_meanwhile() -> None:
    tree = Card({b"/a": BIG}, short_read=0)
    tree.renames = False
    with trio.fail_after(5.0), pytest.raises(NotDelivered, match="ended at 0 of") as caught:
        await mv(tree, b"/a", to=b"/new")
    assert caught.value.there is False
    assert tree.files == {b"/a": BIG}


# -- by a mount -----------------------------------------------------------------------------------


async def test_a_mount_that_does_not_tell_how_far_it_is_ends_no_put(
    local: Path, autojump_clock: trio.testing.MockClock
) -> None:
    tree = Card(delays={"fsync": 5.0})

    async def status() -> dict[str, Any]:
        raise LinkClosed("the mount does not answer")

    session = Session(cast(Files, tree), status, mountpoint="/mnt/drone")
    batch = (local / "a", collect(local / "a", recursive=False))
    await put_paths(session, [batch], b"/x", Progress(), print)
    assert tree.files == {b"/x": BIG}
