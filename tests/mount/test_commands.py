"""The commands that need no mount, each as a user runs it: a process of its own, over a real link."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import NamedTuple

import pytest

from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.sim.tree import MemoryTree
from tests.mount.conftest import Field
from tests.support.mounts import command, mavftpfs, wait_until
from tests.support.replies import nak
from tests.support.trees import differing
from tests.support.vehicles import HOST, Program, SimVehicle, free_udp_port


@pytest.fixture(scope="module")
def vehicle(module_field: Field, small_tree: Path) -> SimVehicle:
    """A vehicle that nobody mounts; one command after the other speaks with it."""
    return module_field.sim(small_tree)


def test_ls(vehicle: SimVehicle, small_tree: Path) -> None:
    out, _ = mavftpfs("ls", vehicle.source, "/")
    assert sorted(out.splitlines()) == sorted(
        path.name + "/" * path.is_dir() for path in small_tree.iterdir()
    )
    out, _ = mavftpfs("ls", vehicle.source, "/sizes", "/sizes/478.bin", "/deep")
    sizes = sorted(path.name for path in (small_tree / "sizes").iterdir())
    deep = sorted(path.name + "/" * path.is_dir() for path in (small_tree / "deep").iterdir())
    assert out.splitlines() == ["/sizes/478.bin", "", "/sizes:", *sizes, "", "/deep:", *deep]
    out, _ = mavftpfs("ls", "-l", vehicle.source, "mftp://comp=1:/sizes")
    detailed = {line.split()[-1]: int(line.split()[0]) for line in out.splitlines()}
    assert detailed == {path.name: path.stat().st_size for path in (small_tree / "sizes").iterdir()}
    out, _ = mavftpfs("ls", "--json", f"{vehicle.source}#/deep", "/")
    kinds = {entry["name"]: entry["kind"] for entry in json.loads(out)}
    assert kinds == {
        path.name: "directory" if path.is_dir() else "file" for path in (small_tree / "deep").iterdir()
    }


@pytest.mark.parametrize(
    ("profile", "told"),
    [
        ("px4", "PX4 quadrotor, disarmed, firmware 1.16.0"),
        ("ardupilot", "ArduPilot quadrotor, disarmed, firmware 4.6.3"),
    ],
)
def test_a_simulated_vehicle_tells_its_own_version(
    field: Field, small_tree: Path, profile: str, told: str
) -> None:
    out, _ = mavftpfs("scan", field.sim(small_tree, profile).source)
    first = out.splitlines()[1]
    assert f"  {told}, id " in first or first.endswith(f"  {told}")


def test_scan_tells_each_vehicle_as_it_comes(two: tuple[SimVehicle, SimVehicle]) -> None:
    source = two[0].source
    out, said = command("scan", source)
    first, *heard = said.splitlines()
    assert first == f"mavftpfs: scanning {source}, which takes some seconds"
    assert sorted(heard) == [f"mavftpfs: heard {n}/1 (PX4 quadrotor, disarmed)" for n in (1, 2)]
    header, *rows = out.splitlines()
    assert header == "SYSTEM/COMPONENT  WHAT, FIRMWARE, UNIQUE ID, FTP"
    assert [row.split()[0] for row in rows] == ["1/1", "FTP:", "2/1", "FTP:"]


@pytest.mark.holds("promise 1")
def test_get_is_verified(vehicle: SimVehicle, small_tree: Path, tmp_path: Path) -> None:
    out, _ = mavftpfs("get", vehicle.source, "/sizes/35850.bin", "/README.txt", "--to", tmp_path)
    assert [line.partition(": ")[2] for line in out.splitlines()] == [
        "35.9 kB, verified by size and CRC32",
        f"{(small_tree / 'README.txt').stat().st_size} B, verified by size and CRC32",
    ]
    assert (tmp_path / "35850.bin").read_bytes() == (small_tree / "sizes/35850.bin").read_bytes()
    for folder in ("deep", "names"):
        mavftpfs("get", "-r", vehicle.source, f"/{folder}", "--to", tmp_path)
        assert differing(small_tree / folder, tmp_path / folder) == []


@pytest.fixture(scope="module")
def two(module_field: Field) -> tuple[SimVehicle, SimVehicle]:
    """Two vehicles that send to one port."""
    port = free_udp_port()
    first, second = (
        module_field.sim(
            module_field.local(f"card{system}"),
            options=("--system", str(system)),
            link=f"udpout:{HOST}:{port}",
        )
        for system in (1, 2)
    )
    for vehicle in (first, second):
        (vehicle.root / "log").mkdir()
        (vehicle.root / "log/a.bin").write_bytes(bytes(120_000))
    return first, second


CHANGES = {
    "rm": "rm -r SOURCE /log",
    "rmdir": "rmdir SOURCE /log",
    "mkdir": "mkdir SOURCE /new",
    "mv": "mv SOURCE /log /new",
    "put": "put SOURCE LOCAL /",
    "param": "param SOURCE RTL_ALT=3",
    "load": "param SOURCE --load LOCAL",
}


@pytest.mark.parametrize("words", CHANGES.values(), ids=CHANGES)
def test_a_change_names_its_vehicle_where_several_are_heard(
    two: tuple[SimVehicle, SimVehicle], words: str, tmp_path: Path
) -> None:
    (tmp_path / "local").write_text("RTL_ALT,3\n")
    source = two[0].source
    places = {"SOURCE": source, "LOCAL": str(tmp_path / "local")}
    _, said = command(*(places.get(word, word) for word in words.split()), code=1)
    assert f"several vehicles are heard on {source}: 1/1 (PX4 quadrotor, disarmed), 2/1 (PX4" in said
    assert "choose one with -o target_system=1 or -o target_system=2\n" in said
    for vehicle in two:
        assert [path.name for path in vehicle.root.rglob("*")] == ["log", "a.bin"]


def test_a_command_says_which_of_several_vehicles_it_reads(
    two: tuple[SimVehicle, SimVehicle], field: Field
) -> None:
    source = two[0].source
    folder = field.local("local")
    slow = ("-o", "bwlimit=60k")  # seconds, in which both send heartbeats
    _, said = command("get", source, "/log/a.bin", "--to", folder, *slow)
    assert said.count("was heard first on") == 1
    assert any(
        f"this is vehicle {one}, which was heard first on {source}; also heard: {other}/1 (PX4" in said
        and f"; to choose one, use -o target_system={other}\n" in said
        for one, other in ((1, 2), (2, 1))
    )
    assert command("ls", source, "/log", "-o", "target_system=2") == ("a.bin\n", "")


def test_a_mount_of_one_of_several_vehicles_is_no_choice(
    two: tuple[SimVehicle, SimVehicle], field: Field
) -> None:
    source = two[0].source
    mount = field.mount(source, "target_system=2")
    wait_until("both are heard", lambda: len(mount.status()["connection"]["heard"]) == 2)
    assert "several vehicles are heard" in command("mkdir", source, "/new", code=1)[1]
    assert "this is vehicle 2" in command("ls", source)[1]
    command("mkdir", mount.path, "/new")
    command("rmdir", source, "/new", "-o", "target_system=2")


# -- why nothing is changed -----------------------------------------------------------------------

READ_ONLY = 30
"""The errno."""


def refusing(request: Payload) -> list[Payload] | None:
    """Refuse what changes the card, as a vehicle does whose card is write-protected."""
    if request.opcode in (Opcode.CREATE_FILE, Opcode.REMOVE_FILE, Opcode.CREATE_DIRECTORY, Opcode.RENAME):
        return [nak(request, NakCode.FAIL_ERRNO, READ_ONLY)]
    return None


REASONS = {
    "ro": ("/d/f", r"because the option ro was given\n"),
    "armed": ("/d/f", r"the vehicle is armed: nothing is written in flight \(when_armed=ro\)\n"),
    "card": ("/d/f", r"it is read-only \(opcode \d+, NAK 2"),
    "virtual": ("/@SYS/uarts.txt", r"the vehicle's @ directories are read-only\n"),
}


@pytest.mark.parametrize("mounted", [False, True], ids=["link", "mount"])
@pytest.mark.parametrize("reason", REASONS)
def test_a_refused_change_has_one_reason(reason: str, mounted: bool, field: Field, tmp_path: Path) -> None:
    if reason == "card":
        tree = MemoryTree()
        tree.add(b"/d/f", b"old")
        lying = field.lying(tree)
        lying.server.answer = refusing
        source = lying.source
    else:
        root = field.local("card")
        (root / "d").mkdir()
        (root / "d/f").write_text("old")
        source = field.sim(root, "ardupilot5", ("--armed",) if reason == "armed" else ()).source
    option = ("ro",) * (reason == "ro")
    place = field.mount(source, *option).path if mounted else source
    more = [f"-o{word}" for word in option if not mounted]
    local = tmp_path / "local"
    local.write_text("new")
    path, expected = REASONS[reason]
    put_code = 1 if more else 4  # with the command's own option nothing is begun
    for words in (
        ["put", place, local, path],
        ["rm", place, path],
        ["mkdir", place, f"{path}2"],
        ["mv", place, path, f"{path}2"],
    ):
        _, said = command(*words, *more, code=put_code if words[0] == "put" else 2 if reason == "card" else 1)
        assert len(re.findall(expected, said)) == 1, said
        assert len(re.findall("is armed|option ro|read-only|below @", said)) == 1, said


# -- patterns, and files inside a mount -----------------------------------------------------------


class Place(NamedTuple):
    """A card, and SOURCE for it."""

    card: Path
    source: str

    def names(self) -> list[str]:
        """Return what is in the card's directory of logs."""
        return sorted(path.name for path in (self.card / "log").iterdir())


