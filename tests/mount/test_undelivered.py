"""What people are told of bytes that are not on the vehicle, and how they bring them there."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mavftpfs.client.control import find_socket, own_directories
from mavftpfs.shared.errors import ExitCode
from tests.mount.conftest import Field
from tests.mount.test_writing_ends import QUICK, holding, told
from tests.support.mounts import abort_mount, wait_until
from tests.support.mounts import command as run
from tests.support.trees import content
from tests.support.vehicles import SimVehicle

MAVFTPFS = (sys.executable, "-m", "mavftpfs")


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


def test_umount_says_what_it_waits_for_and_ctrl_c_ends_the_waiting_only(
    field: Field, data: Path, state: Path
) -> None:
    mount, vehicle, card = holding(field, data)
    process = mount.alive()
    with mount.started(*MAVFTPFS, "umount", mount.path) as child:
        assert child.stderr is not None
        first, second, third = (child.stderr.readline() for _ in range(3))
        assert first == (
            "mavftpfs: not everything is on the vehicle yet: it is delivered for at most 5 min, "
            f"then the rest is kept in {state}\n"
        )
        assert second == (
            f"mavftpfs: Ctrl-C ends only the waiting; to keep the rest now: kill {process.popen.pid}\n"
        )
        assert third == "mavftpfs: delivering 1 file, 0 B of 60.0 kB, until the vehicle is back\n"
        child.send_signal(signal.SIGINT)
        _, errors = child.communicate(timeout=60)
        assert child.returncode == ExitCode.INTERRUPTED
    assert errors == "mavftpfs: the mount goes on delivering, and then ends; see: mavftpfs status\n"
    assert f"{mount.path}: being unmounted, PX4 1/1, disarmed, LOST" in run("status")[0]
    mount.process = None
    vehicle.resume()
    assert process.wait() == 0
    assert (card / "lost.bin").read_bytes() == data.read_bytes()


def test_umount_of_a_mount_that_lost_its_socket_says_what_is_held(
    field: Field, data: Path, state: Path
) -> None:
    """systemd removes a user's runtime directory at logout; a mount in the background goes on."""
    mount, vehicle, card = holding(field, data)
    process = mount.alive()
    find_socket(str(mount.path), own_directories()).unlink()
    said = run("umount", mount.path, code=ExitCode.UNDELIVERED)[1]
    assert said.startswith("mavftpfs: 1 file not on the vehicle yet: the mount delivers by itself now")
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
    assert f"what came from stdin is kept in {kept}" in done.stderr
    assert kept.read_bytes() == data.read_bytes()


def left_behind(field: Field, data: Path) -> tuple[SimVehicle, Path]:
    """Have a mount end with a file that is not delivered; return a vehicle that answers, and its card."""
    mount, vehicle, card = holding(field, data)
    vehicle.left_alone = True
    process, mount.process = mount.alive(), None
    process.send_signal(signal.SIGTERM)
    wait_until("it delivers before it ends", lambda: "delivering" in process.text())
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 4
    vehicle.kill()
    vehicle.start()  # a paused one would still answer what it was asked before
    return vehicle, card


@pytest.mark.holds("promise 3")
def test_what_was_kept_is_listed_and_put_back_on_demand(field: Field, data: Path, state: Path) -> None:
    assert run("recover")[0] == "nothing was kept\n"
    vehicle, card = left_behind(field, data)
    (directory,) = state.iterdir()
    assert (directory / "lost.bin").read_bytes() == data.read_bytes()
    assert directory.stat().st_mode & 0o777 == 0o700
    heading, line = run("recover")[0].splitlines()
    assert heading == f"{directory}:"
    (facts,) = json.loads(run("recover", "--json")[0])
    assert line.startswith(f"  lost.bin for /lost.bin on vehicle 1 (id {facts['uid']}), 60.0 kB, 20")
    assert (facts["file"], facts["path"], facts["size"]) == (f"{directory}/lost.bin", "/lost.bin", 60_000)
    assert facts["hindrance"] is None
    assert not (card / "lost.bin").exists(), "never by itself"
    assert run("recover", vehicle.source, directory / "lost.bin")[0] == (
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


def test_what_changed_since_is_replaced_only_by_force_and_what_is_there_is_not_sent(
    field: Field, state: Path
) -> None:
    card = field.local("card")
    source = field.sim(card).source
    keep(state, changed={"path": "/changed", "whole": True}, same={"path": "/same", "whole": True})
    (card / "changed").write_bytes(b"somebody else's")
    (card / "same").write_bytes(b"kept here")
    os.utime(card / "same", (1, 1))
    _, said = run("recover", source, "--all", code=ExitCode.USAGE)
    assert "/changed has 15 bytes on the vehicle, and had nothing when this was kept" in said
    assert (card / "changed").read_bytes() == b"somebody else's"
    assert "/same was there already" in run("recover", source, "--all", "--force")[0]
    assert ((card / "changed").read_bytes(), (card / "same").stat().st_mtime) == (b"kept here", 1)
    assert list(state.iterdir()) == []


@pytest.mark.holds("promise 3")
def test_a_file_is_put_on_another_vehicle_only_by_its_name_and_force(
    field: Field, data: Path, state: Path
) -> None:
    """`--all` and directories mean files of the vehicle, and those of which that is not known."""
    mount = field.mount(field.sim(field.local("card"), "ardupilot5").source)
    mount.run("cp", data, mount.path / "no?such*name", code=None)
    process, mount.process = mount.alive(), None
    process.send_signal(signal.SIGTERM)
    assert process.wait() == ExitCode.UNDELIVERED
    (directory,) = state.iterdir()
    (facts,) = json.loads(run("recover", "--json")[0])
    assert (facts["system"], len(facts["uid"])) == (1, 16)
    card = field.local("card")
    other = field.sim(card, options=("--system", "2")).source
    keep(state, unknown={"path": "/unknown", "whole": True})
    stays = f"mavftpfs: 1 file(s) of vehicle 1 (id {facts['uid']}) stay here: this is another vehicle; "
    for words in (("--all",), (directory,), ("--all", "--force")):
        assert stays in run("recover", other, *words, code=ExitCode.INCOMPLETE)[1]
    assert [path.name for path in card.iterdir()] == ["unknown"]
    _, said = run("recover", other, facts["file"], code=ExitCode.USAGE)
    assert f"is of vehicle 1 (id {facts['uid']}), and this is vehicle 2 (id " in said
    assert len(list(card.iterdir())) == 1
    run("recover", other, facts["file"], "--force")
    assert (card / "no?such*name").read_bytes() == data.read_bytes()
    assert list(state.iterdir()) == []


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
    assert "of vehicle 1 (id " in run("recover", second.path, "--all", code=ExitCode.INCOMPLETE)[1]
    assert list(others.iterdir()) == []
    vehicle.start()
    run("recover", vehicle.source, "--all")
    assert (card / "lost.bin").read_bytes() == data.read_bytes()
    assert list(state.iterdir()) == []


def test_a_part_of_a_file_is_not_put_back(field: Field, state: Path) -> None:
    """What a killed mount held of a file that was being written, and of one that was changed in part."""
    card = field.local("card")
    directory = keep(
        state,
        written={"path": "/written"},
        changed={"path": "/changed", "whole": False, "size_on_vehicle": 9},
        unknown={},
    )
    listed = run("recover")[0]
    for reason in ("a program was still writing it", "only the changed parts of it", "was not written down"):
        assert reason in listed
    run("recover", field.sim(card).source, directory / "changed", "--force", code=ExitCode.USAGE)
    assert list(card.iterdir()) == []
    assert len(list(directory.iterdir())) == 6
