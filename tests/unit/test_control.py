"""control: sockets, their places, and the line protocol, over real Unix sockets."""

from __future__ import annotations

import json
import os
import resource
import socket
import stat
from collections.abc import AsyncIterator, Mapping
from contextlib import ExitStack, asynccontextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import trio
import trio.testing

from mavftpfs.cli.main import main
from mavftpfs.client import control
from mavftpfs.client.control import ControlError, NobodyThere, Reply, all_sockets, ask, find_socket
from mavftpfs.mount import controlserver
from mavftpfs.mount.controlserver import Command, ControlServer
from mavftpfs.shared.errors import ExitCode, UsageError

pytestmark = pytest.mark.real_time


@asynccontextmanager
async def serving(path: Path, commands: Mapping[str, Command]) -> AsyncIterator[ControlServer]:
    server = ControlServer(path, commands)
    async with trio.open_nursery() as nursery:
        await nursery.start(server.run)
        yield server
        server.close()
        with trio.fail_after(90):
            await server.closed.wait()


async def ask_from_outside(path: Path, request: Reply) -> Reply:
    return await trio.to_thread.run_sync(partial(ask, path, request, timeout=90.0))


async def echo(request: Reply) -> Reply:
    return {"heard": request.get("word")}


async def refuse(request: Reply) -> Reply:
    raise UsageError("in use")


async def crash(request: Reply) -> Reply:
    raise ValueError("a bug")


@pytest.mark.parametrize(("command", "reason"), [("refuse", "in use"), ("crash", "internal"), ("x", "not a")])
async def test_refusals_name_the_reason(
    tmp_path: Path, command: str, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "s.sock"
    async with serving(path, {"refuse": refuse, "crash": crash}):
        with pytest.raises(ControlError, match=reason):
            await ask_from_outside(path, {"command": command})
    assert bool(caplog.records) == (command == "crash")


@pytest.mark.parametrize(
    "line",
    [b"[1]\n", b'{"command": []}\n', b"\xff\xfe\n", b"", b"[" * 200_000 + b"\n"],
    ids=range(5),
)
async def test_garbage_is_answered_and_harmless(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "s.sock"
    async with serving(path, {"echo": echo}):
        stream = await trio.open_unix_socket(path)
        await stream.send_all(line)
        await stream.send_eof()
        answer = b""
        while data := await stream.receive_some():
            answer += data
        await stream.aclose()
        assert json.loads(answer)["ok"] is False
        assert (await ask_from_outside(path, {"command": "echo"}))["ok"]


async def test_a_mount_that_ends_leaves_the_socket_of_the_next_one_there(tmp_path: Path) -> None:
    path = tmp_path / "s.sock"
    async with serving(path, {"echo": echo}) as first, serving(path, {"echo": echo}):
        first.close()
        with trio.fail_after(90):
            await first.closed.wait()
        assert (await ask_from_outside(path, {"command": "echo"}))["ok"]
    assert not path.exists()


async def test_no_descriptors_left_is_got_over(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "s.sock"
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    async with serving(path, {"echo": echo}):
        with socket.socket(socket.AF_UNIX) as client:
            resource.setrlimit(resource.RLIMIT_NOFILE, (1, limits[1]))
            try:
                client.connect(str(path))
                client.sendall(b'{"command": "echo", "word": "hi"}\n')
                with trio.fail_after(90):
                    while not caplog.records:  # noqa: ASYNC110
                        await trio.sleep(0.01)
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, limits)
            answer = await trio.to_thread.run_sync(client.recv, 4096)
    assert json.loads(answer)["heard"] == "hi"


async def test_connections_that_ask_nothing_keep_nobody_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controlserver, "ASKING_PATIENCE", 0.1)
    path = tmp_path / "s.sock"
    async with serving(path, {"echo": echo}):
        with ExitStack() as idle:
            for _ in range(3 * controlserver.MAX_CLIENTS):
                idle.enter_context(socket.socket(socket.AF_UNIX)).connect(str(path))
            open_before = len(os.listdir("/proc/self/fd"))
            await trio.sleep(0.05)
            assert len(os.listdir("/proc/self/fd")) - open_before <= controlserver.MAX_CLIENTS
            assert (await ask_from_outside(path, {"command": "echo", "word": "hi"}))["heard"] == "hi"


async def test_a_reply_in_the_making_is_still_sent_after_close(tmp_path: Path) -> None:
    path, finished = tmp_path / "s.sock", trio.Event()
    replies: list[Reply] = []

    async def wait(request: Reply) -> Reply:
        server.close()
        await finished.wait()
        return {"exit_code": 4}

    async def client() -> None:
        replies.append(await ask_from_outside(path, {"command": "umount"}))

    async with serving(path, {"umount": wait}) as server, trio.open_nursery() as nursery:
        nursery.start_soon(client)
        await trio.sleep(0.05)
        assert not server.closed.is_set()
        finished.set()
    assert replies == [{"ok": True, "exit_code": 4}]


async def test_the_socket_of_a_killed_mount_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "s.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    with pytest.raises(NobodyThere):
        ask(path, {"command": "echo"}, timeout=90)
    async with serving(path, {"echo": echo}):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert (await ask_from_outside(path, {"command": "echo"}))["ok"]


def test_a_mute_process_is_not_taken_for_a_dead_one(tmp_path: Path) -> None:
    path = tmp_path / "s.sock"
    with socket.socket(socket.AF_UNIX) as mute:
        mute.bind(str(path))
        mute.listen()
        with pytest.raises(ControlError) as caught:
            ask(path, {"command": "echo"}, timeout=0.05)
    assert not isinstance(caught.value, NobodyThere)


async def test_a_mount_of_a_version_that_tells_less_is_named_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = {"mountpoint": "/mnt/old", "source": "udpin:0", "state": "mounted", "version": "0.0.9"}

    async def status(_: Reply) -> Reply:
        return {"status": told}

    with TemporaryDirectory(dir="/tmp") as name:
        place = Path(name) / "mavftpfs" / control.socket_name("/mnt/old")
        place.parent.mkdir()
        async with serving(place, {"status": status}):
            code = await trio.to_thread.run_sync(main, ["status", "/mnt/old"])
    said = capsys.readouterr()
    assert (code, said.err) == (ExitCode.MOUNT_FAILED, "")
    assert said.out.startswith("/mnt/old: its program is of version 0.0.9")


# -- places ---------------------------------------------------------------------------------------


def test_a_private_directory_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "SYSTEM", tmp_path / "no" / "such" / "place")
    monkeypatch.setattr(control, "USERS", tmp_path)
    chosen = control.usable_directory()
    assert chosen == tmp_path / f"mavftpfs-{os.getuid()}"
    assert stat.S_IMODE(chosen.stat().st_mode) == 0o700
    assert control.usable_directory() == chosen
    assert control._OURS.match(f"{chosen}/{control.socket_name('/mnt/drone')}")


