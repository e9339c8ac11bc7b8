"""Blocks on the local disk: whose they are, and that nothing but what was kept is ever returned."""

from __future__ import annotations

import os
import stat
import time
from pathlib import Path

import pytest

from mavftpfs.cache.kept import CLOCK_SET, YOUNG, key_of, vehicle_identity
from mavftpfs.cache.kept_disk import ABANDONED, NAME, FileKey, KeptDisk
from mavftpfs.shared.model import DirEntry, EntryKind

NOW = 1_800_000_000.0
MTIME = 1_700_000_000
VEHICLE = b"vehicle"
VERSION = f"mtime {MTIME}"
KEY = FileKey(VEHICLE, b"/log/a", 100_000, VERSION)
DATA = bytes(range(256)) * 256


def entry(size: int = 5, mtime: int | None = MTIME) -> DirEntry:
    return DirEntry(b"a", EntryKind.FILE, size, mtime)


def block(number: int, key: FileKey = KEY) -> str:
    return key.block(number * len(DATA), (number + 1) * len(DATA))


@pytest.fixture
def directory(tmp_path: Path) -> KeptDisk:
    return KeptDisk(tmp_path / "deep" / "cache", 1 << 20)


def files_of(tmp_path: Path) -> list[Path]:
    return [path for path in (tmp_path / "deep").rglob("*") if path.is_file()]


# --- names


def test_each_part_of_the_key_makes_another_block() -> None:
    others = [
        FileKey(b"other", KEY.path, KEY.size, KEY.version),
        FileKey(KEY.vehicle, b"/log/b", KEY.size, KEY.version),
        FileKey(KEY.vehicle, KEY.path, KEY.size + 1, KEY.version),
        FileKey(KEY.vehicle, KEY.path, KEY.size, f"mtime {MTIME + 1}"),
        FileKey(KEY.vehicle, KEY.path, KEY.size, ""),
        FileKey(KEY.vehicle + b"/", KEY.path[1:], KEY.size, KEY.version),  # parts do not run into each other
    ]
    names = [block(0, key) for key in [KEY, *others]] + [block(1), block(10)]
    names += [KEY.block(0, 5), KEY.block(len(DATA), 3 * len(DATA))]  # blocks had another size once
    assert len(set(names)) == len(names)
    assert block(0) == block(0, FileKey(VEHICLE, b"/log/a", 100_000, VERSION))


def test_what_may_not_be_kept_has_no_key() -> None:
    assert key_of(VEHICLE, b"/a", entry(), NOW) == FileKey(VEHICLE, b"/a", 5, VERSION)
    assert key_of(None, b"/a", entry(), NOW) is None
    assert key_of(VEHICLE, b"/@SYS/tasks.txt", entry(), NOW) is None
    assert key_of(VEHICLE, b"/a", entry(size=0), NOW) is None
    assert (
        key_of(VEHICLE, b"/a", entry(mtime=int(NOW - YOUNG) + 1), NOW) is None
    )  # may change in the same tick
    assert key_of(VEHICLE, b"/a", entry(mtime=int(NOW) + 9999), NOW) is None


@pytest.mark.parametrize("mtime", [None, 0, 315_532_800, CLOCK_SET - 1])
def test_an_mtime_without_a_clock_tells_nothing(mtime: int | None) -> None:
    assert key_of(VEHICLE, b"/a", entry(mtime=mtime), NOW) == FileKey(VEHICLE, b"/a", 5, "")


def test_a_vehicle_that_does_not_say_who_it_is_has_no_identity() -> None:
    assert vehicle_identity(0, bytes(18), 1, b"git") is None
    known = {
        vehicle_identity(1, bytes(18), 1, b"git"),
        vehicle_identity(2, bytes(18), 1, b"git"),
        vehicle_identity(0, b"x" + bytes(17), 1, b"git"),
        vehicle_identity(1, bytes(18), 2, b"git"),
        vehicle_identity(1, bytes(18), 1, b"gut"),
    }
    assert None not in known
    assert len(known) == 5


# --- the disk


@pytest.mark.parametrize("place", [0, 20, 40, -1])
def test_a_changed_byte_is_a_miss_and_the_block_is_gone(
    directory: KeptDisk, tmp_path: Path, place: int
) -> None:
    directory.write(block(0), DATA)
    (file,) = files_of(tmp_path)
    damaged = bytearray(file.read_bytes())
    damaged[place] ^= 1
    file.write_bytes(damaged)
    assert directory.read(block(0)) is None
    assert files_of(tmp_path) == []


def test_a_block_under_a_wrong_name_is_a_miss(directory: KeptDisk, tmp_path: Path) -> None:
    directory.write(block(0), DATA)
    directory.write(block(1), DATA[::-1])
    first, second = files_of(tmp_path)
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)
    assert directory.read(block(0)) is None
    assert directory.read(block(1)) is None


def test_nobody_else_can_look_into_it(directory: KeptDisk, tmp_path: Path) -> None:
    directory.write(block(0), DATA)
    parent = tmp_path / "deep" / "cache"
    path = parent / NAME
    assert stat.S_IMODE(path.stat().st_mode) == 0o700
    for each in (parent, path):
        each.chmod(0o755)
    KeptDisk(parent, 1)
    assert stat.S_IMODE(path.stat().st_mode) == 0o700
    assert stat.S_IMODE(parent.stat().st_mode) == 0o755  # the user's own: it may be /tmp


def test_a_directory_of_somebody_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "linked").mkdir()
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / NAME).symlink_to(tmp_path / "linked")
    with pytest.raises(PermissionError):
        KeptDisk(tmp_path / "a", 1)
    uid = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: uid + 1)
    with pytest.raises(PermissionError):
        KeptDisk(tmp_path / "b", 1)


def test_it_stays_within_its_budget_and_keeps_what_was_used(tmp_path: Path) -> None:
    directory = KeptDisk(tmp_path / "deep", 20 * len(DATA))
    for index in range(60):
        directory.write(block(index), DATA)
        if index:
            assert directory.read(block(0)) == DATA, index
    total = sum(path.stat().st_size for path in files_of(tmp_path))
    assert total <= 22 * len(DATA)


def test_what_a_killed_writer_left_goes_after_a_while(directory: KeptDisk, tmp_path: Path) -> None:
    directory.write(block(0), DATA)
    folder = files_of(tmp_path)[0].parent
    old, new = folder / ".new-1-0", folder / ".new-2-0"
    for path in (old, new):
        path.write_bytes(b"x")
    past = time.time() - ABANDONED - 1
    os.utime(old, (past, past))
    directory.shrink()
    assert not old.exists()
    assert new.exists()
    assert directory.read(block(0)) == DATA
