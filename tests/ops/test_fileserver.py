"""mount.fileserver and client.mountfiles over a real socket, on a tree in memory."""

from __future__ import annotations

import json
import socket
import struct
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import cast

import pytest
import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.client import wire
from mavftpfs.client.control import Reply
from mavftpfs.client.files import Files, written
from mavftpfs.client.mountfiles import MountFile, MountFiles, connect
from mavftpfs.client.mounts import require_usable
from mavftpfs.mount import fileserver
from mavftpfs.mount.controlserver import ControlServer
from mavftpfs.mount.fileserver import TELLING_TIME, FileServer, Served
from mavftpfs.mount.handles import InodeTable, Presentation
from mavftpfs.mount.invalidator import Invalidator
from mavftpfs.mount.operations import Operations
from mavftpfs.shared.errors import (
    FtpNak,
    LinkClosed,
    ListingIncomplete,
    MavftpfsError,
    NotDelivered,
    NotFound,
    NotSupported,
    ReadOnly,
)
from mavftpfs.shared.model import EntryKind
from tests.ops.faketree import FakeTree

LOOK = Presentation(1000, 1000, 0o644, 0o755, op_deadline=30.0)
DATA = bytes(range(256)) * 4096
PATIENCE = 60.0


class Kernel(Invalidator):
    """Notes what it is told among the calls of the tree. gate: holds it up."""

    def __init__(self, tree: FakeTree) -> None:
        self.inodes = InodeTable()
        self.gate = threading.Event()
        self.gate.set()
        self._tree = tree
        super().__init__(self.inodes, self._pages, self._name)

    def _pages(self, ino: int, attr_only: bool) -> None:
        self.gate.wait(60)
        self._tree.calls.append(("pages", b"%d" % ino))

    def _name(self, parent: int, name: bytes) -> None:
        self.gate.wait(60)
        self._tree.calls.append(("name", name))

    def told(self) -> list[str]:
        """Return the kinds of calls until now, and forget them."""
        kinds = [kind for kind, _ in self._tree.calls]
        self._tree.calls.clear()
        return kinds


class Mount:
    """A server of a tree at a socket."""

    def __init__(self, path: Path, tree: FakeTree) -> None:
        self.path = path
        self.tree = tree
        self.kernel = Kernel(tree)
        operations = Operations(cast(Tree, tree), LOOK, inodes=self.kernel.inodes)
        served = Served(cast(Tree, tree), operations, self.kernel, lambda: {"link": {"state": "fine"}})
        self.files = FileServer(served)
        self.server = ControlServer(path, {"files": self._grant, "echo": self._echo}, files=self.files)

    async def _grant(self, request: Reply) -> Reply:
        refusal = self.files.refusal()
        if refusal:
            raise MavftpfsError(refusal)
        return {"id": "this"}

    async def _echo(self, request: Reply) -> Reply:
        return {"heard": request["word"]}

    def client(self, root: bytes = b"/") -> MountFiles:
        """Return the files of a client of its own."""
        status = {"socket": str(self.path), "id": "this"}
        return MountFiles(partial(connect, status, "/mnt/drone"), "/mnt/drone", b"/", root)

    async def raw(self) -> socket.socket:
        """Return a connection that was granted files."""

        def granted() -> socket.socket:
            client = socket.socket(socket.AF_UNIX)
            client.connect(str(self.path))
            client.sendall(b'{"command": "files", "version": 1}\n')
            assert json.loads(client.recv(4096)) == {"ok": True, "id": "this"}
            return client

        return await trio.to_thread.run_sync(granted)

    async def serves(self) -> None:
        """Check that another client is served."""
        with trio.fail_after(PATIENCE):
            files = self.client()
            assert (await files.stat(b"/f")).size == len(DATA)
            file = await files.open(b"/f")
            assert await file.read(0, 10**9) == DATA
            await file.release()
            files.close()


