"""Arming, lost vehicles, kills and unmounts while something was written: what was confirmed is on the card,
what was not is an error and is kept; and what people are told of it, and how they bring it there."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mavftpfs.client.control import find_socket
from mavftpfs.shared.errors import ExitCode
from tests.mount.conftest import Field
from tests.support.mounts import Mount, abort_mount, command, mavftpfs, mounted_at, unmount, wait_until
from tests.support.trees import content
from tests.support.vehicles import Process, Program, SimVehicle

MAVFTPFS = (sys.executable, "-m", "mavftpfs")
QUICK = ("op_deadline=6",)
RECOVERED = re.compile(
    r"did not reach the vehicle; (?:it is|they are) (?:kept )?in (.+?); upload (?:it|them) with: "
)

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

CLOSER = """
import errno, sys
file = open(sys.argv[1], "w")
file.write("whole\\n"); file.flush()
print("written", flush=True)
sys.stdin.readline()
try:
    file.close()
except OSError as error:
    print(errno.errorcode[error.errno])
"""
"""Writes a file, and closes it when it is told to."""

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


@pytest.mark.holds("promise 3", "promise 9")
def test_arming_in_mid_copy_refuses_and_puts_no_part_on_the_card(field: Field, state: Path) -> None:
    card = field.local("card")
    (card / "APM").mkdir()
    (card / "APM" / "old.txt").write_text("old\n")
    vehicle = field.sim(card, "px4", ("--rate", "60000"))
    mount = field.mount(vehicle.source)
    writer = start_writer(mount, "APM/flight.bin", 100)
    argv = [sys.executable, "-c", CLOSER, str(mount.path / "APM/whole.txt")]
    closer = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert closer.stdout is not None
    assert closer.stdout.readline() == "written\n"
    vehicle.react(signal.SIGUSR1)
    assert closer.communicate("\n", timeout=60)[0] == "EROFS\n"
    results = said(writer, mount)
    assert set(results["write"][:-1]) == {"ok"}
    assert results["write"][-1] == "EROFS"
    assert (results["fsync"], results["close"]) == (["EIO"], ["EIO"])
    taken = int(results["taken"][0])
    assert 0 < taken < 100 * len(BLOCK)
    for code in CHANGES:
        assert mount.errno_of(code, mount.path / "APM") == "EROFS", code
    assert mount.run("cat", mount.path / "APM/old.txt").stdout == "old\n"
    assert (card / "APM" / "old.txt").read_text() == "old\n"
    status = json.loads(command("status", mount.path, "--json")[0])
    assert status["vehicle"]["armed"] is True
    assert (status["held"]["files"], list(status["held"]["broken"])) == (1, ["/APM/flight.bin"])
    vehicle.react(signal.SIGUSR1)
    wait_until("it is disarmed", lambda: "disarmed" in command("status", mount.path)[0])
    assert (
        "  write failed /APM/flight.bin: the vehicle was armed (when_armed=ro); copy the file again "
        f"(umount moves the part that was written to {state})\n"
    ) in command("status", mount.path)[0]
    whole = card / "APM/whole.txt"
    wait_until("what was accepted is delivered", lambda: whole.exists() and whole.read_text() == "whole\n")
    mount.run("sh", "-c", f"echo new > {mount.path}/APM/new.txt")
    assert (card / "APM" / "new.txt").read_text() == "new\n"
    _, said_last = command("umount", mount.path, code=4)
    mount.process = None
    assert sorted(os.listdir(card / "APM")) == ["new.txt", "old.txt", "whole.txt"]
    (copy,) = state.glob("*/APM__flight.bin")
    assert copy.read_bytes() == BLOCK * (taken // len(BLOCK))
    assert (
        f"1 file did not reach the vehicle, because a write failed; it is kept in {copy.parent}" in said_last
    )
    assert "; list it with: mavftpfs recover\n" in said_last
    assert "the part that was written before" in command("recover")[0]


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
    """A file that is written while nobody answers."""
    path = tmp_path / "data"
    path.write_bytes(content("lost", 60_000))
    return path


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where this test's mounts leave what is not delivered."""
    path = tmp_path / "state"
    path.mkdir()
    monkeypatch.setenv("XDG_STATE_HOME", str(path))
    return path / "mavftpfs/recovered"


def recovered(text: str) -> Path:
    """Return the directory that a message names."""
    match = RECOVERED.search(text)
    assert match is not None, text
    return Path(match[1])


def told(process: Process) -> Path:
    """Return the directory that a new mount names a moment after it is up."""
    wait_until("the notice", lambda: RECOVERED.search(process.text()) is not None)
    return recovered(process.text())


