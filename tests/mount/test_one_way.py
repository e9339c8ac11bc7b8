"""Commands and library speak to a mount's process: the same words as without a mount, and the kernel hears of
it."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

import mavftpfs as library
from mavftpfs.cli import main
from mavftpfs.shared.errors import ExitCode
from tests.mount.conftest import Field
from tests.support.mounts import Mount, command, wait_until
from tests.support.trees import content
from tests.support.vehicles import PROJECT

AS_NOBODY = (sys.executable, str(PROJECT / "tests/support/programs/as_nobody.py"))
OLD, NEW = content("old", 60_000), content("new", 60_000)


# -- the same words ---------------------------------------------------------------------------------


def fill(card: Path) -> Path:
    """Make something of everything."""
    for name in ("d/e", "log/2026-01-02", "log/2026-01-03", "empty"):
        (card / name).mkdir(parents=True)
    for number, name in enumerate(("d/a", "d/e/b", "log/2026-01-02/x.ulg", "log/2026-01-03/y.ulg", "f")):
        (card / name).write_bytes(content(name, 1 + 20_000 * number))
    for path in (*card.rglob("*"), card):
        os.utime(path, (1_700_000_000, 1_700_000_000))
    return card


SCRIPT: list[list[str]] = [
    *(
        ["ls", "SRC"],
        ["ls", "-l", "SRC", "/d", "/f"],
        ["ls", "-R", "SRC", "/"],
        ["ls", "--json", "SRC", "/d"],
    ),
    *(
        ["ls", "SRC", "/d/*"],
        ["ls", "SRC", "/nothing"],
        ["ls", "SRC", "/f/x"],
        ["ls", "SRC#/d"],
        ["ls", "SRC#/f"],
        ["ls", "SRC#/nothing"],
    ),
    *(
        ["cat", "SRC", "/d/a"],
        ["cat", "SRC", "/d"],
        ["cat", "SRC", "/no*"],
        ["cat", "SRC", "/d/a", "/nothing"],
    ),
    *(["crc", "SRC", "/d/a", "/f"], ["crc", "SRC", "/d"], ["crc", "SRC", "/nothing"], ["crc", "SRC", "/d/*"]),
    *(["get", "SRC", "/f", "--to", "OUT/f"], ["get", "SRC", "/f", "--to", "OUT/f"], ["get", "SRC", "/d"]),
    *(
        ["get", "-r", "SRC", "/d", "--to", "OUT/"],
        ["get", "SRC", "/nothing"],
        ["get", "SRC", "/log/*/*.ulg", "--to", "OUT/l"],
    ),
    *(["sync", "SRC", "OUT/logs"], ["sync", "SRC", "OUT/logs"], ["sync", "--check", "SRC", "OUT/logs"]),
    *(["sync", "SRC", "OUT/more", "--from", "/d", "--dry-run"], ["sync", "SRC", "OUT/more", "--from", "/f"]),
    *(["put", "SRC", "IN/big", "/p"], ["put", "SRC", "IN/empty", "/p0"], ["put", "SRC", "IN/big", "/d"]),
    *(["put", "SRC", "IN/big", "/p"], ["put", "SRC", "IN/big", "/none/p"], ["put", "SRC", "IN/big", "/f/"]),
    *(["put", "-r", "SRC", "IN", "/in"], ["put", "-r", "SRC", "IN", "/in"], ["put", "SRC", "IN", "/in"]),
    *(
        ["put", "SRC", "IN/big", "/.x.swp"],
        ["cat", "SRC", "/.x.swp"],
        ["mkdir", "SRC", "/.Trash-0"],
        ["mv", "SRC", "/.x.swp", "/.Trash-0/"],
        ["rm", "-r", "SRC", "/.Trash-0"],
    ),
    *(["put", "SRC", "IN/big", "/@SYS/x"], ["ls", "-l", "SRC", "/"], ["ls", "-l", "SRC", "/in"]),
    *(
        ["mkdir", "SRC", "/m"],
        ["mkdir", "SRC", "/m"],
        ["mkdir", "SRC", "/a/b/c"],
        ["mkdir", "-p", "SRC", "/a/b/c"],
    ),
    *(
        ["mv", "SRC", "/p", "/q"],
        ["mv", "SRC", "/nothing", "/r"],
        ["mv", "SRC", "/q", "/a/b/"],
        ["mv", "SRC", "/a", "/a/b/c"],
    ),
    *(
        ["mv", "SRC", "/a/b/q", "/f"],
        ["mv", "SRC", "/f", "/d"],
        ["mv", "SRC", "/d", "/f"],
        ["mv", "SRC", "/", "/x"],
    ),
    *(["rmdir", "SRC", "/m"], ["rmdir", "SRC", "/a"], ["rmdir", "SRC", "/nothing"], ["rmdir", "SRC", "/p0"]),
    *(
        ["rm", "SRC", "/p0"],
        ["rm", "SRC", "/p0"],
        ["rm", "SRC", "/a"],
        ["rm", "-r", "SRC", "/a"],
        ["rm", "SRC", "/"],
    ),
    *(
        ["rm", "SRC", "/in/*"],
        ["rm", "-r", "SRC", "/in"],
        ["ls", "-l", "SRC", "/"],
        ["recover", "SRC", "none"],
    ),
    *(["ls", "SRC", "-o", "target_system=9,connect_timeout=1"], ["rm", "-o", "ro", "SRC", "/f"]),
    *(
        ["param", "SRC", "NAV*"],
        ["param", "SRC", "RTL_ALT=x"],
        ["param", "SRC", "RTL_ALT"],
        ["param", "SRC", "RTL_ALT=1600"],
    ),
]
"""SRC: the vehicle. OUT, IN: local directories."""


def said(words: Sequence[str], places: dict[str, str]) -> tuple[int, str, str]:
    """Run a command in this process. Return its exit code and what it said, with the names of the places, and
    without times: a mount does not list a directory again to learn the time of what was made by it."""
    filled = [re.sub("SRC|OUT|IN(?=/|$)", lambda match: places[match[0]], word) for word in words]
    streams = [io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2)]
    with contextlib.chdir(places["OUT"]), redirect_stdout(streams[0]), redirect_stderr(streams[1]):
        code = main.main(filled)
    texts = [stream.buffer.getvalue().decode(errors="replace") for stream in streams]
    texts[1] = re.sub("mavftpfs: waiting for a heartbeat on .*\n", "", texts[1])
    texts = [re.sub(r"(?m)^( *\d+) (\S+ \d\d:\d\d|-) +", r"\1 ", text) for text in texts]
    for name in ("SRC", "OUT", "IN"):
        texts = [text.replace(places[name], name) for text in texts]
    return code, texts[0], texts[1]


SLOW = pytest.mark.soak  # 75 to 95 s each: these tests wait, and a file's tests run one after the other


@pytest.mark.parametrize(
    "profile", ["px4", pytest.param("ardupilot5", marks=SLOW), pytest.param("mavsdk", marks=SLOW)]
)
def test_every_command_says_the_same_with_and_without_a_mount(field: Field, profile: str) -> None:
    given = field.local("given")
    (given / "big").write_bytes(NEW)
    (given / "empty").touch()
    cards, places, mounts = [], [], []
    for mounted in (False, True):
        card = fill(field.local("card"))
        source = field.sim(card, profile).source
        if mounted:
            mounts.append(field.mount(source))
        out = field.local("out")
        cards.append(card)
        places.append({"SRC": source, "OUT": str(out), "IN": str(given)})
    differ = []
    for words in SCRIPT:
        here, there = (said(words, each) for each in places)
        differ += [] if here == there else [(words, here, there)]
    assert differ == [], "\n".join(map(repr, differ))
    trees = [
        {path.relative_to(card): path.is_dir() or path.read_bytes() for path in card.rglob("*")}
        for card in (*cards, *(Path(each["OUT"]) for each in places))
    ]
    assert trees[0] == trees[1]
    assert trees[2] == trees[3]
    kernel = mounts[0].status()["kernel"]
    assert (kernel["inodes"], kernel["open_files"]) == (1, 0)  # no command went through it


ON_A_BAD_LINK: list[list[str]] = [
    *(["ls", "-R", "SRC", "/"], ["cat", "SRC", "/d/a"], ["crc", "SRC", "/f", "/nothing"]),
    *(
        ["get", "-r", "SRC", "/d", "--to", "OUT/"],
        ["sync", "SRC", "OUT/logs"],
        ["put", "SRC", "IN/big", "/p"],
    ),
    *(["mkdir", "SRC", "/m"], ["mv", "SRC", "/p", "/m/"], ["rm", "-r", "SRC", "/m"], ["ls", "SRC", "/m"]),
]


@pytest.mark.parametrize(
    "profile", [pytest.param("px4", marks=SLOW), pytest.param("ardupilot5", marks=SLOW), "mavsdk"]
)
def test_nor_does_a_bad_link_make_a_difference(field: Field, profile: str) -> None:
    given = field.local("given")
    (given / "big").write_bytes(NEW)
    bad, outcomes = ("--loss", "0.03", "--dup", "0.02", "--delay", "0.01"), []
    for mounted in (False, True):
        source = field.sim(fill(field.local("card")), profile, bad).source
        if mounted:
            field.mount(source)
        places = {"SRC": source, "OUT": str(field.local("out")), "IN": str(given)}
        outcomes.append([said(words, places) for words in ON_A_BAD_LINK])
    assert outcomes[0] == outcomes[1]


@pytest.mark.parametrize("words", [["get", "SRC", "/large", "--to", "OUT/x"], ["put", "SRC", "IN/big", "/f"]])
def test_nor_does_a_vehicle_that_is_switched_off_in_the_middle(field: Field, words: list[str]) -> None:
    given, outcomes = field.local("given"), []
    (given / "big").write_bytes(content("large", 1_000_000))
    for mounted in (False, True):
        card = fill(field.local("card"))
        (card / "large").write_bytes(content("large", 1_000_000))
        vehicle = field.sim(card, options=("--rate", "50000"))
        vehicle.left_alone = True
        options = "op_deadline=2,connect_timeout=3"
        if mounted:
            mount = field.mount(vehicle.source, *options.split(","))
            mount.allowed_log = ("is lost",)
        places = {"SRC": vehicle.source, "OUT": str(field.local("out")), "IN": str(given)}
        off = threading.Timer(3.0, vehicle.pause)
        off.start()
        outcomes.append(said([*words, "-o", options], places))
        off.join()
        vehicle.resume()
        if mounted:
            wait_until("nothing is held", lambda: mount.status()["held"]["files"] == 0)  # noqa: B023
        assert (card / "f").read_bytes() == content("f", 80_001)
    shown = [(code, out, re.sub(r"[0-9.]+ (k|M)?B", "SIZE", err)) for code, out, err in outcomes]
    assert shown[0] == shown[1]
    assert shown[0][0] != 0
    assert len(shown[0][2].splitlines()) == 1


# -- seen at once by programs on the mount, and the reverse -------------------------------------------


@pytest.fixture
def card(field: Field) -> Path:
    card = field.local("card")
    (card / "f").write_bytes(OLD)
    (card / "d").mkdir()
    return card


@pytest.fixture
def mount(field: Field, card: Path) -> Mount:
    return field.mount(field.sim(card).source, "dir_timeout=60")


def test_what_a_command_changes_is_seen_at_once(mount: Mount, field: Field) -> None:
    local = field.local("local") / "x"
    local.write_bytes(NEW)
    place = mount.path
    look = "import os, sys\nfor name in sys.argv[1:]: print(name in os.listdir('.'), os.path.exists(name))"

    def seen(*names: str) -> list[str]:
        return mount.run(sys.executable, "-c", look, *names, cwd=place).stdout.splitlines()

    assert seen("new", "made", "f") == ["False False", "False False", "True True"]
    command("put", place, local, "/new")
    command("mkdir", place, "/made")
    assert seen("new", "made") == ["True True"] * 2
    assert mount.read_bytes(place / "new") == NEW
    command("mv", place, "/new", "/moved")
    assert seen("new", "moved") == ["False False", "True True"]
    command("rm", place, "/moved")
    command("rmdir", place, "/made")
    assert seen("moved", "made") == ["False False"] * 2
    assert mount.read_bytes(place / "f") == OLD
    command("put", place, local, "/f")
    assert mount.read_bytes(place / "f") == NEW
    with library.connect(str(place)) as drone:
        assert mount.run("stat", "-c", "%s", place / "f").stdout == f"{len(NEW)}\n"
        drone.truncate("/f", 5)
        assert mount.run("stat", "-c", "%s", place / "f").stdout == "5\n"
        assert mount.read_bytes(place / "f") == NEW[:5]


def test_what_a_program_writes_by_the_library_is_seen_while_it_writes(mount: Mount) -> None:
    fresh, known = mount.path / "fresh", mount.path / "f"
    look = "import os, sys; print(os.path.exists(sys.argv[1]))"
    assert mount.run(sys.executable, "-c", look, fresh).stdout == "False\n"
    assert mount.read_bytes(known) == OLD
    with library.connect(str(mount.path)) as drone:
        with drone.open("/fresh", "xb") as file:
            assert mount.run(sys.executable, "-c", look, fresh).stdout == "True\n"
            file.write(NEW)
        with drone.open("/f", "r+b", buffering=0) as file:
            file.write(NEW[:5])
            wait_until("it is seen", lambda: mount.read_bytes(known) == NEW[:5] + OLD[5:])


@pytest.mark.holds("promise 1")
def test_a_program_never_gets_pages_of_a_file_that_a_command_found_replaced(field: Field) -> None:
    """To the mount it looks as if the kernel had read the new file: a command opened it."""
    card = field.local("card")
    (card / "f").write_bytes(OLD)
    mount = field.mount(field.sim(card, "px4-2026").source, "dir_timeout=0")
    assert mount.read_bytes(mount.path / "f") == OLD
    (card / "f").write_bytes(NEW)
    os.utime(card / "f", (1_800_000_000, 1_800_000_000))
    with library.connect(str(mount.path)) as drone:
        assert drone.read_bytes("/f") == NEW
        assert mount.read_bytes(mount.path / "f") == NEW


def test_an_open_editor_sees_that_its_file_changed(mount: Mount, field: Field) -> None:
    """vim compares the time and size that it knows before it writes; both programs go on with their file."""
    watch = (
        "import os, sys, time\n"
        "fd = os.open(sys.argv[1], os.O_RDONLY); known = os.fstat(fd); print(known.st_size, flush=True)\n"
        "for line in sys.stdin:\n"
        "    now = os.stat(sys.argv[1])\n"
        "    print(now.st_size, os.pread(os.open(sys.argv[1], os.O_RDONLY), 3, 0).hex(), flush=True)\n"
    )
    argv = [sys.executable, "-c", watch, str(mount.path / "f")]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as editor:
        assert editor.stdin is not None
        assert editor.stdout is not None
        assert editor.stdout.readline() == f"{len(OLD)}\n"
        with library.connect(str(mount.path)) as drone:
            for data in (NEW[:100], NEW, OLD[:7]):
                drone.write_bytes("/f", data)
                print(file=editor.stdin, flush=True)
                assert editor.stdout.readline() == f"{len(data)} {data[:3].hex()}\n"
        editor.stdin.close()


def test_what_a_program_on_the_mount_changes_is_seen_by_commands(mount: Mount) -> None:
    place = mount.path
    assert command("ls", place, "/")[0].split() == ["d/", "f"]
    mount.run("sh", "-c", 'printf "%s" hello > g; mv f d/f; mkdir e', cwd=place)
    assert command("ls", place, "/")[0].split() == ["d/", "e/", "g"]
    assert command("cat", place, "/g")[0] == "hello"
    with library.connect(str(place)) as drone, drone.open("/g") as file:
        assert file.read(2) == "he"
        mount.run("sh", "-c", 'printf "%s" later > g', cwd=place)
        assert drone.read_text("/g") == "later"


# -- clients that end anyhow --------------------------------------------------------------------------


@pytest.mark.holds("promise 1", "promise 3")
def test_of_a_put_that_is_killed_nothing_is_placed(field: Field) -> None:
    card, local = field.local("card"), field.local("local") / "x"
    (card / "f").write_bytes(OLD)
    local.write_bytes(content("large", 2_000_000))
    mount = field.mount(field.sim(card, options=("--rate", "50000")).source)
    for path in ("/f", "/fresh"):
        put = subprocess.Popen(
            [sys.executable, "-m", "mavftpfs", "put", str(mount.path), str(local), path], cwd=PROJECT
        )
        try:
            wait_until("it is being sent", lambda: any(one["done"] for one in mount.status()["transfers"]))
            assert (
                f"in use by process {put.pid}" in command("umount", mount.path, code=ExitCode.MOUNT_FAILED)[1]
            )
        finally:
            put.kill()
            put.wait()
        wait_until("nothing is held", lambda: mount.status()["held"]["files"] == 0)
        assert mount.status()["transfers"] == []
        assert mount.read_bytes(mount.path / "f") == OLD
    command("umount", mount.path)
    mount.process = None
    assert {path.name: path.read_bytes() for path in card.iterdir()} == {"f": OLD}


@pytest.mark.holds("promise 3")
@pytest.mark.parametrize("end", ["signal", "lazy"])
def test_a_mount_that_ends_takes_back_what_a_program_did_not_finish(
    mount: Mount, card: Path, end: str
) -> None:
    with library.connect(str(mount.path)) as drone:
        file = drone.open("/f", "wb", buffering=0)
        file.write(b"half")
        assert mount.read_bytes(mount.path / "f") == b"half"
        if end == "signal":
            assert mount.end_by(signal.SIGTERM) == 0
        else:
            command("umount", "-l", mount.path)
        with pytest.raises(library.NotDelivered, match="is gone"):
            file.close()
        for _ in range(2):  # and no file is missing
            with pytest.raises(ConnectionAbortedError, match="is gone"):
                drone.listdir()
    mount.process = None
    assert (card / "f").read_bytes() == OLD


# -- who may, and by which way ------------------------------------------------------------------------


def by_nobody(mount: Mount, *words: str | Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    return mount.run(*AS_NOBODY, *words, cwd=Path("/"), code=code)


@pytest.mark.needs("root")
@pytest.mark.parametrize("options", [("allow_other", "uid=65534"), ("uid=65534",)])
def test_a_mount_of_root_serves_the_user_of_uid(open_field: Field, options: tuple[str, ...]) -> None:
    """As one of fstab. Without allow_other the kernel refuses that user, and the socket does not."""
    card, local = open_field.local("card"), open_field.local("local") / "x"
    (card / "f").write_bytes(OLD)
    local.write_bytes(NEW)
    for path in (local.parent, local):
        path.chmod(0o755)
    mount = open_field.mount(open_field.sim(card).source, *options)
    assert "f\n" in by_nobody(mount, "ls", mount.path).stdout
    by_nobody(mount, "put", mount.path, local, "/x")
    assert (card / "x").read_bytes() == NEW
    assert "PX4 1/1" in by_nobody(mount, "status", mount.path).stdout
    refused = by_nobody(mount, "umount", mount.path, code=ExitCode.MOUNT_FAILED).stderr
    assert "only uid 0 or root may" in refused
    assert len(refused.splitlines()) == 1


@contextmanager
def bound(source: Path, place: Path) -> Iterator[None]:
    """Show a directory at another place, too."""
    subprocess.run(["mount", "--bind", str(source), str(place)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(place)], check=True)


@pytest.mark.needs("root")
def test_a_mount_is_reached_through_bind_mounts(mount: Mount, field: Field, card: Path) -> None:
    (card / "d" / "inside").write_bytes(OLD)
    whole, part = field.local("whole"), field.local("part")
    with bound(mount.path, whole), bound(mount.path / "d", part):
        assert command("ls", whole)[0].split() == ["d/", "f"]
        assert command("ls", part)[0].split() == ["inside"]
        assert command("crc", whole, "/d/inside")[0][:8] == command("crc", part, "/inside")[0][:8]
        command("mv", part, "/inside", "/moved")
        assert command("ls", f"{whole}/d")[0].split() == ["moved"]
        shown = command("status")[0]
        assert shown.count(f"{mount.path}: PX4 1/1") == 1
        assert str(whole) not in shown
        assert "PX4 1/1" in command("status", whole)[0]


def test_the_attribute_names_the_socket_and_little_more(mount: Mount) -> None:
    told = json.loads(os.getxattr(mount.path, "user.mavftpfs.status"))
    assert Path(told["socket"]).is_socket()
    assert told["vehicle"] == {"system": 1, "component": 1}
    assert set(told) == {
        *("mountpoint", "source", "version", "protocol", "id", "socket", "network_namespace", "vehicle")
    }


def test_a_mount_of_another_version_is_named_in_a_line_and_asked_and_ended(
    field: Field, card: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mount = field.mount(field.sim(card).source)
    monkeypatch.setattr("mavftpfs.client.wire.VERSION", 2)
    for source in (str(mount.path), mount.source):
        for words in (["ls", source], ["put", source, __file__, "/x"]):
            line = command(*words, code=ExitCode.NO_VEHICLE)[1]
            assert re.fullmatch(
                f"mavftpfs: the mount on {mount.path} is of mavftpfs .*, this program of .*; "
                f"unmount it, and mount it again: mavftpfs umount {mount.path}\n",
                line,
            )
    assert "PX4 1/1" in command("status", mount.path)[0]
    command("umount", mount.path)
    mount.process = None


def test_a_mount_of_0_2_is_named_in_a_line(field: Field, card: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its status lacks facts; its link is in use, which without this line looks like a ground station's."""
    mount, other = field.mount(field.sim(card).source), field.local("other")
    monkeypatch.setattr("mavftpfs.client.mounts._OF_ONE_VEHICLE", frozenset(("of a later version",)))
    for words in (
        ["ls", str(mount.path)],
        ["ls", mount.source],
        ["scan", mount.source],
        ["-f", mount.source],
    ):
        with redirect_stderr(io.StringIO()) as line:
            assert main.main([*words, *([str(other)] if words[0] == "-f" else [])]) == ExitCode.NO_VEHICLE
        assert re.fullmatch(
            f"mavftpfs: the mount on {mount.path}: its program is of version .*, this one of .*: "
            "unmount it, and mount it again",
            line.getvalue().splitlines()[-1],
        )
