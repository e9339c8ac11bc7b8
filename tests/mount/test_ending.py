"""Ways in which a mount, a reader or a vehicle ends, and what must be left: nothing, and no session open."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import Mount, mounted_at, wait_until
from tests.support.trees import content
from tests.support.vehicles import HOST, free_udp_port

BIG = 300 << 20
"""Bytes of a sparse file that no server sends within a test."""
SILENCE = 60.0
"""Seconds within which everything that waits for a dead vehicle must have ended."""
QUICK = ("op_deadline=6",)

READ_ALL = """
import os, sys
with open(sys.argv[1], "rb", buffering=0) as file:
    if sys.argv[2] == "4096":
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_RANDOM)
    file.read(4096)
    print("started", flush=True)
    while file.read(int(sys.argv[2])):
        pass
print("whole")
"""
"""A reader that says when its first bytes have come. By single pages it wants none ahead."""


@pytest.fixture
def big_tree(tmp_path: Path) -> Path:
    """A file that takes long, and some that do not."""
    root = tmp_path / "card"
    root.mkdir()
    with (root / "big.bin").open("wb") as file:
        file.truncate(BIG)
    for number in range(5):
        (root / f"dir{number}").mkdir()
        (root / f"dir{number}" / "small.txt").write_text(f"small {number}\n")
    return root


def start_reading(mount: Mount, size: int = 1 << 16) -> subprocess.Popen[str]:
    """Start reading big.bin, `size` bytes at a time; return once the first have come."""
    argv = [sys.executable, "-c", READ_ALL, str(mount.path / "big.bin"), str(size)]
    reader = subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert reader.stdout is not None
    assert reader.stdout.readline() == "started\n"
    return reader


def end_of(reader: subprocess.Popen[str], mount: Mount) -> tuple[int, str]:
    """Wait for a reader and return (exit code, last line of its complaint)."""
    try:
        _, errors = reader.communicate(timeout=SILENCE)
    except subprocess.TimeoutExpired:
        log = mount.process.text() if mount.process else ""
        raise AssertionError(f"the reader hung for {SILENCE} s\n{log}") from None
    return reader.returncode, errors.splitlines()[-1] if errors else ""


@pytest.mark.holds("fault cancel")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_a_file_is_read_ends_both(
    field: Field, big_tree: Path, number: signal.Signals
) -> None:
    mount = field.mount(field.sim(big_tree).source)
    reader = start_reading(mount)
    assert mount.end_by(number) == 0
    code, _ = end_of(reader, mount)
    assert code != 0, "a file that was cut short must not look complete"
    wait_until("the mount is gone", lambda: not mounted_at(mount.path))


@pytest.mark.holds("promise 4", "fault silence")
def test_a_killed_vehicle_is_an_error_in_time_and_comes_back(field: Field, big_tree: Path) -> None:
    vehicle = field.mavsdk(big_tree)
    mount = field.mount(vehicle.source, *QUICK)
    assert mount.run("cat", mount.path / "dir0/small.txt").stdout == "small 0\n"
    reader = start_reading(mount)
    vehicle.kill()
    code, complaint = end_of(reader, mount)
    assert code != 0
    assert "Input/output error" in complaint or "timed out" in complaint, complaint
    mount.run("df", mount.path)
    assert mount.run("cat", mount.path / "dir0/small.txt", code=None, timeout=SILENCE).stdout in (
        "small 0\n",
        "",
    )
    for directory in ("dir1", "dir2", "dir3"):
        mount.run("ls", mount.path / directory, code=None, timeout=SILENCE)
    vehicle.start()
    wait_until("files are readable again", lambda: readable(mount, "dir4/small.txt", "small 4\n"), SILENCE)
    fresh = start_reading(mount)
    fresh.kill()
    fresh.communicate(timeout=SILENCE)


def readable(mount: Mount, name: str, content: str) -> bool:
    """Return whether a file has the content; errors are a no."""
    return mount.run("cat", mount.path / name, code=None, timeout=SILENCE).stdout == content


@pytest.mark.holds("promise 4")
def test_ctrl_c_of_a_blocked_cat_returns(field: Field, big_tree: Path) -> None:
    vehicle = field.sim(big_tree)
    mount = field.mount(vehicle.source, *QUICK)
    reader = start_reading(mount)
    vehicle.pause()
    time.sleep(0.3)
    reader.send_signal(signal.SIGINT)
    code, _ = end_of(reader, mount)
    assert code != 0
    mount.run("df", mount.path)
    vehicle.resume()
    wait_until("files are readable again", lambda: readable(mount, "dir2/small.txt", "small 2\n"), SILENCE)


@pytest.mark.holds("promise 4")
def test_unmounting_from_a_dead_vehicle_waits_for_no_read(field: Field, big_tree: Path) -> None:
    """The kernel waits for a page longer than the killed program that wanted it."""
    vehicle = field.sim(big_tree)
    mount = field.mount(vehicle.source, "op_deadline=3600")
    reader = start_reading(mount, 4096)
    vehicle.pause()
    wait_until("the vehicle is lost", lambda: mount.status()["link"]["state"] == "lost")
    reader.kill()
    reader.communicate()
    assert mount.unmount() == 0
    vehicle.resume()


@pytest.mark.needs("root")
def test_a_mount_that_the_kernel_aborted_is_gone(field: Field, big_tree: Path) -> None:
    """`umount -f` of one in use fails, and has cut the programs off all the same."""
    mount = field.mount(field.sim(big_tree).source)
    with mount.started("sleep", "600", cwd=mount.path):
        assert mount.run("umount", "-f", mount.path, code=None).returncode != 0
        assert mount.alive_or_ended().wait() == 0
        assert not mounted_at(mount.path)


@pytest.mark.holds("promise 5", "fault reboot")
def test_a_reboot_in_mid_copy(field: Field, tmp_path: Path) -> None:
    card = field.local("card")
    data = content("reboot", 400_000)
    (card / "log.bin").write_bytes(data)
    link = f"tcpin:{HOST}:{free_udp_port()}"
    vehicle = field.sim(card, "px4", ("--rate", "150000"), link=link)
    mount = field.mount(vehicle.source)
    with mount.started("cp", mount.path / "log.bin", tmp_path / "copy") as copy:
        wait_until("it is under way", lambda: (tmp_path / "copy").stat().st_size > 0)
        vehicle.react(signal.SIGPWR)
        _, errors = copy.communicate(timeout=120)
    assert (copy.returncode, errors) == (0, "")
    assert (tmp_path / "copy").read_bytes() == data


def test_the_end_of_a_mount_leaves_a_newer_one_at_its_place(field: Field, small_tree: Path) -> None:
    """`umount -l` leaves the first one to the program that has a file open there."""
    first, second = (field.prepare(field.sim(small_tree).source) for _ in range(2))
    second.path = first.path
    first.start()
    opened = os.open(next(path for path in first.path.iterdir() if path.is_file()), os.O_RDONLY)
    try:
        subprocess.run(["fusermount3", "-uz", str(first.path)], check=True)
        second.start()
        assert first.end_by(signal.SIGTERM) == 0
        assert second.serves()
        assert second.unmount() == 0
    finally:
        with suppress(OSError):  # its mount has ended
            os.close(opened)