@pytest.mark.holds("promise 2")
def test_fsync_confirms_an_empty_file_and_close_does_not(field: Field) -> None:
    card = field.local("card")
    vehicle = field.sim(card)
    mount = field.mount(vehicle.source, *QUICK)
    vehicle.pause()
    mount.python(
        "import os, sys; os.close(os.open(sys.argv[1], os.O_CREAT | os.O_WRONLY))", mount.path / "empty"
    )
    vehicle.resume()
    wait_until("it is made a moment later", lambda: (card / "empty").exists())
    sync = "import os, sys; number = os.open(sys.argv[1], os.O_CREAT | os.O_WRONLY); os.fsync(number)"
    mount.python(sync, mount.path / "synced")
    assert (card / "synced").exists()


@pytest.mark.holds("promise 3")
def test_whoever_unmounts_second_waits_for_the_delivery_too(field: Field, data: Path) -> None:
    mount, vehicle, card = holding(field, data)
    unmount(mount.path)
    wait_until("it delivers before it ends", lambda: "uploading" in mount.alive_or_ended().text())
    with mount.started(*MAVFTPFS, "umount", mount.path) as second:
        assert second.stderr is not None
        assert "uploading pending changes" in second.stderr.readline()
        vehicle.resume()
        assert second.wait(60) == 0
    assert (card / "lost.bin").read_bytes() == data.read_bytes()


@pytest.mark.holds("promise 3")
def test_a_put_says_where_a_killed_mount_left_its_file(field: Field, data: Path, state: Path) -> None:
    vehicle = field.sim(field.local("card"), options=("--rate", "20000"))
    vehicle.left_alone = True
    mount = field.mount(vehicle.source)
    put = Program("put", ["mavftpfs.__main__", "put", str(mount.path), str(data), "/x"], field.local("out"))
    try:
        wait_until("it is being sent", lambda: any(one["done"] for one in mount.status()["transfers"]))
        mount.kill()
        assert put.wait() == ExitCode.UNDELIVERED
    finally:
        put.kill()
    assert "before you use it; see what the mount kept: mavftpfs recover\n" in put.text()
    wait_until("recover lists it", lambda: f"moves it from {state.parent}/" in command("recover")[0])
    command("umount", mount.path, code=ExitCode.UNDELIVERED)


@pytest.mark.holds("promise 3")
def test_what_a_killed_daemon_held_is_named_by_umount_and_by_the_next_mount_in_the_background(
    field: Field, data: Path, state: Path
) -> None:
    mount, vehicle, _ = holding(field, data)
    vehicle.left_alone = True
    mount.kill()
    _, refused = mavftpfs(vehicle.source, mount.path, code=3)
    assert "is a dead mount whose program is gone" in refused
    assert "1 file did not reach the vehicle when a mount was killed" in refused
    _, told = command("umount", mount.path, code=4)
    assert "1 file did not reach the vehicle" in told
    assert not mounted_at(mount.path)
    vehicle.resume()
    _, failed = mavftpfs(f"{vehicle.source}#/none", mount.path, code=1)
    assert "did not reach" not in failed, "one that fails takes no news away"
    try:
        place = recovered(mavftpfs(vehicle.source, mount.path)[1])
        assert state in place.parents
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
    mount = field.mount(vehicle.source)
    file = mount.path / "fs/microsd/one.bin"
    mount.run("cp", data, file)
    mount.run("truncate", "-s", "10", file)
    mount.run("rm", file)
    assert mount.unmount() == 0
    assert os.listdir(temporaries) == []
    assert [path for path in state.rglob("*") if path.is_file() and path.name != "owner"] == []
    assert os.listdir(card / "fs/microsd") == []


