"""`-o all`: each vehicle on a port is a mount below one mountpoint."""

from __future__ import annotations

import filecmp
import json
import os
import random
import signal
import stat
import subprocess
import sys
import sysconfig
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest

from mavftpfs.client.control import ControlError
from mavftpfs.client.mountpoint import vehicles_below
from mavftpfs.client.mounts import status_of, with_vehicles
from mavftpfs.link.messages import Address
from tests.mount.conftest import Field
from tests.support.mounts import PATIENCE, Mount, command, mavftpfs, mounted_at, wait_until
from tests.support.neighbours import Beating
from tests.support.vehicles import HOST, PROJECT, Program, SimVehicle, free_udp_port

PROFILES = {1: "px4", 2: "ardupilot5", 3: "mavsdk"}


class Fleet:
    """Three vehicles of three kinds on one port."""

    def __init__(self, field: Field) -> None:
        self.field = field
        self.port = free_udp_port()
        self.cards: dict[int, Path] = {}
        self.vehicles: dict[int, SimVehicle] = {}
        for system in PROFILES:
            self.cards[system] = root = field.local(f"card{system}")
            (root / "log").mkdir()
            for number in range(4):
                content = random.Random(system * 10 + number).randbytes(20_000 + 5000 * number)
                (root / "log" / f"{number}.bin").write_bytes(content)

    @property
    def source(self) -> str:
        return f"udpin:{HOST}:{self.port}"

    def launch(self, system: int, *options: str, profile: str = "") -> SimVehicle:
        words = ("--system", str(system), "--seed", str(system), *options)
        link = f"udpout:{HOST}:{self.port}"
        vehicle = self.field.sim(self.cards[system], profile or PROFILES[system], words, link=link)
        self.vehicles[system] = vehicle
        return vehicle


class Mounts(Mount):
    """A mount of all vehicles."""

    def serves(self) -> bool:
        """Return whether it can be asked: its directory is no mount."""
        try:
            return "members" in self.status()
        except ControlError:
            return False

    def facts(self) -> dict[str, Any]:
        """Return what `status` says of all."""
        return dict(with_vehicles(status_of(str(self.path)))[0])

    def states(self) -> dict[str, str]:
        """Return what state each vehicle's mount is in."""
        return {member["name"]: member["state"] for member in self.facts()["members"]}

    def await_up(self, *names: str) -> None:
        """Wait until the vehicles of these names are mounted."""
        wait_until(
            f"{names} are mounted",
            lambda: (
                all(self.states().get(name) == "mounted" for name in names)
                and all(mounted_at(self.path / name) for name in names)
            ),
        )

    def pids(self) -> dict[str, int]:
        """Return the process of each vehicle's mount."""
        return {Path(one["mountpoint"]).name: one.get("pid", 0) for one in self.facts()["vehicles"]}

    def unmount(self) -> int:
        """Unmount all, by our own command."""
        assert self.process is not None
        command("umount", self.path)
        return self.process.wait(60)

    def finish(self) -> None:
        """End it, whatever state it is in."""
        process, self.process = self.process, None
        if vehicles_below(str(self.path)) or (process is not None and process.running):
            subprocess.run(
                [sys.executable, "-m", "mavftpfs", "umount", "-l", str(self.path)],
                cwd=PROJECT,
                check=False,
                timeout=PATIENCE,
                capture_output=True,
            )
        if process is not None and process.running:
            process.stop()


@pytest.fixture
def fleet(field: Field) -> Fleet:
    """Three cards; no vehicle speaks yet."""
    return Fleet(field)


def mount_all(fleet: Fleet, *systems: int) -> Mounts:
    """Launch these vehicles and mount all; returns once they are mounted."""
    for system in systems:
        fleet.launch(system)
    folder = fleet.field.local("mount")
    path = folder / "mnt"
    path.mkdir()
    mounts = Mounts(fleet.source, path, folder, ("all",))
    fleet.field._stack.callback(mounts.finish)
    mounts.start()
    mounts.await_up(*map(str, systems))
    return mounts


