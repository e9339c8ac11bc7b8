"""mountpoint: checks that end in one helpful line, and the kernel's mount table."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from mavftpfs.client.mountpoint import (
    Mounted,
    canonical,
    check_fuse,
    check_mountpoint,
    is_ours,
    mounts,
    request_timeout,
    unmount,
    why_not_mounted,
)
from mavftpfs.shared.errors import MountFailed


def table(tmp_path: Path, *lines: str) -> str:
    path = tmp_path / "mountinfo"
    path.write_text("".join(f"{line}\n" for line in lines))
    return str(path)


LINE = "36 35 98:0 / {} rw,noatime shared:1 - {} udpin:0 rw,user_id=0"


def test_the_table_is_read_with_its_escapes_and_the_last_mount_wins(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        LINE.format("/mnt/my\\040drone\\134x", "fuse.mavftpfs"),
        LINE.format("/mnt/a", "autofs"),
        LINE.format("/mnt/a", "fuse.mavftpfs"),
        LINE.format("/mnt/b", "fuse.mavftpfs"),
        LINE.format("/mnt/b", "ext4"),
        "garbage",
    )
    first = mounts(path)["/mnt/my drone\\x"]
    assert first == Mounted("36", "fuse.mavftpfs", "udpin:0", 0, "/", first.others)
    assert set(first.others) == {"/mnt/my drone\\x", "/mnt/a", "/mnt/b"}  # the same file system, as it seems
    assert is_ours("/mnt/a", table=path)
    assert not is_ours("/mnt/b", table=path)
    assert not is_ours("/mnt/c", table=path)


@pytest.mark.parametrize(
    ("name", "number", "reason"),
    [
        ("missing", None, "mkdir -p"),
        ("file", None, "not a directory"),
        ("file", errno.ENOTCONN, "fusermount3 -u"),
        ("ours", errno.ENOTCONN, "mavftpfs umount"),
        ("file", errno.EACCES, "Permission denied"),
        ("ours", None, "already mounted"),
    ],
)
def test_a_bad_mountpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, number: int | None, reason: str
) -> None:
    def fail(path: str) -> os.stat_result:
        raise OSError(number, "x")

    (tmp_path / "file").touch()
    (tmp_path / "ours").mkdir()
    known = table(tmp_path, LINE.format(tmp_path / "ours", "fuse.mavftpfs"))
    with monkeypatch.context() as patch:
        if number is not None:
            patch.setattr(os, "stat", fail)
            patch.setattr(os, "statvfs", fail)
        with pytest.raises(MountFailed, match=reason):
            check_mountpoint(str(tmp_path / name), table=known)


def test_no_fuse_device(tmp_path: Path) -> None:
    with pytest.raises(MountFailed, match="modprobe fuse"):
        check_fuse(str(tmp_path / "fuse"))


def test_a_device_that_a_user_may_not_open(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    device = tmp_path / "fuse"
    device.touch()
    monkeypatch.setattr(os, "access", lambda *_: False)
    for uid in (0, 1000):
        with pytest.raises(MountFailed, match="sudo chmod 666"):
            check_fuse(str(device), uid=uid)


def test_what_a_container_lacks_is_said() -> None:
    said = why_not_mounted("/mnt", "fusermount3: mount failed: Operation not permitted")
    assert said.endswith("Operation not permitted (a container needs --device /dev/fuse --cap-add SYS_ADMIN)")
    assert why_not_mounted("/mnt", "no") == "cannot mount on /mnt: no"


def test_no_fusermount_matters_to_users_only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    device = tmp_path / "fuse"
    device.touch()
    monkeypatch.setenv("PATH", str(tmp_path))
    check_fuse(str(device), uid=0)
    with pytest.raises(MountFailed, match="fusermount3"):
        check_fuse(str(device), uid=1000)


def test_canonical_follows_links(tmp_path: Path) -> None:
    (tmp_path / "real" / "mnt").mkdir(parents=True)
    (tmp_path / "link").symlink_to("real")
    (tmp_path / "real" / "last").symlink_to("mnt")
    assert canonical(f"{tmp_path}/link/mnt/") == f"{tmp_path}/real/mnt"
    assert canonical(f"{tmp_path}/link/last") == f"{tmp_path}/real/mnt"
    assert canonical(f"{tmp_path}/link/new") == f"{tmp_path}/real/new"


def test_what_somebody_else_has_unmounted_is_gone(tmp_path: Path) -> None:
    """After `fusermount3 -u` a mount ended with 3, `Invalid argument`, if a thread of it was still busy."""
    unmount(str(tmp_path), lazy=True)


def test_what_is_busy_for_a_moment_is_unmounted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel may still be closing the files of a program that has ended."""
    program = tmp_path / "fusermount3"
    program.write_text(
        f"#!/bin/sh\necho x >> {tmp_path}/tries\n[ $(wc -l < {tmp_path}/tries) -ge 3 ] && exit 0\n"
        "echo 'fusermount3: failed to unmount /x: Device or resource busy' >&2\nexit 1\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    unmount("/x")
    assert (tmp_path / "tries").read_text() == "x\n" * 3


@pytest.mark.parametrize(
    ("default", "most", "limit"),
    [
        (None, None, None),
        ("0\n", "0\n", None),
        ("30\n", "0\n", 30),
        ("0\n", "60\n", 60),
        ("90\n", "60\n", 60),
    ],
)
def test_the_kernels_limit_for_a_request(
    tmp_path: Path, default: str | None, most: str | None, limit: int | None
) -> None:
    for name, text in (("default_request_timeout", default), ("max_request_timeout", most)):
        if text is not None:
            (tmp_path / name).write_text(text)
    assert request_timeout(tmp_path) == limit