@pytest.fixture(params=["link", "mount"])
def place(request: pytest.FixtureRequest, field: Field) -> Place:
    """A vehicle of its own for each test, on its link or mounted."""
    root = field.local("card")
    (root / "log/old").mkdir(parents=True)
    for name in ("1.ulg", "2.ulg", "[1].ulg", "b.txt", ".hidden.ulg"):
        (root / "log" / name).write_text(name)
    source = field.sim(root).source
    return Place(root, str(field.mount(source).path) if request.param == "mount" else source)


def test_patterns(place: Place) -> None:
    source = place.source
    logs = ["/log/1.ulg", "/log/2.ulg", "/log/[1].ulg"]
    assert command("ls", source, "/log/*.ulg")[0].splitlines() == logs
    assert command("ls", source, "/l*/o*", "/l*/b*")[0].splitlines() == ["/log/b.txt", "", "/log/old:"]
    assert command("cat", source, "/log/[12].ulg") == ("1.ulg2.ulg", "")
    assert command("cat", source, "/log/[1].ulg") == ("[1].ulg", "")
    sums = command("crc", source, "/log/?.ulg")[0].splitlines()
    assert [line.split("  ")[1] for line in sums] == ["/log/1.ulg", "/log/2.ulg"]
    for verb in ("ls", "crc", "cat", "rm"):
        said = command(verb, source, "/log/b*", "/log/*.zip", code=1)[1]
        assert said == "mavftpfs: nothing matches /log/*.zip\n"
    assert "b.txt" in place.names()


