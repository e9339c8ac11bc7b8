"""Real programs whose writes fail in mid-copy: the card keeps its files, and gets no part of a new one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from contextlib import suppress
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import Mount, abort_mount, command, wait_until
from tests.support.places import FOLDERS
from tests.support.trees import content
from tests.support.vehicles import SimVehicle

OLD, BIG, AGAIN = content("old", 30_000), content("big", 3_000_000), b"again\n"
PROGRAMS = {
    "cp": 'cp "$1" "$2"',
    "rsync": 'rsync "$1" "$2"',
    "dd": 'dd if="$1" of="$2" bs=64k status=none',
    "dsync": 'dd if="$1" of="$2" bs=1M oflag=dsync status=none',
    "new": 'cp "$1" "$2"',
    "pipe": 'cat "$1" > "$2"',
}
"""The effect of each on the file of its name; `new` is not there yet."""


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where this test's mounts leave what is not delivered."""
    path = tmp_path / "state"
    path.mkdir()
    monkeypatch.setenv("XDG_STATE_HOME", str(path))
    return path / "mavftpfs/recovered"


@pytest.fixture
def big(tmp_path: Path) -> Path:
    path = tmp_path / "big"
    path.write_bytes(BIG)
    return path


def place(field: Field, kind: str) -> tuple[Mount, SimVehicle, Path, Path]:
    """Return a mount, its vehicle, and the directory with good files: as programs see it, and on the card."""
    card = field.local("card")
    folder = card / FOLDERS[kind]
    folder.mkdir(parents=True, exist_ok=True)
    for name in PROGRAMS:
        if name != "new":
            (folder / name).write_bytes(OLD)
    vehicle = field.sim(card, kind, ("--rate", "150000"))
    mount = field.mount(vehicle.source, "op_deadline=6")
    return mount, vehicle, mount.path / FOLDERS[kind], folder


def files(folder: Path) -> dict[str, bytes]:
    """Return what is on the card; a file may vanish meanwhile."""
    found = {}
    for name in sorted(os.listdir(folder)):
        with suppress(FileNotFoundError):
            found[name] = (folder / name).read_bytes()
    return found


def shown_files(folder: Path) -> dict[str, bytes]:
    """Return what is on the card under names that programs see."""
    return {name: data for name, data in files(folder).items() if not name.startswith(".mavftpfs-")}


def arrives(folder: Path) -> bool:
    """Return whether a part of a file is on the card."""
    return any(name.startswith(".mavftpfs-") and data for name, data in files(folder).items())


def listed(mount: Mount, folder: Path) -> bool:
    """List a directory: what was left of an attempt to rename is removed then."""
    return mount.run("ls", folder).returncode == 0


GOOD = {name: OLD for name in sorted(PROGRAMS) if name != "new"}


@pytest.mark.holds("promise 3", "promise 9")
@pytest.mark.parametrize("number", [signal.SIGUSR2, signal.SIGUSR1], ids=["cut", "armed"])
@pytest.mark.parametrize("kind", ["px4", "px4-nuttx", "ardupilot"])
def test_a_copy_that_fails_costs_no_good_file(
    field: Field, state: Path, big: Path, kind: str, number: signal.Signals
) -> None:
    mount, vehicle, shown, card = place(field, kind)
    running = {}
    for name, script in PROGRAMS.items():
        argv = ["sh", "-c", script, "sh", str(big), str(shown / name)]
        running[name] = subprocess.Popen(argv, stderr=subprocess.PIPE, text=True)
    wait_until("bytes arrive", lambda: arrives(card))
    vehicle.react(number)
    for name, program in running.items():
        said = program.communicate(timeout=120)[1]
        assert program.returncode != 0, name
        assert "timed out" in said or "Read-only" in said, f"{name}: {said}"
    vehicle.react(number)
    wait_until("nothing of ours is left", lambda: listed(mount, shown) and files(card) == GOOD)
    for name in GOOD:
        assert mount.read_bytes(shown / name) == OLD
    assert not (shown / "new").exists()
    again = big.with_name("again")
    again.write_bytes(AGAIN)
    for name in PROGRAMS:
        mount.run("cp", again, shown / name)
    assert files(card) == dict.fromkeys(sorted(PROGRAMS), AGAIN)
    # What rsync wrote under a name of its own is no part of the file that was written again.
    parts = json.loads(command("status", mount.path, "--json")[0])["held"]["broken"]
    assert all(".rsync." in path for path in parts)
    command("umount", mount.path, code=4 if parts else 0)
    mount.process = None
    assert len(list(state.glob("*/*.json"))) == len(parts)


@pytest.mark.holds("promise 3")
def test_a_copy_that_failed_is_not_put_on_the_card_by_the_mount_after_a_kill(
    field: Field, state: Path, big: Path
) -> None:
    mount, vehicle, shown, card = place(field, "px4")
    with mount.started("cp", big, shown / "cp") as program:
        wait_until("bytes arrive", lambda: arrives(card))
        vehicle.react(signal.SIGUSR2)
        assert program.wait(60) == 1
    vehicle.left_alone = True
    mount.kill()
    abort_mount(mount.path)
    vehicle.react(signal.SIGUSR2)
    again = field.mount(vehicle.source)
    wait_until("the part is found", lambda: any(state.glob("*/*.json")))
    again.run("ls", again.path)
    assert shown_files(card) == GOOD, "the part lies under a temporary name for ten minutes"
    assert "a write failed, so this is only the part that was written before" in command("recover")[0]
    command("recover", vehicle.source, "--all", code=4)
    assert shown_files(card) == GOOD


BROKEN = """
import errno, os, sys
old, new, big = sys.argv[1:4]
part = open(big, "rb").read(300_000)
def error_of(call):
    try:
        call()
    except OSError as error:
        return errno.errorcode[error.errno]
for path in (old, new):
    fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    second = os.open(path, os.O_RDWR)
    assert os.write(fd, part) == len(part)
    assert error_of(lambda: os.pwrite(fd, b"x", 1 << 32)) == "EFBIG"
    if path == old:
        with open(path, "rb") as other:
            there = other.read()
        assert os.stat(path).st_size == len(there) == 30_000, "the name has the file on the card"
    else:
        assert error_of(lambda: open(path, "rb")) == "ENOENT"
    assert os.fstat(fd).st_size == len(part)
    assert os.pread(second, len(part), 0) == part
    if path == old:
        with open(path, "rb") as other:
            assert other.read() == there, "no page of the broken file"
    else:
        with open(path, "xb") as other:
            other.write(b"again")
    for one in (fd, second):
        calls = (lambda: os.write(one, b"x"), lambda: os.ftruncate(one, 0), lambda: os.fsync(one))
        assert [error_of(call) for call in calls] == ["EIO"] * 3
        assert error_of(lambda: os.close(one)) == "EIO"
"""
"""Breaks an old file and a new one; both are opened by name while they are still open."""


@pytest.mark.holds("promise 1", "promise 3")
def test_who_opens_the_name_gets_the_file_on_the_card(field: Field, state: Path, big: Path) -> None:
    mount, _, shown, card = place(field, "px4")
    mount.python(BROKEN, shown / "cp", shown / "new", big)
    wait_until("nothing of ours is left", lambda: files(card) == {**GOOD, "new": b"again"})
    mount.run("rm", shown / "cp")
    assert mount.unmount() == 0
    assert not state.exists()
