"""The start of a mount: in the background, and what can go wrong."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import abort_mount, mavftpfs, mounted_at, processes_in, unmount, wait_until
from tests.support.vehicles import HOST, PROJECT, Process, free_udp_port


def test_a_mount_is_not_put_onto_a_vehicle_and_says_what_it_hides(field: Field, small_tree: Path) -> None:
    vehicle = field.sim(small_tree)
    mount = field.mount(vehicle.source)
    inside = next(path for path in mount.path.iterdir() if path.is_dir())
    assert f"lies in the mount on {mount.path}" in mavftpfs(vehicle.source, inside, code=3)[1]
    full = field.local("full")
    (full / "file").write_text("")
    source = f"udpin:{HOST}:{free_udp_port()}"
    said = mavftpfs(source, full, "-o", "connect_timeout=1,window=4", code=2)[1]
    assert f"{full} is not empty: its files are hidden" in said
    assert said.count("option window is gone") == 1


@pytest.mark.needs("namespaces")
def test_no_fuse_device_is_exit_3(tmp_path: Path) -> None:
    hide = 'mount -t tmpfs none /dev && exec "$@"'
    command = ["unshare", "--mount", "sh", "-c", hide, "sh", sys.executable, "-m", "mavftpfs"]
    argv = [*command, f"udpin:{HOST}:{free_udp_port()}", str(tmp_path)]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60, cwd=PROJECT, check=False)
    assert done.returncode == 3, done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "/dev/fuse" in done.stderr


def test_the_daemon_returns_when_mounted_and_goes_on(field: Field, small_tree: Path) -> None:
    mount = field.prepare(field.sim(small_tree).source)
    # Run with pipes as a script would: a daemon that keeps them open would hang this call.
    argv = (sys.executable, "-m", "mavftpfs", mount.source, str(mount.path))
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


def test_a_second_mount_of_a_vehicle_and_a_scan_name_the_first(field: Field, small_tree: Path) -> None:
    source = field.sim(small_tree).source
    first, second = field.mount(source), field.prepare(source)
    _, said = mavftpfs(source, second.path)
    try:
        _check_both_are_named(source, first.path, second.path, said)
    finally:
        mavftpfs("umount", second.path)
    first.unmount()
    assert mavftpfs(source, second.path)[1] == ""
    mavftpfs("umount", second.path)


def _check_both_are_named(source: str, first: Path, second: Path, said: str) -> None:
    assert f"this vehicle is mounted on {first}, too; " in said
    assert said.endswith(f"to have only one, run: mavftpfs umount {first}\n")
    assert mounted_at(second)
    _, row, ftp = mavftpfs("scan", source)[0].splitlines()
    assert row.startswith("1/1 ")
    assert str(first) in ftp
    assert str(second) in ftp


LIMITED = """
mkdir -p /proc/sys/fs/fuse 2>/dev/null
mount --bind "$1" /proc/sys/fs/fuse && shift && exec "$@"
"""


@pytest.mark.needs("namespaces")
def test_a_kernel_that_ends_slow_mounts_is_named(field: Field, small_tree: Path, tmp_path: Path) -> None:
    (tmp_path / "default_request_timeout").write_text("40\n")
    (tmp_path / "max_request_timeout").write_text("0\n")
    mount = field.prepare(field.sim(small_tree).source)
    argv = [sys.executable, "-m", "mavftpfs", mount.source, str(mount.path), "-f"]
    words = ["unshare", "--mount", "sh", "-c", LIMITED, "sh", str(tmp_path), *argv]
    process = Process("limited", words, field.local("output"))
    try:
        wait_until(
            "it says so", lambda: "this kernel ends a mount that takes more than 40 s" in process.text()
        )
        assert "sudo sysctl fs.fuse.default_request_timeout=0 fs.fuse.max_request_timeout=0" in process.text()
        assert process.stop(signal.SIGINT) == 0
    finally:
        process.kill()