def test_directories_that_a_pattern_matches_are_left_out(place: Place, tmp_path: Path) -> None:
    note = "mavftpfs: /log/old is a directory, and was left out\n"
    out, said = command("crc", place.source, "/log/[bo]*")
    assert ([line.split()[1] for line in out.splitlines()], said) == (["/log/b.txt"], note)
    assert command("cat", place.source, "/log/[bo]*") == ("b.txt", note)
    assert command("get", place.source, "/log/[bo]*", "--to", f"{tmp_path}/got/")[1] == note
    assert [path.name for path in (tmp_path / "got").iterdir()] == ["b.txt"]
    for verb in ("crc", "cat", "get"):
        said = command(verb, place.source, "/log/o*", code=1)[1]
        assert said == "mavftpfs: /log/o* matches only directories\n"


def test_rm_takes_patterns(place: Place) -> None:
    assert "/log/old is a directory" in command("rm", place.source, "/log/*", code=1)[1]
    assert len(place.names()) == 6
    command("rm", place.source, "/log/[1].ulg")
    assert "1.ulg" in place.names()
    assert "[1].ulg" not in place.names()
    command("rm", place.source, "/log/[12].ulg", "/log/1*")
    assert place.names() == [".hidden.ulg", "b.txt", "old"]


def test_a_pattern_removes_nothing_where_it_matches_what_the_vehicle_makes_itself(field: Field) -> None:
    root = field.local("card")
    (root / "z").write_text("")
    source = field.sim(root, "ardupilot5").source
    assert "are read-only" in command("rm", "-r", source, "/*", code=1)[1]
    assert list(root.iterdir()) == [root / "z"]


