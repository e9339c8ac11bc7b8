"""Options, and the other commands that talk to a mount: mount(8), status, umount."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import Mount, abort_mount, mounted_at, wait_until
from tests.support.vehicles import PROJECT

NOBODY_UID = 65534
STAT = "import os, sys; s = os.stat(sys.argv[1]); print(s.st_uid, s.st_gid, oct(s.st_mode))"


def facts(mount: Mount, name: str) -> list[str]:
    """Return [uid, gid, mode] of a path in the mount."""
    return mount.python(STAT, mount.path / name).split()


def mount_line(path: Path) -> list[str]:
    """Return the words of the kernel's line about a mount."""
    lines = Path("/proc/self/mounts").read_text().splitlines()
    return next(line.split() for line in lines if line.split()[1] == str(path))


def test_kernel_shows_source_and_type(field: Field, small_tree: Path) -> None:
    vehicle = field.sim(small_tree)
    mount = field.mount(vehicle.source, "noatime", "nosuid", "nodev")
    words = mount_line(mount.path)
    assert words[0] == vehicle.source
    assert words[2] == "fuse.mavftp"
    assert {"noatime", "nosuid", "nodev", "default_permissions"} <= set(words[3].split(","))


def test_fsname_ro_and_fstab_words(field: Field, small_tree: Path) -> None:
    words = (
        "ro",
        "fsname=my drone",
        "_netdev",
        "nofail",
        "noauto",
        "user",
        "x-systemd.automount",
        "defaults",
    )
    mount = field.mount(field.sim(small_tree).source, *words)
    line = mount_line(mount.path)
    assert line[0] == "my\\040drone"
    assert "ro" in line[3].split(",")


def test_owner_and_masks(field: Field, small_tree: Path) -> None:
    mount = field.mount(field.sim(small_tree).source, "uid=1234", "gid=4321", "fmask=0137", "dmask=0027")
    uid, gid, mode = facts(mount, "README.txt")
    assert (uid, gid) == ("1234", "4321")
    assert mode in ("0o100640", "0o100440")
    assert facts(mount, "sizes")[2] in ("0o40750", "0o40550")


@pytest.fixture
def open_place() -> Iterator[Path]:
    """A directory that other users can reach, unlike pytest's own."""
    path = Path(tempfile.mkdtemp(prefix="mavftpfs-test-"))
    path.chmod(0o755)
    yield path
    shutil.rmtree(path)


@pytest.mark.parametrize("allowed", [True, False])
def test_allow_other(field: Field, small_tree: Path, open_place: Path, allowed: bool) -> None:
    options = ("allow_other", "umask=022") if allowed else ("umask=022",)
    mount = field.prepare(field.sim(small_tree).source, *options)
    mount.path = open_place / "mnt"
    mount.path.mkdir()
    mount.start()
    as_nobody = ("setpriv", f"--reuid={NOBODY_UID}", f"--regid={NOBODY_UID}", "--clear-groups")
    result = mount.run(*as_nobody, "cat", mount.path / "README.txt", code=None)
    if allowed:
        assert (result.returncode, result.stdout) == (0, (small_tree / "README.txt").read_text())
    else:
        assert "Permission denied" in result.stderr
    mount.finish()


@pytest.mark.parametrize("how", ["root", "subtree"])
def test_a_subtree_can_be_mounted(field: Field, small_tree: Path, how: str) -> None:
    source = field.sim(small_tree).source
    if how == "root":
        mount = field.mount(source, "root=/deep/d0")
    else:
        mount = field.mount(f"{source}#/deep/d0")
    assert mount.run("cat", mount.path / "at1.txt").stdout == "level 1\n"
    mount.run("diff", "-r", small_tree / "deep/d0", mount.path)


