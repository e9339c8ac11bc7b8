"""Arming, lost vehicles, kills and unmounts while something was written: what was confirmed is on the card,
what was not is an error and is kept."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

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


@pytest.mark.holds("promise 3")
def test_whoever_unmounts_second_waits_for_the_delivery_too(field: Field, data: Path) -> None:
    mount, vehicle, card = holding(field, data)
    unmount(mount.path)
    wait_until("it delivers before it ends", lambda: "delivering" in mount.alive_or_ended().text())
    with mount.started(sys.executable, "-m", "mavftpfs", "umount", mount.path) as second:
        assert second.stderr is not None
        assert "not everything is on the vehicle yet" in second.stderr.readline()
        vehicle.resume()
        assert second.wait(60) == 0
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


def test_a_mount_that_wrote_and_a_put_that_was_refused_leave_nothing_behind(
    field: Field, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    card, state, temporaries = (field.local(name) for name in ("card", "state", "t"))
    (card / "fs/microsd").mkdir(parents=True)
    vehicle = field.sim(card, "px4-nuttx")
    monkeypatch.setenv("XDG_STATE_HOME", str(state))
    monkeypatch.setenv("TMPDIR", str(temporaries))
    assert "protected" in command("put", vehicle.source, data, "/outside-its-card", code=4)[1]
    mount = field.mount(vehicle.source, "dirty_max=64K")
    file = mount.path / "fs/microsd/one.bin"
    mount.run("cp", data, file)
    mount.run("truncate", "-s", "10", file)
    mount.run("rm", file)
    assert mount.unmount() == 0
    assert os.listdir(temporaries) == []
    assert [path for path in state.rglob("*") if path.is_file() and path.name != "owner"] == []
    assert os.listdir(card / "fs/microsd") == []