def rsync(mounts: Mounts, name: str, local: Path) -> subprocess.Popen[bytes]:
    argv = ["rsync", "-a", "--inplace", f"{mounts.path}/{name}/log/", f"{local}/"]
    return subprocess.Popen(argv, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def same(card: Path, local: Path) -> bool:
    names = sorted(path.name for path in (card / "log").iterdir())
    wrong = filecmp.cmpfiles(card / "log", local, names, shallow=False)[1:]
    return wrong == ([], []) and sorted(os.listdir(local)) == names


def test_the_parameters_of_several_vehicles_are_compared(fleet: Fleet) -> None:
    for system in (1, 2):
        fleet.launch(system, profile="ardupilot5")
    mounts = mount_all(fleet)
    mounts.await_up("1", "2")
    assert command("param", mounts.path, "--diff") == ("", "")
    command("param", mounts.path / "2", "RTL_ALT=3000", "WPNAV_SPEED=750.5", "STAT_RUNTIME=77")
    table = command("param", mounts.path, "--diff", code=1)[0].splitlines()
    assert table == ["                1  2", "WPNAV_SPEED  1000  750.5", "RTL_ALT      1500  3000"]
    rows = json.loads(command("param", mounts.path, "--diff", "--json", code=1)[0])
    assert {"name": "RTL_ALT", "1": "1500", "2": "3000"} in rows
    fleet.launch(3)
    mounts.await_up("3")
    out, err = command("param", mounts.path, "--diff", code=2)
    assert out.splitlines() == table
    assert err.startswith("mavftpfs: vehicle 3 is left out: this vehicle has no parameters")
    fleet.vehicles[2].left_alone = True
    fleet.vehicles[2].kill()
    wait_until("it is lost", lambda: "LOST" in command("status", mounts.path / "2")[0])
    assert "two are needed" in command("param", mounts.path, "--diff", code=2)[1]
    assert "only one vehicle" in command("param", mounts.path / "1", "--diff", code=1)[1]
    assert "needs a FILE" in command("param", fleet.source, "--diff", code=1)[1]


def test_three_vehicles_are_copied_at_once_one_dies_and_one_is_armed(fleet: Fleet) -> None:
    for system in PROFILES:
        fleet.launch(system, *(("--armed",) if system == 3 else ()))
    mounts = mount_all(fleet)
    mounts.await_up("1", "2", "3")
    assert sorted(mounts.run("ls", mounts.path).stdout.split()) == ["1", "2", "3"]
    locals_ = {system: fleet.field.local(f"copy{system}") for system in PROFILES}
    copies = {system: rsync(mounts, str(system), local) for system, local in locals_.items()}
    fleet.vehicles[1].kill()
    time.sleep(0.5)
    fleet.vehicles[1].start()
    for system, copy in copies.items():
        _, errors = copy.communicate(timeout=120)
        if system == 1 and copy.returncode:
            # It may have been in the middle of a file; rsync says so, and the next one is right.
            assert errors
            wait_until("it reads again", lambda: rsync(mounts, "1", locals_[1]).wait(60) == 0)
        else:
            assert copy.returncode == 0, errors
        assert same(fleet.cards[system], locals_[system])
    assert "ARMED" in command("status", mounts.path)[0]
    code = "open(sys.argv[1], 'w')"
    assert mounts.errno_of(code, mounts.path / "3" / "new") == "EROFS"
    assert mounts.errno_of(code, mounts.path / "2" / "new") == ""
    fleet.vehicles[1].left_alone = True
    assert mounts.unmount() == 0
    assert not any(mounted_at(mounts.path / name) for name in ("1", "2", "3"))


def unlisted(mounts: Mounts, name: str) -> bool:
    """Return whether a vehicle's directory is there, and cannot be listed. (Root may list all.)"""
    path = mounts.path / name
    if os.geteuid() == 0:
        return stat.S_IMODE(path.stat().st_mode) == 0o300
    return mounts.errno_of("os.listdir(sys.argv[1])", path) == "EACCES"


def test_a_vehicle_that_is_not_mounted_never_reads_as_empty(fleet: Fleet) -> None:
    mounts = mount_all(fleet)
    assert mounts.states() == {}
    fleet.launch(1)
    wait_until("its directory is there", (mounts.path / "1").exists)
    assert unlisted(mounts, "1") or mounted_at(mounts.path / "1")
    mounts.await_up("1")
    fleet.launch(2)  # one that comes late
    mounts.await_up("1", "2")
    assert mounts.read_bytes(mounts.path / "2/log/0.bin") == (fleet.cards[2] / "log/0.bin").read_bytes()
    command("umount", mounts.path / "2")
    assert unlisted(mounts, "2")
    wait_until("it is known", lambda: mounts.states()["2"] == "unmounted")
    assert mounts.unmount() == 0
    assert os.listdir(mounts.path) == []


def test_a_directory_with_other_things_in_it_is_refused(fleet: Fleet) -> None:
    folder = fleet.field.local("full")
    (folder / "1").mkdir()  # a directory of the user's, which can be listed
    said = mavftpfs(fleet.source, folder, "-o", "all", code=3)[1]
    assert f"{folder} has entries of its own (1)" in said


def test_a_killed_mount_of_one_comes_back_and_the_others_go_on(fleet: Fleet) -> None:
    mounts = mount_all(fleet, *PROFILES)
    before = mounts.pids()
    fleet.vehicles[2].left_alone = True
    os.kill(before["2"], signal.SIGKILL)
    assert mounts.read_bytes(mounts.path / "1/log/1.bin") == (fleet.cards[1] / "log/1.bin").read_bytes()
    wait_until("it comes back", lambda: mounts.pids().get("2", 0) not in (0, before["2"]))
    mounts.await_up("2")
    assert mounts.read_bytes(mounts.path / "2/log/1.bin") == (fleet.cards[2] / "log/1.bin").read_bytes()
    assert mounts.pids()["1"] == before["1"]
    fleet.vehicles[3].kill()
    os.kill(before["3"], signal.SIGKILL)
    wait_until("its mount is gone", lambda: mounts.states()["3"] in ("failed", "starting"))
    assert sorted(mounts.run("ls", mounts.path).stdout.split()) == ["1", "2", "3"]
    assert mounts.errno_of("os.listdir(sys.argv[1])", mounts.path / "3") == "ENOTCONN", "it is not empty"
    fleet.launch(3)
    wait_until("it comes back", lambda: mounts.pids().get("3", 0) not in (0, before["3"]))
    mounts.await_up("3")


def test_a_killed_supervisor_leaves_the_mounts_and_loses_nothing(fleet: Fleet) -> None:
    mounts = mount_all(fleet, 1, 2)
    mounts.alive().kill()
    for system in (1, 2):
        log = f"{system}/log/2.bin"
        assert mounts.read_bytes(mounts.path / log) == (fleet.cards[system] / "log/2.bin").read_bytes()
        data = f"written {system}".encode() * 300
        code = "open(sys.argv[1], 'wb').write(bytes.fromhex(sys.argv[2]))"
        mounts.run(sys.executable, "-c", f"import sys; {code}", mounts.path / f"{system}/new", data.hex())
        assert (fleet.cards[system] / "new").read_bytes() == data
    assert "vehicles are mounted below" in mavftpfs(fleet.source, mounts.path, "-o", "all", code=3)[1]
    assert len(json.loads(command("status", "--json", mounts.path)[0])["vehicles"]) == 2
    assert "no more vehicles are mounted" in command("status", mounts.path, code=3)[0]
    command("umount", mounts.path)
    assert os.listdir(mounts.path) == []


def test_all_starts_again_where_a_killed_run_left_its_directories(fleet: Fleet) -> None:
    mounts = mount_all(fleet, 1, 2)
    pids = mounts.pids()
    mounts.alive().kill()
    fleet.vehicles[2].left_alone = True
    os.kill(pids["2"], signal.SIGKILL)
    command("umount", mounts.path / "1")
    assert unlisted(mounts, "1")
    wait_until(
        "it is dead", lambda: mounts.errno_of("os.listdir(sys.argv[1])", mounts.path / "2") == "ENOTCONN"
    )
    mounts.start()
    mounts.await_up("1", "2")
    for system in (1, 2):
        log = f"{system}/log/2.bin"
        assert mounts.read_bytes(mounts.path / log) == (fleet.cards[system] / "log/2.bin").read_bytes()
    assert mounts.unmount() == 0
    assert os.listdir(mounts.path) == []


def test_commands_know_the_vehicles_below(fleet: Fleet) -> None:
    for system in (1, 2):
        fleet.launch(system)
    mounts = mount_all(fleet)
    mounts.await_up("1", "2")
    for options in ((), ("-o", "target_system=1")):
        said = command("ls", mounts.path, "/log", *options, code=1)[1]
        assert said.endswith(f"is for several vehicles (1, 2); name one, as {mounts.path}/1\n")
    for system in (1, 2):
        local = fleet.field.local(f"sync{system}")
        command("sync", mounts.path / str(system), local, "--from", "/log")
        assert same(fleet.cards[system], local)
        assert "0.bin" in command("ls", fleet.source, "/log", "-o", f"target_system={system}")[0]
    assert "no vehicle is mounted on" in command("ls", mounts.path / "9", code=1)[1]
    for source in (mounts.path, fleet.source):
        found = json.loads(command("scan", "--json", source)[0])
        assert [entry["system"] for entry in found if entry["answers"]] == [1, 2]
    assert len(json.loads(command("status", "--json", mounts.path)[0])["vehicles"]) == 2
    lines = command("status", mounts.path)[0].splitlines()
    assert lines[0] == f"{mounts.path}: 2 vehicles of {fleet.source}"
    with Beating(fleet.port, (Address(1, 1), 2, 12)):
        wait_until("a second one is known", lambda: bool(mounts.facts()["vehicles"][0]["link"]["second"]))
        for words in (("status", mounts.path), ("scan", fleet.source), ("hub", fleet.source)):
            assert "a second vehicle" in command(*words)[0]
        assert mounts.read_bytes(mounts.path / "1/log/0.bin") == (fleet.cards[1] / "log/0.bin").read_bytes()
    assert "give each a system id of its own" in mounts.alive().text()


def test_a_watch_by_the_mount_of_one_names_the_others(fleet: Fleet) -> None:
    mount_all(fleet, 1, 2)
    argv = ["mavftpfs.__main__", "sync", fleet.source, str(fleet.field.local("sync")), "--watch"]
    watch = Program("sync", argv, fleet.field.local("out"))
    fleet.field.own(watch)
    wait_until("the other one is named", lambda: "to choose one, use -o target_system=" in watch.text())
    assert watch.stop() == 0


def test_a_busy_one_refuses_the_unmount_of_all_and_a_signal_ends_all(fleet: Fleet) -> None:
    mounts = mount_all(fleet, 1, 2)
    with mounts.started("sleep", "100", cwd=mounts.path / "1") as holder:
        said = command("umount", mounts.path, code=3)[1]
        assert f"{mounts.path}/1 is in use" in said
        assert said.endswith("; unmounted: 2\n")
        assert mounted_at(mounts.path / "1")
        holder.kill()
    fleet.launch(3)
    mounts.await_up("3")
    with mounts.started("sleep", "100", cwd=mounts.path / "3") as holder:
        assert mounts.end_by(signal.SIGTERM) == 0
        holder.kill()
    assert os.listdir(mounts.path) == []


def test_all_and_a_target_exclude_each_other(fleet: Fleet) -> None:
    said = mavftpfs(fleet.source, fleet.field.local("mnt"), "-o", "all,target_system=1", code=1)[1]
    assert "target_system" in said


# -- an ordinary user -------------------------------------------------------------------------------

AS_AN_ORDINARY_USER = """
set -e
scratch=$1 python=$2 packages=$3 project=$4
mkdir "$scratch/dev" "$scratch/python" "$scratch/packages" "$scratch/project"
mount -t tmpfs -o mode=755,size=64k tmpfs "$scratch/dev"  # /tmp may forbid devices
mknod -m 666 "$scratch/dev/fuse" c 10 229
mount --bind "$scratch/dev/fuse" /dev/fuse
mount --bind "$scratch/fuse.conf" /etc/fuse.conf  # empty: no user_allow_other
mount --bind "$python" "$scratch/python"  # these three may lie in a home that only root may enter
mount --bind "$packages" "$scratch/packages"
mount --bind "$project" "$scratch/project"
shift 4
exec setpriv --reuid=65534 --regid=65534 --clear-groups env -i PATH=/usr/bin:/bin HOME="$scratch/home" \\
    PYTHONPATH="$scratch/project:$scratch/packages" LD_LIBRARY_PATH="$scratch/python/lib" "$@"
"""
MOUNT_AND_COPY = """
"$1" -m mavftpfs "$2" "$3/mnt" -o all || exit
tries=0
until cp "$3/mnt/1/log/0.bin" "$3/one" 2>&- && cp "$3/mnt/2/log/1.bin" "$3/two" 2>&-; do
    tries=$((tries + 1))
    [ "$tries" -lt 300 ] || break
    sleep 0.1
done
"$1" -m mavftpfs umount "$3/mnt/1"
LC_ALL=C ls "$3/mnt/1" 2>"$3/unmounted"
exec "$1" -m mavftpfs umount "$3/mnt"
"""


@pytest.mark.needs("namespaces")
def test_an_ordinary_user_mounts_all(fleet: Fleet) -> None:
    """fusermount3 works as root, and the kernel keeps root out of a user's own mounts."""
    for system in (1, 2):
        fleet.launch(system)
    with tempfile.TemporaryDirectory(dir="/tmp") as name:  # pytest's directories are root's alone
        scratch, home = Path(name), Path(name, "home")
        scratch.chmod(0o755)
        home.mkdir()
        (home / "mnt").mkdir()
        for path in (home, home / "mnt"):
            os.chown(path, 65534, 65534)
        (scratch / "fuse.conf").touch(0o644)
        python = scratch / "python" / os.path.relpath(os.path.realpath(sys.executable), sys.base_prefix)
        inside = ["sh", "-c", MOUNT_AND_COPY, "sh", str(python), fleet.source, str(home)]
        places = (name, sys.base_prefix, sysconfig.get_path("platlib"), str(PROJECT))
        done = subprocess.run(
            ["unshare", "--mount", "sh", "-c", AS_AN_ORDINARY_USER, "sh", *places, *inside],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            cwd="/",
            check=False,
        )
        assert done.returncode == 0, done.stderr
        for local, card, log in (("one", 1, "0.bin"), ("two", 2, "1.bin")):
            assert (home / local).read_bytes() == (fleet.cards[card] / "log" / log).read_bytes()
        assert "Permission denied" in (home / "unmounted").read_text()