def test_umount_says_what_it_waits_for_and_ctrl_c_ends_the_waiting_only(
    field: Field, data: Path, state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mount, vehicle, card = holding(field, data)
    process = mount.alive()
    monkeypatch.setenv("XDG_STATE_HOME", "/of-another-user")
    with mount.started(*MAVFTPFS, "umount", mount.path) as child:
        assert child.stderr is not None
        first, second, third = (child.stderr.readline() for _ in range(3))
        assert first == (
            "mavftpfs: uploading pending changes for up to 5 min; files not uploaded by then "
            f"are saved in {state}\n"
        )
        assert second == (
            "mavftpfs: Ctrl-C only stops this command; to save the remaining files here now: "
            f"kill {process.popen.pid}\n"
        )
        assert third == "mavftpfs: uploading 1 file, 0 B of 60.0 kB, until the vehicle is back\n"
        assert not mounted_at(mount.path)
        child.send_signal(signal.SIGINT)
        _, errors = child.communicate(timeout=60)
        assert child.returncode == ExitCode.INTERRUPTED
    said = "the mount keeps uploading pending changes, and then ends; see: mavftpfs status"
    assert errors == f"mavftpfs: {said}\n"
    assert f"{mount.path}: being unmounted, PX4 1/1, disarmed, LOST" in command("status")[0]
    mount.process = None
    vehicle.resume()
    assert process.wait() == 0
    assert (card / "lost.bin").read_bytes() == data.read_bytes()


def test_a_mount_whose_socket_was_removed_is_unmounted_and_uploads_all_the_same(
    field: Field, data: Path
) -> None:
    mount, vehicle, card = holding(field, data)
    process = mount.alive()
    find_socket(str(mount.path)).unlink()
    shown = command("status", mount.path, code=ExitCode.MOUNT_FAILED)[0]
    assert shown == f"{mount.path}: its socket cannot be reached from here\n"
    said = command("umount", mount.path, code=ExitCode.UNDELIVERED)[1]
    assert "the mount cannot be asked; it uploads pending changes by itself" in said
    mount.process = None
    vehicle.resume()
    assert process.wait() == 0
    assert (card / "lost.bin").read_bytes() == data.read_bytes()


def test_what_came_from_stdin_and_was_not_delivered_is_kept(field: Field, data: Path, state: Path) -> None:
    vehicle = field.sim(field.local("card"))
    vehicle.left_alone = True
    mount = field.mount(vehicle.source, *QUICK)
    vehicle.pause()
    argv = [*MAVFTPFS, "put", str(mount.path), "-", "/from_stdin"]
    with data.open("rb") as source:
        done = subprocess.run(argv, stdin=source, capture_output=True, text=True, timeout=120, check=False)
    vehicle.resume()
    assert done.returncode == ExitCode.UNDELIVERED, done.stderr
    (kept,) = state.glob("*/stdin")
    assert f"the bytes from stdin are kept in {kept}" in done.stderr
    assert kept.read_bytes() == data.read_bytes()


def left_behind(field: Field, data: Path) -> tuple[SimVehicle, Path]:
    """Have a mount end with a file that is not delivered; return a vehicle that answers, and its card."""
    mount, vehicle, card = holding(field, data)
    vehicle.left_alone = True
    process, mount.process = mount.alive(), None
    process.send_signal(signal.SIGTERM)
    wait_until("it delivers before it ends", lambda: "uploading" in process.text())
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 4
    vehicle.kill()
    vehicle.start()  # a paused one would still answer what it was asked before
    return vehicle, card


@pytest.mark.holds("promise 3")
def test_what_was_kept_is_listed_and_put_back_on_demand(field: Field, data: Path, state: Path) -> None:
    assert command("recover")[0] == "no recovered files\n"
    vehicle, card = left_behind(field, data)
    (directory,) = state.iterdir()
    assert (directory / "lost.bin").read_bytes() == data.read_bytes()
    assert directory.stat().st_mode & 0o777 == 0o700
    heading, line = command("recover")[0].splitlines()
    assert heading == f"{directory}:"
    uid = json.loads((directory / "lost.bin.json").read_text())["uid"]
    assert line.startswith(f"  lost.bin for /lost.bin on vehicle 1 (id {uid}), 60.0 kB, 20")
    assert not (card / "lost.bin").exists(), "never by itself"
    assert command("recover", vehicle.source, directory / "lost.bin")[0] == (
        "/lost.bin is on the vehicle now, verified; the copy here is removed\n"
    )
    assert (card / "lost.bin").read_bytes() == data.read_bytes()
    assert list(state.iterdir()) == []


def keep(state: Path, **files: dict[str, object]) -> Path:
    """Leave files as a mount that could not deliver them does; return their directory."""
    directory = state / "20261123-120000-1-udpin"
    directory.mkdir(parents=True)
    for name, facts in files.items():
        (directory / name).write_bytes(b"kept here")
        (directory / f"{name}.json").write_text(json.dumps(facts))
    return directory


def test_what_changed_since_is_not_replaced_and_what_is_there_is_not_sent(field: Field, state: Path) -> None:
    card = field.local("card")
    source = field.sim(card).source
    directory = keep(
        state, changed={"path": "/changed", "whole": True}, same={"path": "/same", "whole": True}
    )
    (card / "changed").write_bytes(b"somebody else's")
    (card / "same").write_bytes(b"kept here")
    os.utime(card / "same", (1, 1))
    told, said = command("recover", source, "--all", code=ExitCode.UNDELIVERED)
    assert "/same was there already" in told
    assert "/changed has 15 bytes on the vehicle, and had nothing when this was kept" in said
    assert (card / "changed").read_bytes() == b"somebody else's"
    assert f"mavftpfs put SOURCE {directory}/changed /changed" in said
    command("put", source, directory / "changed", "/changed")
    assert "/changed was there already" in command("recover", source, "--all")[0]
    assert ((card / "changed").read_bytes(), (card / "same").stat().st_mtime) == (b"kept here", 1)
    assert list(state.iterdir()) == []


@pytest.mark.holds("promise 3")
def test_one_file_that_fails_does_not_keep_the_others_here(field: Field, state: Path) -> None:
    """The card refuses the first name; the second file was changed since."""
    card = field.local("card")
    source = field.sim(card, "ardupilot5").source
    (card / "changed").write_bytes(b"somebody else's")
    names = ("a:b", "changed", "last")
    directory = keep(state, **{name: {"path": f"/{name}", "whole": True} for name in names})
    told, said = command("recover", source, "--all", code=ExitCode.UNDELIVERED)
    assert told == "/last is on the vehicle now, verified; the copy here is removed\n"
    lines = [line for line in said.splitlines() if f": {directory}/" in line]
    assert [line.split(": ")[1] for line in lines] == [f"{directory}/a:b", f"{directory}/changed"]
    assert (card / "last").read_bytes() == b"kept here"
    assert not (directory / "last").exists()


def test_a_description_goes_with_the_file_that_a_person_removed(state: Path) -> None:
    described: dict[str, object] = {"path": "/f", "system": 1, "uid": None, "whole": True}
    directory = keep(state, gone=described, **{"mine.json": described})
    (directory / "gone").unlink()
    (directory / "alone.json").write_text("{}")
    listed = command("recover")[0]
    assert "gone" not in listed
    assert "  mine.json for /f on vehicle 1, 9 B" in listed
    assert "  alone.json for ?, 2 B" in listed, "a user's own file, whose description was lost"
    assert {path.name for path in directory.iterdir()} == {"mine.json", "mine.json.json", "alone.json"}


@pytest.mark.holds("promise 3")
def test_a_file_of_another_vehicle_stays_here(field: Field, data: Path, state: Path) -> None:
    """Files whose vehicle was not written down may go to any."""
    mount = field.mount(field.sim(field.local("card"), "ardupilot5").source)
    mount.run("cp", data, mount.path / "no?such*name", code=None)
    process, mount.process = mount.alive(), None
    process.send_signal(signal.SIGTERM)
    assert process.wait() == ExitCode.UNDELIVERED
    (directory,) = state.iterdir()
    kept = directory / "no?such*name"
    facts = json.loads(Path(f"{kept}.json").read_text())
    assert (facts["system"], len(facts["uid"])) == (1, 16)
    card = field.local("card")
    other = field.sim(card, options=("--system", "2")).source
    keep(state, unknown={"path": "/unknown", "whole": True})
    stays = f"mavftpfs: 1 file of vehicle 1 (id {facts['uid']}) not sent: this is another vehicle; "
    for words in (("--all",), (directory,), (kept,)):
        assert stays in command("recover", other, *words, code=ExitCode.INCOMPLETE)[1]
    assert [path.name for path in card.iterdir()] == ["unknown"]
    assert kept.read_bytes() == data.read_bytes()


@pytest.mark.holds("promise 3")
def test_what_was_held_for_another_vehicle_of_the_same_system_id_waits_for_that_one(
    field: Field, data: Path, state: Path
) -> None:
    """The mount was killed, and the next one finds it: PX4's system id is 1 wherever it is fresh."""
    mount, vehicle, card = holding(field, data)
    vehicle.left_alone = True
    mount.kill()
    abort_mount(mount.path)
    vehicle.kill()
    others = field.local("card")
    second = field.mount(field.sim(others, options=("--seed", "5")).source)
    assert (told(second.alive()) / "lost.bin").read_bytes() == data.read_bytes()
    assert "of vehicle 1 (id " in command("recover", second.path, "--all", code=ExitCode.INCOMPLETE)[1]
    assert list(others.iterdir()) == []
    vehicle.start()
    command("recover", vehicle.source, "--all")
    assert (card / "lost.bin").read_bytes() == data.read_bytes()
    assert list(state.iterdir()) == []


def test_a_part_of_a_file_is_not_put_back(field: Field, state: Path) -> None:
    """A killed mount held bytes of a file that was being written, and of one that was changed in part."""
    card = field.local("card")
    directory = keep(
        state,
        written={"path": "/written"},
        changed={"path": "/changed", "whole": False, "size_on_vehicle": 9},
        unknown={},
    )
    listed = command("recover")[0]
    for reason in (
        "its program had not closed it",
        "only the changed parts of it",
        "its path on the vehicle is unknown",
    ):
        assert reason in listed
    command("recover", field.sim(card).source, directory / "changed", code=ExitCode.UNDELIVERED)
    assert list(card.iterdir()) == []
    assert len(list(directory.iterdir())) == 6