@asynccontextmanager
async def serving(tmp_path: Path, tree: FakeTree | None = None) -> AsyncIterator[Mount]:
    mount = Mount(tmp_path / "s", tree or FakeTree({b"/f": DATA}))
    async with trio.open_nursery() as nursery:
        await nursery.start(mount.server.run)
        nursery.start_soon(mount.kernel.run)
        yield mount
        mount.server.close()
        with trio.fail_after(PATIENCE):
            await mount.files.close()
            await mount.server.closed.wait()
        nursery.cancel_scope.cancel()


async def until(condition: Callable[[], bool]) -> None:
    with trio.fail_after(PATIENCE):
        while not condition():  # noqa: ASYNC110
            await trio.sleep(0.005)


# -- the same as without a mount ------------------------------------------------------------------

CALLS: dict[str, Callable[[Files], Awaitable[object]]] = {
    "stat": lambda files: files.stat(b"/f"),
    "stat nothing": lambda files: files.stat(b"/no\xff"),
    "list": lambda files: files.list(b"/"),
    "list a file": lambda files: files.list(b"/f"),
    "crc32": lambda files: files.crc32(b"/f"),
    "mkdir": lambda files: files.mkdir(b"/d"),
    "rmdir": lambda files: files.rmdir(b"/d"),
    "rename": lambda files: files.rename(b"/f", b"/g"),
    "unlink": lambda files: files.unlink(b"/f"),
    "open a directory": lambda files: files.open(b"/"),
    "create": lambda files: files.create(b"/f", exclusive=True),
}


async def outcome(call: Callable[[Files], Awaitable[object]], files: Files) -> object:
    try:
        return await call(files)
    except MavftpfsError as error:
        return type(error), str(error), {k: v for k, v in vars(error).items() if k != "entries"}


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("error", [None, FtpNak(8, 2, 30), ReadOnly("armed"), ListingIncomplete("cut", [])])
async def test_a_call_has_one_outcome_with_and_without_a_mount(
    tmp_path: Path, name: str, error: MavftpfsError | None
) -> None:
    here, there = FakeTree({b"/f": DATA}, error=error), FakeTree({b"/f": DATA}, error=error)
    async with serving(tmp_path, there) as mount:
        files = mount.client()
        assert await outcome(CALLS[name], files) == await outcome(CALLS[name], cast(Files, here))
        files.close()
    assert (here.files, here.directories) == (there.files, there.directories)


async def test_a_subtree_is_the_client_s(tmp_path: Path) -> None:
    async with serving(tmp_path, FakeTree({b"/d/f": DATA})) as mount:
        files = mount.client(b"/d")
        assert (await files.stat(b"/f")).kind is EntryKind.FILE
        files.close()


async def test_a_file_is_written_and_read_in_pieces(tmp_path: Path) -> None:
    async with serving(tmp_path) as mount:
        files = mount.client()
        file = await files.create(b"/new", exclusive=True)
        assert await file.write(0, DATA) == len(DATA) == file.size
        await file.truncate(700_000)
        await file.fsync()
        assert mount.tree.files[b"/new"] == DATA[:700_000]
        assert await file.read(600_000, 10**9) == DATA[600_000:700_000]
        await file.release()
        await file.release()
        assert mount.files.users == []
        files.close()


# -- many clients, and those that end anyhow ------------------------------------------------------


async def test_fifty_clients_at_once(tmp_path: Path) -> None:
    async def work(mount: Mount, number: int) -> None:
        files, path = mount.client(), b"/%d" % number
        file = await files.create(path, exclusive=True)
        async with written(file):
            await file.write(0, DATA)
        source = await files.open(b"/f")
        assert await source.read(0, len(DATA)) == DATA
        await source.release()
        files.close()

    async with serving(tmp_path) as mount:
        with trio.fail_after(PATIENCE):
            async with trio.open_nursery() as nursery:
                for number in range(50):
                    nursery.start_soon(work, mount, number)
        assert mount.tree.files == {b"/f": DATA, **{b"/%d" % number: DATA for number in range(50)}}