def test_trace_shows_every_payload_decoded(field: Field, small_tree: Path, tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    mount = field.mount(field.sim(small_tree).source, f"trace={trace}")
    mount.run("cat", mount.path / "sizes/478.bin")
    assert mount.unmount() == 0
    text = trace.read_text()
    for word in ("LIST_DIRECTORY", "OPEN_FILE_RO", "READ_FILE", "TERMINATE_SESSION", "/sizes/478.bin"):
        assert word.lower() in text.lower(), f"{word} is not in the trace:\n{text[:2000]}"


def test_log_file_and_debug(field: Field, small_tree: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    mount = field.mount(field.sim(small_tree).source, f"log_file={log}", argv=("-d",))
    mount.run("cat", mount.path / "README.txt")
    assert mount.unmount() == 0
    assert "README.txt" in log.read_text() + mount.alive_or_ended().text()


def mavftpfs(*argv: str | Path) -> str:
    """Run a command that must succeed and return its stdout."""
    command = [sys.executable, "-m", "mavftpfs", *map(str, argv)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=PROJECT, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_status_tells_about_vehicle_and_link(field: Field, small_tree: Path) -> None:
    vehicle = field.sim(small_tree)
    mount = field.mount(vehicle.source)
    mount.run("cat", mount.path / "sizes/35850.bin")
    status: dict[str, Any] = json.loads(mavftpfs("status", mount.path, "--json"))
    text = json.dumps(status)
    assert vehicle.source in text
    assert "retransmissions" in text
    assert vehicle.source in mavftpfs("status", mount.path)
    code = "import os, sys; print(os.getxattr(sys.argv[1], 'user.mavftpfs.status').decode())"
    assert vehicle.source in mount.python(code, mount.path)


def test_xattrs(field: Field, small_tree: Path) -> None:
    mount = field.mount(field.sim(small_tree).source)
    path = mount.path / "sizes/478.bin"
    missing = "os.getxattr(sys.argv[1], 'user.nothing')"
    assert mount.errno_of(missing, path) == "ENODATA"
    assert mount.errno_of(missing, mount.path / "sizes") == "ENODATA"
    assert mount.python("import os, sys; print(os.listxattr(sys.argv[1]))", path).strip() == "[]"


@pytest.fixture
def path_with_program(tmp_path: Path) -> str:
    """A PATH on which `mavftpfs` is found, as after an installation."""
    folder = tmp_path / "bin"
    folder.mkdir()
    (folder / "mavftpfs").symlink_to(Path(sys.executable).parent / "mavftpfs")
    return f"{folder}:{os.environ['PATH']}"


def test_mount_8_and_umount_8(field: Field, small_tree: Path, path_with_program: str) -> None:
    mount = field.prepare(field.sim(small_tree).source)
    words = "ro,noatime,allow_other,uid=1000,nofail,_netdev,x-systemd.automount"
    environment = {**os.environ, "PATH": path_with_program}
    argv = ["mount", "-t", "fuse.mavftpfs", mount.source, str(mount.path), "-o", words]
    try:
        done = subprocess.run(argv, capture_output=True, text=True, timeout=60, env=environment, check=False)
        assert done.returncode == 0, done.stderr
        assert mount_line(mount.path)[2] == "fuse.mavftp"
        assert facts(mount, "README.txt")[0] == "1000"
        mount.run("diff", "-r", small_tree / "sizes", mount.path / "sizes")
        subprocess.run(["umount", str(mount.path)], check=True, timeout=60)
    finally:
        abort_mount(mount.path)


def test_mount_8_names_an_unknown_option(field: Field, small_tree: Path, path_with_program: str) -> None:
    mount = field.prepare(field.sim(small_tree).source)
    argv = ["mount", "-t", "fuse.mavftpfs", mount.source, str(mount.path), "-o", "frobnicate"]
    environment = {**os.environ, "PATH": path_with_program}
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60, env=environment, check=False)
    assert done.returncode != 0
    assert "frobnicate" in done.stderr
    assert not mounted_at(mount.path)


def test_auto_unmount_clears_after_a_kill(field: Field, small_tree: Path) -> None:
    mount = field.mount(field.sim(small_tree).source, "auto_unmount")
    process, mount.process = mount.alive(), None
    process.kill()
    try:
        wait_until("the kernel's mount is gone", lambda: not mounted_at(mount.path), 20)
    finally:
        abort_mount(mount.path)


def test_a_remote_change_is_seen_within_the_cache_time(field: Field, tmp_path: Path) -> None:
    card = field.local("card")
    (card / "a.txt").write_text("first\n")
    mount = field.mount(
        field.sim(card, "spec").source, "dir_timeout=1", "attr_timeout=0.2", "negative_timeout=0.2"
    )
    assert mount.run("cat", mount.path / "a.txt").stdout == "first\n"
    (card / "a.txt").write_text("second, longer\n")
    (card / "b.txt").write_text("new\n")

    def seen() -> bool:
        return mount.run("cat", mount.path / "a.txt", mount.path / "b.txt", code=None).stdout == (
            "second, longer\nnew\n"
        )

    wait_until("the change is seen", seen, 20)
