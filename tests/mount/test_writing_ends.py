"""Arming, lost vehicles, kills and unmounts while something was written: what was confirmed is on the card,
what was not is an error and is kept."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from mavftpfs.cache.reserved import is_reserved
from mavftpfs.client import control
from mavftpfs.client.files import session_on
from mavftpfs.client.options import Options
from mavftpfs.shared.errors import MavftpfsError
from tests.mount.conftest import Field
from tests.support.mounts import Mount, abort_mount, command, mavftpfs, mounted_at, unmount, wait_until
from tests.support.trees import content
from tests.support.vehicles import Process, SimVehicle

QUICK = ("op_deadline=6",)
RECOVERED = re.compile(r"did not reach the\w* vehicle; they are (?:kept )?in (.+?); put them back by: ")

WRITER = """
import errno, os, sys, time
number = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT)
block, taken = 16384, 0
def attempt(name, call):
    try:
        call(); print(name, "ok", flush=True); return True
    except OSError as error:
        print(name, errno.errorcode[error.errno], flush=True); return False
data = bytes(range(256)) * (block // 256)
for part in range(int(sys.argv[2])):
    if not attempt("write", lambda: os.write(number, data)):
        break
    taken += block
attempt("fsync", lambda: os.fsync(number))
attempt("close", lambda: os.close(number))
print("taken", taken, flush=True)
"""
"""Writes blocks and says what each call said."""

BLOCK = bytes(range(256)) * 64


def start_writer(mount: Mount, name: str, blocks: int) -> subprocess.Popen[str]:
    """Start writing a file; returns when a few blocks were taken."""
    argv = [sys.executable, "-c", WRITER, str(mount.path / name), str(blocks)]
    writer = subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    for _ in range(4):
        assert writer.stdout.readline() == "write ok\n"
    return writer


def said(writer: subprocess.Popen[str], mount: Mount) -> dict[str, list[str]]:
    """Wait for a writer and return what each kind of call said, and how much was taken."""
    try:
        out, errors = writer.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        abort_mount(mount.path)
        writer.communicate(timeout=20)
        raise AssertionError(f"the writer hung\n{mount.alive_or_ended().text()}") from None
    assert writer.returncode == 0, errors
    found: dict[str, list[str]] = {"write": ["ok"] * 4}
    for line in out.splitlines():
        name, result = line.split()
        found.setdefault(name, []).append(result)
    return found


@pytest.mark.holds("fault killed program")
def test_a_killed_program_leaves_what_it_wrote(field: Field) -> None:
    """The kernel closes its files: what write() took arrives, as on a local disk."""
    card = field.local("card")
    mount = field.mount(field.sim(card, "px4", ("--rate", "40000")).source)
    writer = start_writer(mount, "killed.bin", 100)
    writer.kill()
    writer.communicate(timeout=60)
    written = mount.read_bytes(mount.path / "killed.bin")
    assert len(written) >= 4 * len(BLOCK)
    assert written == BLOCK * (len(written) // len(BLOCK))
    wait_until("it arrives", lambda: (card / "killed.bin").read_bytes() == written)


@pytest.mark.holds("promise 9")
def test_arming_in_mid_copy_refuses_and_disarming_delivers(field: Field) -> None:
    card = field.local("card")
    (card / "APM").mkdir()
    (card / "APM" / "old.txt").write_text("old\n")
    vehicle = field.sim(card, "px4", ("--rate", "60000"))
    mount = field.mount(vehicle.source, "dirty_max=64K")
    writer = start_writer(mount, "APM/flight.bin", 100)
    vehicle.react(signal.SIGUSR1)
    results = said(writer, mount)
    assert set(results["write"][:-1]) == {"ok"}
    assert results["write"][-1] == "EROFS"
    assert (results["fsync"], results["close"]) == (["EROFS"], ["EROFS"])
    taken = int(results["taken"][0])
    assert 0 < taken < 100 * len(BLOCK)
    for code in CHANGES:
        assert mount.errno_of(code, mount.path / "APM") == "EROFS", code
    assert mount.run("cat", mount.path / "APM/old.txt").stdout == "old\n"
    assert (card / "APM" / "old.txt").read_text() == "old\n"
    status = json.loads(command("status", mount.path, "--json")[0])
    assert status["vehicle"]["armed"] is True
    assert (status["held"]["files"], status["held"]["bytes"]) == (1, taken)
    (transfer,) = status["transfers"]
    assert (transfer["path"], transfer["size"]) == ("/APM/flight.bin", taken)
    assert (transfer["direction"], transfer["state"]) == ("write", "waiting")
    assert 0 <= transfer["done"] < taken
    assert "flight.bin" in command("status", mount.path)[0]
    vehicle.react(signal.SIGUSR1)
    expected = BLOCK * (taken // len(BLOCK))
    place = card / "APM" / "flight.bin"
    wait_until("what was held is delivered", lambda: place.read_bytes() == expected)
    mount.run("sh", "-c", f"echo new > {mount.path}/APM/new.txt")
    assert (card / "APM" / "new.txt").read_text() == "new\n"


CHANGES = (
    "open(sys.argv[1] + '/x', 'w')",
    "open(sys.argv[1] + '/old.txt', 'a')",
    "os.truncate(sys.argv[1] + '/old.txt', 0)",
    "os.mkdir(sys.argv[1] + '/d')",
    "os.unlink(sys.argv[1] + '/old.txt')",
    "os.rename(sys.argv[1] + '/old.txt', sys.argv[1] + '/x')",
)


def write_to_nobody(mount: Mount, vehicle: SimVehicle, data: Path) -> None:
    """Have a copy fail because the vehicle fell silent."""
    mount.run("sh", "-c", f"echo confirmed > {mount.path}/confirmed")
    vehicle.pause()
    result = mount.run("cp", data, mount.path / "lost.bin", code=None)
    assert result.returncode == 1
    assert "timed out" in result.stderr or "Input/output error" in result.stderr
    assert mount.errno_of("open(sys.argv[1], 'ab').close()", mount.path / "confirmed") in ("ETIMEDOUT", "")


def holding(field: Field, data: Path) -> tuple[Mount, SimVehicle, Path]:
    """Return a mount that holds lost.bin, its vehicle, which is silent, and that one's card."""
    card = field.local("card")
    vehicle = field.sim(card)
    mount = field.mount(vehicle.source, *QUICK)
    write_to_nobody(mount, vehicle, data)
    return mount, vehicle, card


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A file to be written."""
    path = tmp_path / "data.bin"
    path.write_bytes(content("data", 40_000))
    return path


def recovered(text: str) -> Path:
    """Return the directory that a message names."""
    match = RECOVERED.search(text)
    assert match is not None, text
    return Path(match[1])


def told(process: Process) -> Path:
    """Return the directory that a new mount names a moment after it is up."""
    wait_until("the notice", lambda: RECOVERED.search(process.text()) is not None)
    return recovered(process.text())


def test_what_the_vehicle_refuses_does_not_put_off_the_end(field: Field, data: Path) -> None:
    card = field.local("card")
    mount = field.mount(field.sim(card, "ardupilot5").source)
    result = mount.run("cp", data, mount.path / "no?such*name", code=None)
    assert (result.returncode, "Invalid argument" in result.stderr) == (1, True)
    assert mount.errno_of("open(sys.argv[1], 'r+b').close()", mount.path / "no?such*name") == "EINVAL"
    process, mount.process = mount.alive(), None
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 4
    assert (recovered(process.text()) / "no?such*name").read_bytes() == data.read_bytes()
    assert process.text().count("is not delivered") == 1
    assert list(card.iterdir()) == []


@pytest.mark.holds("promise 3")
def test_whoever_unmounts_second_waits_for_the_delivery_too(field: Field, data: Path) -> None:
    mount, vehicle, card = holding(field, data)
    unmount(mount.path)
    wait_until("it delivers before it ends", lambda: "delivering" in mount.alive_or_ended().text())
    path = control.find_socket(str(mount.path), control.own_directories())
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(60)
        client.connect(str(path))
        client.sendall(b'{"command": "umount"}\n')
        control.ask(path, {"command": "status"}, timeout=20)  # served after the one before
        vehicle.resume()
        reply = json.loads(client.makefile().readline())
    assert (reply["ok"], reply.get("exit_code")) == (True, 0), reply
    assert (card / "lost.bin").read_bytes() == data.read_bytes()


@pytest.mark.holds("promise 3")
def test_what_a_killed_daemon_held_is_named_by_umount_and_by_the_next_mount_in_the_background(
    field: Field, data: Path, state_home: Path
) -> None:
    mount, vehicle, _ = holding(field, data)
    vehicle.left_alone = True
    mount.kill()
    _, refused = mavftpfs(vehicle.source, mount.path, code=3)
    assert "is a dead mount whose program is gone" in refused
    assert "1 file(s) did not reach the vehicle when a mount was killed" in refused
    _, told = command("umount", mount.path, code=4)
    assert "1 file(s) did not reach the vehicle" in told
    assert not mounted_at(mount.path)
    vehicle.resume()
    _, failed = mavftpfs(f"{vehicle.source}#/none", mount.path, code=1)
    assert "did not reach" not in failed, "one that fails takes no news away"
    try:
        place = recovered(mavftpfs(vehicle.source, mount.path)[1])
        assert state_home in place.parents
        assert (place / "lost.bin").read_bytes() == data.read_bytes()
        command("umount", mount.path)
    finally:
        abort_mount(mount.path)


@pytest.mark.holds("promise 3")
def test_a_killed_daemon_loses_only_what_was_not_confirmed(field: Field, data: Path) -> None:
    card = field.local("card")
    (card / "replaced.bin").write_bytes(b"old" * 1000)
    vehicle = field.sim(card, "px4", ("--rate", "10000"))  # what is held takes a quarter of a minute
    vehicle.left_alone = True
    mount = field.mount(vehicle.source, *QUICK)
    write_to_nobody(mount, vehicle, data)
    vehicle.resume()
    wait_until("heartbeats are back", lambda: readable(mount))
    code = (
        "import os, sys, time\n"
        "f = open(sys.argv[1], 'r+b', 0); f.truncate(0); f.write(b'n' * 300000)\n"
        "print('written', flush=True); time.sleep(60)"
    )
    with mount.started(sys.executable, "-c", code, mount.path / "replaced.bin"):
        wait_until("it is under way", lambda: any(map(is_reserved, os.listdir(os.fsencode(card)))))
        vehicle.pause()
        mount.kill()
        abort_mount(mount.path)
    vehicle.resume()
    # The killed one's file counts as another client's for 10 s, so the next reader waits for as long.
    again = field.mount(vehicle.source)
    assert (card / "confirmed").read_text() == "confirmed\n"
    assert again.read_bytes(again.path / "replaced.bin") in (b"old" * 1000, b"n" * 300000)
    place = told(again.alive())
    found = {path.name: path for path in place.iterdir()}
    if "lost.bin" in found:
        assert json.loads(found["lost.bin.json"].read_text())["path"] == "/lost.bin"
    lost = found.get("lost.bin", card / "lost.bin")  # where the test came late to the killing
    assert lost.read_bytes() == data.read_bytes()
    again.run("ls", "-A", again.path)
    wait_until(
        "no litter", lambda: {p.name for p in card.iterdir()} <= {"confirmed", "replaced.bin", "lost.bin"}
    )


def test_a_killed_daemon_leaves_what_was_being_written_under_its_name(field: Field, data: Path) -> None:
    """Before any close: more than memory takes lies on the local disk, and its name beside it."""
    vehicle = field.sim(field.local("card"), "px4", ("--rate", "50000"))
    vehicle.left_alone = True
    mount = field.mount(vehicle.source, *QUICK, "dirty_max=64K")
    code = (
        "import sys, time\n"
        "f = open(sys.argv[1], 'xb', 0); f.write(b'n' * 100_000)\n"
        "print('written', flush=True); time.sleep(60)"
    )
    with mount.started(sys.executable, "-c", code, mount.path / "log.bin") as child:
        assert child.stdout is not None
        assert child.stdout.readline()
        mount.kill()
        abort_mount(mount.path)
    place = told(field.mount(vehicle.source, *QUICK).alive())
    found = {path.name: path for path in place.iterdir()}
    assert found["log.bin"].read_bytes() == b"n" * 100_000
    facts = json.loads(found["log.bin.json"].read_text())
    assert len(facts.pop("uid")) == 16
    assert facts == {"path": "/log.bin", "system": 1}


def test_a_mount_that_wrote_leaves_nothing_behind(
    field: Field, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, temporaries = field.local("state"), field.local("t")
    monkeypatch.setenv("XDG_STATE_HOME", str(state))
    monkeypatch.setenv("TMPDIR", str(temporaries))
    card = field.local("card")
    mount = field.mount(field.sim(card).source, "dirty_max=64K")
    mount.run("cp", data, mount.path / "one.bin")
    mount.run("cp", data, mount.path / "one.bin")
    mount.run("truncate", "-s", "10", mount.path / "one.bin")
    mount.run("rm", mount.path / "one.bin")
    assert mount.unmount() == 0
    assert os.listdir(temporaries) == []
    assert [path for path in state.rglob("*") if path.is_file() and path.name != "owner"] == []
    assert os.listdir(card) == []


def readable(mount: Mount) -> bool:
    """Return whether the vehicle answers."""
    return mount.run("cat", mount.path / "confirmed", code=None).stdout == "confirmed\n"


def test_a_put_that_is_refused_leaves_nothing_behind(
    field: Field, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file is here already: no mount has to find another copy of it."""
    vehicle = field.sim(field.local("card"), "px4-nuttx")
    state = field.local("state")
    monkeypatch.setenv("XDG_STATE_HOME", str(state))
    assert "protected" in command("put", vehicle.source, data, "/outside-its-card", code=4)[1]
    assert [path for path in state.rglob("*") if path.is_file() and path.name != "owner"] == []


async def test_what_a_client_takes_back_from_a_mount_never_comes(field: Field) -> None:
    """It closes the file as any program does, and yet the mount does not go on with it."""
    card = field.local("card")
    (card / "old").write_text("old")
    vehicle = field.sim(card)
    mount = field.mount(vehicle.source, "op_deadline=2")
    mount.allowed_log = ("is not delivered",)
    session = session_on(mount.status(), b"/", Options())
    old = await session.files.open(b"/old", write=True, truncate=True)
    new = await session.files.create(b"/new", exclusive=True)
    for file in (old, new):
        await file.write(0, b"new" * 5000)
    vehicle.pause()
    for file in (old, new):
        with pytest.raises(MavftpfsError):
            await file.fsync()
        assert await file.take_back() is False
    vehicle.resume()
    wait_until("the vehicle is heard again", lambda: mount.status()["link"]["state"] != "lost")
    assert mount.status()["held"]["files"] == 0
    shown = [path for path in card.iterdir() if not is_reserved(os.fsencode(path.name))]
    assert {path.name: path.read_text() for path in shown} == {"old": "old"}  # requests came out of its queue
    assert (mount.path / "old").read_text() == "old"
    assert os.listdir(mount.path) == ["old"]