async def test_status_and_umount_have_places_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fileserver, "MAX_CONNECTIONS", 20)
    async with serving(tmp_path) as mount:
        files = mount.client()
        opened = [await files.open(b"/f") for _ in range(20)]
        with pytest.raises(LinkClosed, match="20 files of this mount are open"):
            await files.open(b"/f")
        stream = await trio.open_unix_socket(str(mount.path))
        await stream.send_all(b'{"command": "echo", "word": "hi"}\n')
        with trio.fail_after(PATIENCE):
            assert json.loads(await stream.receive_some())["heard"] == "hi"
        await stream.aclose()
        for file in opened:
            await file.release()
        await mount.serves()
        files.close()


def message(call: str, data: bytes = b"", **facts: object) -> bytes:
    return wire.encoded({"call": call, **facts}, data)


OPEN = message("open", path="/f", write=True, truncate=True, append=False)
WRITE = message("write", DATA[: wire.BLOCK], at=0)


@pytest.mark.holds("promise 1", "promise 3")
@pytest.mark.parametrize(
    "sent", [b"", WRITE, WRITE[:1000], message("fsync")], ids=["nothing", "a write", "half", "fsync"]
)
async def test_of_a_client_that_is_killed_nothing_is_placed(tmp_path: Path, sent: bytes) -> None:
    tree = FakeTree({b"/f": DATA}, delays={"fsync": 1000.0})
    async with serving(tmp_path, tree) as mount:
        files = mount.client()
        file = await opened(files)
        await file.write(0, b"a part")
        await file._connection._stream.send_all(sent)
        if sent == message("fsync"):
            await until(lambda: ("fsync", b"/f") in tree.calls)
        files.close()
        await until(lambda: tree.taken_back == [b"/f"])
        assert tree.files == {b"/f": DATA}
        await mount.serves()


async def test_a_client_that_stops_reading_disturbs_nobody(tmp_path: Path) -> None:
    async with serving(tmp_path) as mount:
        client = await mount.raw()
        client.setblocking(False)
        client.sendall(message("open", path="/f", write=False, truncate=False, append=False))
        sent = 0
        for _ in range(10_000):
            try:
                sent += client.send(message("read", at=0, size=wire.BLOCK))
            except BlockingIOError:
                break
            await trio.lowlevel.checkpoint()
        await mount.serves()
        reads = [call for call in mount.tree.calls if call[0] == "read"]
        assert sent > 10_000  # the kernel's buffer is full
        assert len(reads) < 100  # it was not served from memory
        client.close()
        await until(lambda: all(file.closed for file in mount.tree.opened))


GARBAGE = {
    "noise": bytes(range(255, 0, -1)) * 100,
    "a length": struct.pack(">II", 2**31, 5),
    "no facts": struct.pack(">II", 2, 0) + b"[]",
    "brackets": struct.pack(">II", 50_000, 0) + b"[" * 50_000,
    "no call": message("no such call"),
    "no path": message("stat"),
    "a number for a path": message("stat", path=7),
    "out of the tree": message("stat", path="/../../etc/passwd"),
    "nothing open": message("read", at=0, size=5),
    "a size that is none": OPEN + message("resize", size="large"),
    "a negative offset": OPEN + message("read", at=-5, size=-7),
    "two files": OPEN + OPEN,
    "half a message": OPEN[:10],
}


