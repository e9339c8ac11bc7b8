"""What can go wrong at the start: one line that says what and why, the documented exit code, no traceback,
in the foreground and as a daemon."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.logs import suspects
from tests.support.mounts import abort_mount, mavftpfs, mounted_at, processes_in, unmount, wait_until
from tests.support.vehicles import HOST, PROJECT, free_udp_port

NOBODY = f"udpin:{HOST}:0"


def complaint(*words: object, code: int) -> str:
    """Run a command that must end with `code`, and return its one line of complaint."""
    out, said = mavftpfs(*words, code=code)
    assert out == ""
    assert len(said.splitlines()) == 1, said
    return said


@pytest.fixture
def mountpoint(tmp_path: Path) -> Path:
    """An empty directory."""
    path = tmp_path / "mnt"
    path.mkdir()
    return path


@pytest.mark.parametrize("foreground", [True, False], ids=["foreground", "daemon"])
def test_no_vehicle_is_exit_2(mountpoint: Path, foreground: bool) -> None:
    source = f"udpin:{HOST}:{free_udp_port()}"
    extra = ["-f"] if foreground else []
    line = complaint(source, mountpoint, "-o", "connect_timeout=1", *extra, code=2)
    assert "heartbeat" in line or "vehicle" in line
    assert not mounted_at(mountpoint)


def test_a_missing_remote_root_is_named(field: Field, small_tree: Path, mountpoint: Path) -> None:
    source = field.sim(small_tree).source
    assert "/no/such" in complaint(f"{source}#/no/such", mountpoint, code=1)


def test_a_mount_is_not_put_onto_a_vehicle_and_says_what_it_hides(field: Field, small_tree: Path) -> None:
    vehicle = field.sim(small_tree)
    mount = field.mount(vehicle.source)
    inside = next(path for path in mount.path.iterdir() if path.is_dir())
    assert f"lies in the mount on {mount.path}" in complaint(vehicle.source, inside, code=3)
    full = field.local("full")
    (full / "file").write_text("")
    source = f"udpin:{HOST}:{free_udp_port()}"
    said = mavftpfs(source, full, "-o", "connect_timeout=1", code=2)[1]
    assert f"{full} is not empty: what is in it is hidden" in said


def test_no_fuse_device_is_exit_3(mountpoint: Path) -> None:
    hide = 'mount -t tmpfs none /dev && exec "$@"'
    command = ["unshare", "--mount", "sh", "-c", hide, "sh", sys.executable, "-m", "mavftpfs"]
    argv = [*command, f"udpin:{HOST}:{free_udp_port()}", str(mountpoint)]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60, cwd=PROJECT, check=False)
    assert done.returncode == 3, done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "/dev/fuse" in done.stderr


@pytest.mark.holds("rule 14.33")
def test_a_path_too_long_for_the_wire_is_enametoolong(field: Field, tmp_path: Path) -> None:
    root = tmp_path / "root"
    deep = root
    for letter in "abcdefg":
        deep = deep / (letter * 40)
    deep.mkdir(parents=True)
    (deep / "file").write_text("too deep")
    mount = field.mount(field.sim(root).source)
    inner = mount.path / deep.relative_to(root)
    assert mount.errno_of("os.listdir(sys.argv[1])", inner) == "ENAMETOOLONG"
    assert mount.run("ls", inner.parent.parent.parent.parent).stdout.split() == ["d" * 40]


REFUSALS = {
    "os.fsync(os.open(sys.argv[1], os.O_RDONLY))": "",
    "assert os.access(sys.argv[1] + '/README.txt', os.W_OK)": "",
    "os.setxattr(sys.argv[1] + '/README.txt', 'user.x', b'1')": "ENOTSUP",
    "os.removexattr(sys.argv[1] + '/README.txt', 'user.x')": "ENOTSUP",
    "os.readlink(sys.argv[1] + '/README.txt')": "EINVAL",
    "os.symlink('README.txt', sys.argv[1] + '/sym')": "EPERM",
    "os.link(sys.argv[1] + '/README.txt', sys.argv[1] + '/hard')": "EPERM",
    "os.mkfifo(sys.argv[1] + '/fifo')": "EPERM",
}
"""Snippets, and the errno of each: "" for success."""


def test_what_no_card_has_is_refused_in_the_usual_way(field: Field, small_tree: Path) -> None:
    mount = field.mount(field.sim(small_tree).source)
    assert {code: mount.errno_of(code, mount.path) for code in REFUSALS} == REFUSALS


def test_the_daemon_returns_when_mounted_and_goes_on(field: Field, small_tree: Path, tmp_path: Path) -> None:
    mount = field.prepare(field.sim(small_tree).source)
    log = tmp_path / "daemon.log"
    # Run with pipes as a script would: a daemon that keeps them open would hang this call.
    argv = (sys.executable, "-m", "mavftpfs", mount.source, str(mount.path), "-o", f"log_file={log}")
    done = subprocess.run(argv, capture_output=True, timeout=60, cwd=PROJECT, check=False)
    try:
        assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")
        assert mounted_at(mount.path)
        assert "sizes" in mount.run("ls", mount.path).stdout.split()
        pids = processes_in(mount.path)
        assert len(pids) == 1
        unmount(mount.path)
        wait_until("the daemon ended", lambda: not processes_in(mount.path))
    finally:
        abort_mount(mount.path)
    assert suspects(log.read_text()) == []
