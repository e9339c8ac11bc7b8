"""`mavftpfs sync`, and get and put on slow links: as processes, on each server, beside a mount too."""

from __future__ import annotations

import filecmp
import os
import random
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mavftpfs.client.mounts import is_wanted
from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, MAV_TYPE_GCS, Address
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared.options import Options
from mavftpfs.shared.readable import readable_size
from tests.mount.conftest import Field
from tests.support import terminal
from tests.support.mounts import COMMAND_TIMEOUT, mavftpfs, wait_until
from tests.support.mounts import command as run
from tests.support.neighbours import Beating
from tests.support.vehicles import HOST, PROJECT, Program, free_udp_port

FAR = ("--delay", "0.2")
"""A round trip in which a growing log grows before the next question, on a busy machine, too."""


def argv(*words: object) -> list[str]:
    return [sys.executable, "-m", "mavftpfs", *map(str, words)]


def sync(*words: object, code: int = 0) -> str:
    """Run `sync`; return its last line."""
    return run("sync", *words, code=code)[0].splitlines()[-1]


def write_log(path: Path, size: int, seed: int, day: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(random.Random(seed).randbytes(size))
    when = 1_714_521_600 + day * 86_400
    os.utime(path, (when, when))


def logs_of(folder: Path) -> list[Path]:
    """Make three logs, the youngest last."""
    paths = [folder / "2024-05-01" / "10_00_00.ulg", folder / "2024-05-02" / "09_00_00.ulg"]
    paths.append(folder / "2024-05-02" / "11_00_00.ulg")
    for number, path in enumerate(paths):
        write_log(path, 60_000 + number, number, number + 1)
    return paths


def local_files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@contextmanager
def started(*words: object) -> Iterator[subprocess.Popen[str]]:
    """Run a command beside the test's own steps."""
    with subprocess.Popen(
        argv(*words), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=PROJECT
    ) as child:
        try:
            yield child
        finally:
            child.kill()


def test_new_logs_come_newest_first_and_a_second_run_moves_nothing(field: Field, tmp_path: Path) -> None:
    vehicle = field.mavsdk(field.local("card"))
    card = vehicle.root / "logs"
    logs = logs_of(card)
    local = tmp_path / "logs"
    planned, _ = run("sync", "--dry-run", vehicle.source, local)
    assert planned.splitlines()[-1].startswith("would download 3 (180.0 kB)")
    out, _ = run("sync", vehicle.source, local)
    *lines, summary = out.splitlines()
    youngest_first = [str(path.relative_to(card)) for path in reversed(logs)]
    assert [line.partition(":")[0] for line in lines] == youngest_first
    assert all(line.endswith("verified by size and CRC32") for line in lines)
    assert summary.startswith("3 new (180.0 kB), 0 here already, from /")
    assert local_files(local) == set(youngest_first)
    assert all(filecmp.cmp(card / name, local / name, shallow=False) for name in youngest_first)
    out, printed = run("sync", "-d", vehicle.source, local)
    assert out.startswith("0 new (0 B), 3 here already, from /")
    asked = set(re.findall(r" -> (\w+) ", printed))
    assert "LIST_DIRECTORY_WITH_TIME" in asked
    assert not asked & {"READ_FILE", "BURST_READ_FILE"}
    write_log(card / "2024-05-03" / "08_00_00.ulg", 1000, 9, 9)
    assert sync(vehicle.source, local, "--newest", 1).startswith("1 new (1.0 kB), 0 here already, from /")


def test_since_says_first_that_a_vehicle_tells_no_times(field: Field, tmp_path: Path) -> None:
    vehicle = field.sim(field.local("card"), "ardupilot")
    write_log(vehicle.root / "APM/LOGS/00000001.BIN", 60_000, 1, 1)
    (vehicle.root / "APM/LOGS/LASTLOG.TXT").write_text("1")
    warning = (
        "mavftpfs: --since does not leave out 1 of 2 logs (60.0 kB), because the vehicle reports no time for "
        "them; use --newest N to download fewer\n"
    )
    words = ("sync", vehicle.source, tmp_path / "logs", "--since", "2h")
    out, err = run(*words, "--dry-run")
    assert (out.splitlines()[-1][:16], err) == ("would download 2", warning)
    with started(*words, "-o", "bwlimit=50000") as child:
        assert child.stderr is not None
        assert child.stderr.readline() == warning
        assert not (tmp_path / "logs/00000001.BIN").exists()
        assert child.stdout is not None
        assert child.stdout.read().splitlines()[-1].endswith("from /APM/LOGS")
    assert run(*words)[1] == ""


def test_since_takes_the_time_from_a_name_that_has_one(field: Field, tmp_path: Path) -> None:
    vehicle = field.sim(field.local("card"))
    for name in ("2024-05-01/10_00_00.ulg", "2024-05-01/note.txt", "2024-05-01_10-00-00.bin"):
        write_log(vehicle.root / "log" / name, 100, 1, 1)
        write_log(vehicle.root / "log" / name.replace("2024", "2025"), 100, 1, 1)
    _, err = run("sync", vehicle.source, tmp_path / "logs", "--since", "2025-01-01")
    assert local_files(tmp_path / "logs") == {
        "2025-05-01/10_00_00.ulg",
        "2025-05-01/note.txt",
        "2025-05-01_10-00-00.bin",
    }
    assert err == ""


def test_patterns_choose_the_files_of_sync_and_get(field: Field, tmp_path: Path) -> None:
    vehicle = field.sim(field.local("card"))
    for name in ("2024-05-01/a.ulg", "2024-05-01/a.txt", "2024-05-02/b.ulg", "sess001/c.ulg", "d/e/f.txt"):
        write_log(vehicle.root / "log" / name, 100, 1, 1)
    run("sync", vehicle.source, tmp_path / "s", "--include", "*.ulg", "--exclude", "2024-05-01/*")
    assert local_files(tmp_path / "s") == {"2024-05-02/b.ulg", "sess001/c.ulg"}
    words = ("--exclude", "2024-*/*", "--exclude", "c.*")
    run("get", "-r", vehicle.source, "/log", "--to", tmp_path / "g", *words)
    assert [str(path.relative_to(tmp_path / "g")) for path in sorted((tmp_path / "g").rglob("*"))] == [
        "log",
        "log/d",
        "log/d/e",
        "log/d/e/f.txt",
    ]
    words = ("/log/*/?.*", "/log/sess001/c.ulg", "--include", "[ab].*")
    run("get", vehicle.source, *words, "--to", tmp_path / "p")
    assert local_files(tmp_path / "p") == {"2024-05-01/a.ulg", "2024-05-01/a.txt", "2024-05-02/b.ulg"}
    err = run("get", vehicle.source, "/log/d/e/f.txt", "--to", tmp_path / "n", "--exclude", "f*", code=1)[1]
    assert "leave no file" in err
    assert not (tmp_path / "n").exists()


def test_ctrl_c_leaves_a_part_and_the_next_run_goes_on(field: Field, tmp_path: Path) -> None:
    vehicle = field.mavsdk(field.local("card"))
    big, local = vehicle.root / "logs" / "big.bin", tmp_path / "logs"
    part = local / "big.bin.part"
    write_log(big, 700_000, 1, 1)
    with started("sync", vehicle.source, local, "-o", "bwlimit=50000") as child:
        wait_until("a part is here", lambda: part.exists() and part.stat().st_size > 0)
        child.send_signal(signal.SIGINT)
        out, err = child.communicate(timeout=COMMAND_TIMEOUT)
    assert (child.returncode, out) == (130, "")
    told = "0 of 1 files are here; the next run resumes where this one stopped"
    assert err == f"mavftpfs: interrupted: {told}\n"
    assert local_files(local) == {"big.bin.part"}
    came = part.read_bytes()
    assert big.read_bytes().startswith(came)
    resumed, _ = run("sync", vehicle.source, local, "--verify=none")[0].splitlines()
    at = f"resumed at {readable_size(len(came))}"
    assert resumed == f"big.bin: 700.0 kB, {at}, verified by size and CRC32"
    assert (local / "big.bin").read_bytes() == big.read_bytes()
    assert local_files(local) == {"big.bin"}


def test_patterns_that_leave_nothing_are_said(field: Field, tmp_path: Path) -> None:
    vehicle = field.sim(field.local("card"))
    logs_of(vehicle.root / "log")
    out, err = run("sync", vehicle.source, tmp_path / "logs", "--include", "*.nope")
    assert out.startswith("0 new (0 B), 0 here already")
    assert err == "mavftpfs: --include and --exclude leave no log to download (3 in all)\n"
    assert run("sync", vehicle.source, tmp_path / "logs", "--include", "*.ulg")[1] == ""
    assert run("sync", vehicle.source, tmp_path / "logs", "--since", "2h")[1] == ""


def test_new_files_are_found_through_a_mount_that_listed_before(field: Field, tmp_path: Path) -> None:
    vehicle = field.sim(field.local("card"))
    logs = logs_of(vehicle.root / "log")
    mount = field.mount(vehicle.source)
    mount.run("ls", mount.path / "log/2024-05-02")
    write_log(vehicle.root / "log/2024-05-02/12_00_00.ulg", 1000, 7, 7)
    assert sync(mount.path, tmp_path / "logs").startswith(f"{len(logs) + 1} new")
    missing = mount.path / "log/2024-05-02/13_00_00.ulg"
    assert "does not exist" in run("get", missing, "--to", tmp_path / "got", code=1)[1]
    write_log(vehicle.root / "log/2024-05-02/13_00_00.ulg", 1000, 8, 8)
    run("get", missing, "--to", tmp_path / "got")
    assert (tmp_path / "got").stat().st_size == 1000
    write_log(vehicle.root / "log/2024-05-02/14_00_00.ulg", 1000, 9, 9)
    run("get", mount.path, "/log/*/14*", "--to", tmp_path / "matched")
    assert (tmp_path / "matched/2024-05-02/14_00_00.ulg").stat().st_size == 1000


def test_verbs_use_the_mount_that_is_up(field: Field, tmp_path: Path) -> None:
    card = field.local("card")
    logs = logs_of(card / "APM/LOGS")
    vehicle = field.sim(card, "ardupilot")  # it has a single session for everybody
    mount = field.mount(vehicle.source)
    for source in (vehicle.source, mount.path):
        local = tmp_path / f"logs{len(str(source))}"
        assert sync(source, local).startswith(f"{len(logs)} new")
        assert len(local_files(local)) == len(logs)
    assert sync(mount.path, local).startswith(f"0 new (0 B), {len(logs)} here already")
    assert "does not exist" in run("ls", mount.path, "/none", code=1)[1]
    (tmp_path / "new").write_bytes(b"new" * 1000)
    source = vehicle.source
    run("put", source, tmp_path / "new", "/APM/new")
    assert (card / "APM/new").read_bytes() == b"new" * 1000
    run("mv", source, "/APM/new", "/APM/newer")
    assert run("cat", source, "/APM/newer")[0] == "new" * 1000
    assert run("crc", source, "/APM/newer")[0] == f"{crc32(b'new' * 1000):08x}  /APM/newer\n"
    run("rm", source, "/APM/newer")
    run("mkdir", source, "/APM/d")
    run("rmdir", source, "/APM/d")
    assert os.listdir(card / "APM") == ["LOGS"]
    assert str(mount.path) in run("scan", source)[0]


def test_a_mounted_subtree_and_what_lies_outside_of_it(field: Field, tmp_path: Path) -> None:
    vehicle = field.sim(field.local("card"))
    logs_of(vehicle.root / "log")
    (vehicle.root / "other").write_bytes(b"x")
    mount = field.mount(f"{vehicle.source}#/log")
    assert run("ls", vehicle.source, "/log")[0] == run("ls", mount.path)[0] == "2024-05-01/\n2024-05-02/\n"
    assert run("ls", f"{vehicle.source}#/log/2024-05-01")[0] == "10_00_00.ulg\n"
    assert run("ls", f"{mount.path}#/2024-05-01")[0] == "10_00_00.ulg\n"
    assert "outside" in run("cat", vehicle.source, "/other", code=1)[1]
    assert sync(vehicle.source, tmp_path / "a").startswith("3 new")


def test_a_path_inside_a_mount_is_a_source(field: Field, tmp_path: Path) -> None:
    vehicle = field.sim(field.local("card"))
    logs = logs_of(vehicle.root / "log")
    (vehicle.root / "log/note").write_bytes(b"note")
    mount = field.mount(vehicle.source)
    link = tmp_path / "link"
    link.symlink_to(mount.path / "log")
    for place in (mount.path / "log", link):
        assert run("ls", place)[0] == "2024-05-01/\n2024-05-02/\nnote\n"
        assert run("cat", place, "note")[0] == "note"
    assert run("ls", f"{link}#2024-05-01")[0] == "10_00_00.ulg\n"
    assert sync(mount.path / "log", tmp_path / "logs").startswith(f"{len(logs) + 1} new")
    told = "/log/note: 4 B, verified by size and CRC32\n"
    assert run("get", link, "note", "--to", f"{tmp_path}/")[0] == told
    assert run("put", link, tmp_path / "note", "./")[0] == told
    assert run("cat", place, "mftp://[comp=1:]/note")[0] == "note"
    assert "of vehicle 1/1" in run("cat", place, "mftp://comp=100:/note", code=1)[1]
    assert "'/log/none' does not exist" in run("ls", link / "none", code=1)[1]


IN_A_NAMESPACE = """
ip link set lo up
"$1" -m mavftpfs sim "$2" --link "$3" >&2 & vehicle=$!
trap 'kill $vehicle; wait $vehicle' EXIT
"$1" -m mavftpfs ls "$4"
"""


@pytest.mark.needs("namespaces")
def test_a_mount_of_another_network_namespace_is_another_vehicles(field: Field) -> None:
    """The two ports are spelled alike, and the mount's files can be seen from there."""
    vehicle = field.sim(field.local("card"))
    (vehicle.root / "ours").touch()
    (theirs := field.local("theirs") / "theirs").touch()
    mount = field.mount(vehicle.source)
    assert run("ls", vehicle.source)[0] == "ours\n"
    link = vehicle.source.replace("udpin:", "udpout:")
    words = (sys.executable, theirs.parent, link, vehicle.source)
    command = ("unshare", "--net", "sh", "-c", IN_A_NAMESPACE, "sh", *words)
    assert mount.run(*command, cwd=PROJECT).stdout == "theirs\n"


def test_a_mount_counts_only_if_it_is_of_the_vehicle_that_is_wanted() -> None:
    mounted = {"vehicle": {"system": 2, "component": 1}, "connection": {"autopilot": 12}}
    camera = {"vehicle": {"system": 2, "component": 100}, "connection": {"autopilot": 8}}

    def wanted(
        system: int = 0, component: int = 0, of: dict[str, Any] = mounted, state: str = "fine"
    ) -> bool:
        status = {**of, "link": {"state": state}}
        return is_wanted(status, Options(target_system=system, target_component=component))

    assert wanted()
    assert wanted(2, 1)
    assert not wanted(1)
    assert not wanted(of=camera)
    assert wanted(0, 100, camera)
    assert not wanted(state="replaced")  # another unique id answers there


def test_a_growing_log_is_seen_through_a_mount(field: Field, tmp_path: Path) -> None:
    vehicle = field.sim(field.local("card"), "px4", ("--armed", *FAR))
    card, local = vehicle.root / "log", tmp_path / "logs"
    write_log(card / "now.ulg", 100_000, 2, 2)
    field.mount(vehicle.source, "when_armed=ro")
    with subprocess.Popen(["sh", "-c", f"while sleep 0.01; do echo >> {card}/now.ulg; done"]) as growing:
        try:
            _, said = run("sync", vehicle.source, local, code=2)
        finally:
            growing.kill()
    came = readable_size((local / "now.ulg.part").stat().st_size)
    assert f"now.ulg is still growing: only its first {came} are here" in said
    assert local_files(local) == {"now.ulg.part"}


def test_get_shows_what_a_mount_has_of_a_file(field: Field, tmp_path: Path) -> None:
    """The kernel would read in pieces of 128 KiB, and get would know of none of them before it is whole."""
    vehicle = field.sim(field.local("card"), "px4", ("--rate", "10000"))
    write_log(vehicle.root / "log" / "a.ulg", 150_000, 1, 1)
    mount = field.mount(vehicle.source, "op_deadline=3600")
    part = tmp_path / "a.ulg.part"
    with started("get", mount.path, "/log/a.ulg", "--to", f"{tmp_path}/"):
        wait_until("some of it is read", lambda: mount.bytes_read() > 50_000)
        vehicle.pause()
        wait_until("get has what the mount has", lambda: part.stat().st_size >= mount.bytes_read() - 8192)
    vehicle.resume()


# -- by itself ------------------------------------------------------------------------------------


def test_logs_come_home_by_themselves(field: Field, tmp_path: Path) -> None:
    vehicle = field.sim(field.local("card"))
    card = vehicle.root / "APM/LOGS"
    write_log(card / "1.BIN", 50_000, 1, 1)
    handed, local = tmp_path / "handed", tmp_path / "logs"
    words = ("--watch", "--exec", f"sh -c 'basename \"$1\" >> {handed}' sh")
    argv = ["mavftpfs.__main__", "sync", vehicle.source, str(local), *words]
    watch = Program("sync", argv, field.local("sync"))
    field.own(watch)
    wait_until("the first log was handed on", lambda: handed.read_text() == "1.BIN\n")
    field.mount(vehicle.source)
    vehicle.react(signal.SIGUSR1)  # armed
    wait_until("that is noticed", lambda: "vehicle 1 is armed" in watch.text())
    write_log(card / "2.BIN", 60_000, 2, 2)
    vehicle.react(signal.SIGUSR1)
    wait_until("the second, too", lambda: handed.read_text() == "1.BIN\n2.BIN\n")
    assert watch.stop() == 0
    out = watch.text()
    assert out.splitlines()[-1] == "ended; the next run continues"
    assert out.count("is here, verified by size and CRC32") == 2
    assert "a mount has this vehicle now" in out
    (home,) = (path for path in local.iterdir() if path.is_dir())
    assert filecmp.cmpfiles(card, home, ["1.BIN", "2.BIN"], shallow=False) == (["1.BIN", "2.BIN"], [], [])


def test_what_goes_with_watch_only_is_said(tmp_path: Path) -> None:
    assert "--watch" in run("sync", "udpin:127.0.0.1:1", tmp_path, "--exec", "true", code=1)[1]


# -- terminals ------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["sync", "put"])
def test_a_vehicle_that_is_lost_under_a_mount_is_waited_for_on_the_screen(
    field: Field, tmp_path: Path, command: str
) -> None:
    vehicle = field.sim(field.local("card"), "px4", ("--rate", "10000"))
    files = [(vehicle.root / "log" if command == "sync" else tmp_path) / name for name in ("a", "b")]
    for file in files:
        write_log(file, 30_000, 1, 1)
    mount = field.mount(vehicle.source, "op_deadline=3600")
    words = [mount.path, tmp_path / "logs"] if command == "sync" else [mount.path, *files, "/"]
    screen = terminal.mavftpfs(command, *words, columns=100, rows=8)
    screen.read_until(lambda shown: "kB/s" in shown.raw)
    vehicle.react(signal.SIGUSR2)  # the link is cut
    screen.read_until(lambda shown: "waiting for the vehicle" in shown.raw)
    vehicle.react(signal.SIGUSR2)
    assert screen.finish() == 0
    assert "0/2 files" in screen.raw


def test_ls_on_a_terminal_and_in_a_pipe(field: Field) -> None:
    vehicle = field.sim(field.local("card"), "ardupilot5")
    write_log(vehicle.root / "APM" / "LOGS" / "2.BIN", 1_234_567, 1, 5)
    write_log(vehicle.root / "APM" / "LOGS" / "10.BIN", 10, 1, 3)
    screen = terminal.mavftpfs("ls", "-R", vehicle.source, "/APM")
    assert screen.finish() == 0
    assert screen.lines == ["/APM:", "LOGS/", "/APM/LOGS:", "10.BIN", "2.BIN"]
    assert run("ls", "-R", vehicle.source, "/APM")[0] == "/APM:\nLOGS/\n\n/APM/LOGS:\n10.BIN\n2.BIN\n"
    detailed = run("ls", "-lh", vehicle.source, "/APM/LOGS")[0].splitlines()
    assert detailed[1].split()[:2] == ["1.2", "MB"]
    assert [line.split()[-1] for line in detailed] == ["10.BIN", "2.BIN"]


# -- scan -----------------------------------------------------------------------------------------


STATION = (Address(255, 190), MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID)


def test_scan_of_a_camera_and_a_ground_station_ends_in_its_time() -> None:
    """No autopilot is there, and connect_timeout is not waited for where somebody else is heard."""
    port = free_udp_port()
    with Beating(port, (Address(1, 100), 30, MAV_AUTOPILOT_INVALID), STATION):
        out, _ = run("scan", "-o", "connect_timeout=3000", f"udpin:{HOST}:{port}")
    camera, answer, station, reason = (" ".join(line.split()) for line in out.splitlines()[1:])
    assert (camera, station) == ("1/100 camera", "255/190 ground station")
    assert answer.startswith("FTP: no answer")
    assert reason == "FTP: not asked (a ground station)"


def test_scan_beside_a_mount_shows_who_else_is_there(field: Field) -> None:
    vehicle = field.sim(field.local("card"))
    mount = field.mount(vehicle.source)
    port = int(vehicle.source.rpartition(":")[2])
    with Beating(port, STATION):
        wait_until(
            "the mount hears the ground station", lambda: len(mount.status()["connection"]["heard"]) > 1
        )
        for source in (vehicle.source, mount.path):
            _, own, place, station, _ = (
                " ".join(line.split()) for line in run("scan", source)[0].splitlines()
            )
            assert own.startswith("1/1 ")
            assert place == f"FTP: mounted on {mount.path}"
            assert station == "255/190 ground station"


@pytest.mark.parametrize("command", ["scan", "sync", "mount"])
def test_who_waits_for_a_vehicle_is_told_so(command: str, tmp_path: Path) -> None:
    source = f"udpin:{HOST}:{free_udp_port()}"
    local = [] if command == "scan" else [tmp_path]
    said = mavftpfs(command, "-o", "connect_timeout=2", source, *local, code=2)[1]
    *before, first, last = said.splitlines()
    assert before == [f"mavftpfs: scanning {source}, which takes some seconds"] * (command == "scan")
    assert first == f"mavftpfs: waiting for a heartbeat on {source} (2 s)"
    assert last.startswith(f"mavftpfs: no vehicle on {source} within 2 s")