@pytest.mark.holds("promise 10")
@pytest.mark.parametrize("name", GARBAGE)
async def test_garbage_disturbs_nobody(tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    async with serving(tmp_path) as mount:
        client = await mount.raw()
        await trio.to_thread.run_sync(client.sendall, GARBAGE[name])
        await mount.serves()
        await trio.to_thread.run_sync(partial(client.shutdown, socket.SHUT_WR))
        client.settimeout(PATIENCE)

        def rest() -> None:
            while client.recv(1 << 16):
                pass

        await trio.to_thread.run_sync(rest)
        client.close()
        await mount.serves()
        assert mount.tree.files == {b"/f": DATA}
    assert "Traceback" not in caplog.text


async def test_a_bug_in_a_call_ends_neither_the_connection_nor_the_mount(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tree = FakeTree({b"/f": DATA}, failing={"rename": AssertionError("a bug")})
    async with serving(tmp_path, tree) as mount:
        files = mount.client()
        with pytest.raises(MavftpfsError, match="internal error: AssertionError"):
            await files.rename(b"/f", b"/g")
        await files.stat(b"/f")
        await opened(files)
        tree.failing["take_back"] = AssertionError("another")
        files.close()
        await until(lambda: "bug in closing" in caplog.text)
        del tree.failing["take_back"]
        await mount.serves()


# -- interrupted calls ----------------------------------------------------------------------------


async def opened(files: MountFiles) -> MountFile:
    return await files.open(b"/f", write=True, truncate=True)


async def test_an_interrupted_write_is_taken_back_by_the_same_connection(tmp_path: Path) -> None:
    tree = FakeTree({b"/f": DATA}, delays={"write": 1000.0})
    async with serving(tmp_path, tree) as mount:
        files = mount.client()
        with trio.move_on_after(0.1):
            async with written(await opened(files)) as writing:
                await writing._file.write(0, DATA)
        assert writing.there is False
        assert tree.taken_back == [b"/f"]
        files.close()


async def test_an_interrupted_call_leaves_the_next_ones_their_own_replies(tmp_path: Path) -> None:
    async with serving(tmp_path, FakeTree({b"/f": DATA}, delays={"stat": 0.2})) as mount:
        files = mount.client()
        for _ in range(3):
            with trio.move_on_after(0.05):
                await files.stat(b"/f")
            assert [name for name, _ in await files.list(b"/")] == [b"f"]
        file = await files.open(b"/f")
        mount.tree.delays["read"] = 0.2
        for _ in range(3):
            with trio.move_on_after(0.05):
                await file.read(0, 5)
        mount.tree.delays.clear()
        assert await file.read(7, 5) == DATA[7:12]
        await file.release()
        files.close()


async def test_a_mount_that_ends_takes_back_what_is_not_finished(tmp_path: Path) -> None:
    async with serving(tmp_path) as mount:
        files = mount.client()
        file = await opened(files)
        await file.write(0, b"half")
        assert mount.files.users != []
        with trio.fail_after(PATIENCE):
            await mount.files.close()
        assert mount.tree.taken_back == [b"/f"]
        for call in (file.fsync, files.refresh):
            with pytest.raises(LinkClosed, match="the mount on /mnt/drone"):
                await call()
        assert await file.take_back() is None
        files.close()


async def test_an_error_of_the_close_says_what_the_vehicle_has(tmp_path: Path) -> None:
    tree = FakeTree({b"/f": DATA}, failing={"fsync": NotFound("its directory is gone")})
    async with serving(tmp_path, tree) as mount:
        files = mount.client()
        with pytest.raises(NotDelivered, match="its directory is gone") as caught:
            async with written(await opened(files)):
                pass
        assert caught.value.there is False
        assert isinstance(caught.value.__cause__, NotFound)
        files.close()


# -- what the kernel is told ----------------------------------------------------------------------


@asynccontextmanager
async def knowing(tmp_path: Path, *paths: bytes) -> AsyncIterator[tuple[Mount, MountFiles]]:
    """Give a mount whose kernel knows files."""
    async with serving(tmp_path, FakeTree({b"/f": b"old"}, {b"/d"})) as mount:
        for path in paths:
            mount.kernel.inodes.lookup(path)
        files = mount.client()
        yield mount, files
        files.close()


@pytest.mark.holds("promise 1")
async def test_pages_are_dropped_before_a_file_is_opened(tmp_path: Path) -> None:
    """To the tree whoever opens a file has its pages, and so the kernel would keep those of an older file."""
    async with knowing(tmp_path, b"/f") as (mount, files):
        await files.open(b"/f")
        assert mount.kernel.told() == ["pages", "open"]


async def test_names_are_told_after_the_change_and_before_the_answer(tmp_path: Path) -> None:
    async with knowing(tmp_path, b"/", b"/f") as (mount, files):
        await files.mkdir(b"/e")
        assert mount.kernel.told() == ["mkdir", "name"]
        await files.rmdir(b"/e")
        assert mount.kernel.told() == ["rmdir", "name"]
        await (await files.create(b"/n", exclusive=True)).release()
        assert "name" in mount.kernel.told()
        await files.rename(b"/n", b"/m")
        assert mount.kernel.told() == ["rename", "name", "name"]
        await files.unlink(b"/m")
        assert mount.kernel.told() == ["unlink", "name"]


async def test_a_write_drops_pages_and_the_end_waits_for_that(tmp_path: Path) -> None:
    async with knowing(tmp_path, b"/f") as (mount, files):
        file = await files.open(b"/f", write=True)
        mount.kernel.told()
        await file.write(0, b"new")
        await until(lambda: "pages" in mount.kernel.told())
        mount.tree.calls.clear()
        await file.fsync()
        calls = mount.kernel.told()
        assert calls[0] == "fsync"
        assert {"pages", "name"} <= set(calls)


async def test_a_kernel_that_waits_holds_no_answer_up_for_long(tmp_path: Path) -> None:
    async with knowing(tmp_path, b"/", b"/f") as (mount, files):
        mount.kernel.gate.clear()
        try:
            began = trio.current_time()
            await files.mkdir(b"/e")
            assert TELLING_TIME <= trio.current_time() - began < TELLING_TIME + 5
        finally:
            mount.kernel.gate.set()


async def test_what_is_gone_loses_its_number(tmp_path: Path) -> None:
    async with knowing(tmp_path, b"/f") as (mount, files):
        await files.rename(b"/f", b"/g")
        assert mount.kernel.inodes.known(b"/g") is not None
        await files.unlink(b"/g")
        assert mount.kernel.inodes.known(b"/g") is None


async def test_a_refused_change_is_no_change(tmp_path: Path) -> None:
    async with knowing(tmp_path, b"/", b"/f") as (mount, files):
        mount.tree.error = ReadOnly("armed")
        with pytest.raises(ReadOnly):
            await files.unlink(b"/f")
        assert mount.kernel.inodes.known(b"/f") is not None
        mount.tree.error = None
        mount.tree.files[b"/.f.swp"] = b"of an editor on the mount"
        for change in (files.create(b"/.f.swp", exclusive=False), files.rename(b"/f", b"/.f.swp")):
            with pytest.raises(NotSupported, match="never reaches the card"):
                await change
        assert mount.tree.files == {b"/f": b"old", b"/.f.swp": b"of an editor on the mount"}


# -- versions -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("protocol", "line"),
    [
        (None, "; unmount it, and mount it again: mavftpfs umount /m"),
        (wire.VERSION + 1, "; upgrade this program"),
    ],
)
def test_another_version_is_a_line_that_says_what_to_do(protocol: int | None, line: str) -> None:
    status = {"version": "9"} if protocol is None else {"version": "9", "protocol": protocol}
    with pytest.raises(LinkClosed, match=f"the mount on /m is of mavftpfs 9, this program of .*{line}"):
        require_usable(status, "/m")


async def test_another_mount_in_the_same_place_is_not_taken_for_this_one(tmp_path: Path) -> None:
    async with serving(tmp_path) as mount:
        with pytest.raises(LinkClosed, match="gone, and there is another one now"):
            await connect({"socket": str(mount.path), "id": "that"}, "/mnt/drone")
    with pytest.raises(LinkClosed, match="gone"):
        await connect({"socket": str(mount.path), "id": "this"}, "/mnt/drone")