@pytest.mark.holds("promise 10")
@pytest.mark.parametrize("kind", ["open", "link", "file"])
def test_a_directory_that_others_may_enter_or_own_is_not_used(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "SYSTEM", tmp_path / "no" / "such" / "place")
    monkeypatch.setattr(control, "USERS", tmp_path)
    place = tmp_path / f"mavftpfs-{os.getuid()}"
    if kind == "open":
        place.mkdir()
        place.chmod(0o777)
    elif kind == "link":
        place.symlink_to(tmp_path)
    else:
        place.touch()
    with pytest.raises(ControlError, match=str(place)):
        control.usable_directory()


@pytest.mark.needs("root")
def test_root_s_sockets_are_where_all_users_find_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(control, "SYSTEM", tmp_path / "system")
    before = os.umask(0o077)
    try:
        assert control.usable_directory() == tmp_path / "system"
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "system").stat().st_mode) == 0o755


async def test_a_socket_is_found_wherever_it_is_but_not_another_user_s(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """sudo and su leave HOME and XDG_RUNTIME_DIR as they were, or change them."""
    with TemporaryDirectory(dir="/tmp") as name:
        directory = Path(name) / "mavftpfs"
        directory.mkdir(mode=0o700)
        path = directory / control.socket_name("/mnt/drone")
        async with serving(path, {"echo": echo}):
            assert find_socket("/mnt/drone") == path
            assert path in all_sockets()
            user = os.geteuid()
            with pytest.raises(NobodyThere, match="no vehicle of yours"):
                find_socket("/mnt/another")
            try:
                if user == 0:
                    os.seteuid(65534)
                    assert path not in all_sockets()
            finally:
                os.seteuid(user)
        assert path not in all_sockets()