def test_a_file_inside_a_mount_is_a_source(
    field: Field, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = field.local("card")
    (root / "log").mkdir()
    for name in ("a.txt", "b.txt"):
        (root / "log" / name).write_text(name)
    mount = field.mount(field.sim(root).source).path
    first, second = mount / "log/a.txt", mount / "log/b.txt"
    assert command("cat", first) == ("a.txt", "")
    assert command("cat", first, second) == ("a.txtb.txt", "")
    assert command("cat", mount / "log", "/a.txt") == ("a.txt", "")
    assert command("ls", first, second)[0] == "/log/a.txt\n/log/b.txt\n"
    assert command("ls", mount / "log")[0] == "a.txt\nb.txt\n"
    assert [line.split()[1] for line in command("crc", first, second)[0].splitlines()] == [
        "/log/a.txt",
        "/log/b.txt",
    ]
    assert "verified by size and CRC32" in command("get", second, "--to", tmp_path)[0]
    assert (tmp_path / "b.txt").read_text() == "b.txt"
    command("get", "-r", mount / "log", "--to", f"{tmp_path}/new/")
    assert (tmp_path / "new/log/a.txt").read_text() == "a.txt"
    assert command("cat", mount / "log", code=1)[1] == "mavftpfs: /log is a directory\n"
    assert "PATH is missing" in command("cat", mount, code=1)[1]
    assert f"and {tmp_path} is not in that mount" in command("crc", first, tmp_path, code=1)[1]
    monkeypatch.chdir(mount / "log")
    try:
        assert command("cat", "b.txt") == ("b.txt", "")
        for inside in (".", "b.txt"):
            assert command("status", inside)[0].startswith(f"{mount}: PX4 1/1")
    finally:
        monkeypatch.undo()


def test_status_names_the_file_that_put_sends(field: Field, tmp_path: Path) -> None:
    root = field.local("card")
    (root / "log").mkdir()
    mount = field.mount(field.sim(root).source, "bwlimit=30k").path
    (tmp_path / "new.lua").write_bytes(bytes(60_000))
    put = Program(
        "put", ["mavftpfs.__main__", "put", str(mount), str(tmp_path / "new.lua"), "/log/"], tmp_path
    )
    try:
        wait_until("status tells of it", lambda: "/log/new.lua: " in command("status", mount)[0])
        assert put.wait() == 0
    finally:
        put.kill()
    assert "/log/new.lua: 60.0 kB, verified by size and CRC32" in put.text()
    assert os.listdir(root / "log") == ["new.lua"]
