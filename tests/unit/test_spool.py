"""Where undelivered bytes wait: memory, disk, and what the next mount finds after a kill."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path
from random import Random

import pytest

from mavftpfs.cache.spool import PAGE, SLOTS, Spool, SpoolDirectory
from mavftpfs.shared.errors import NoSpace


def spool_of(tmp_path: Path, memory: int = 4 * PAGE, disk: int = 100 * PAGE) -> Spool:
    return Spool(memory_max=lambda: memory, spool_max=disk, directory=tmp_path)


def test_bytes_stay_in_memory_up_to_the_limit_and_go_to_disk_beyond(tmp_path: Path) -> None:
    spool = spool_of(tmp_path)
    content = spool.content()
    data = bytes(range(256)) * 1024  # exactly the limit
    content.put(0, data)
    assert (spool.in_memory, spool.on_disk) == (4 * PAGE, 0)
    assert list(tmp_path.iterdir()) == []
    content.put(len(data), b"more")
    assert spool.in_memory == 0
    assert spool.on_disk >= len(data)
    assert content.get(PAGE - 3, PAGE + 3) == data[PAGE - 3 : PAGE + 3]
    assert content.get(len(data), len(data) + 4) == b"more"
    content.close()
    assert spool.bytes_held == 0
    assert list(tmp_path.iterdir()) == []


def test_pages_are_joined(tmp_path: Path) -> None:
    content = spool_of(tmp_path).content()
    content.put(PAGE - 2, b"abcd")
    assert content.get(PAGE - 2, PAGE + 2) == b"abcd"


def test_what_a_dead_mount_left_is_neither_reused_nor_discarded(tmp_path: Path) -> None:
    slot = tmp_path / "slot0"
    slot.mkdir()
    (slot / "000001.data").write_bytes(b"of a dead mount")
    directory = SpoolDirectory(tmp_path, Random(1))
    spool = spool_of(directory.path, memory=0)
    content = spool.content()
    content.put(0, b"mine")
    content.persist({"size": 4})
    assert content.get(0, 4) == b"mine"
    directory.discard()
    assert {path.name for path in slot.iterdir()} == {"000001.data", "owner"}
    assert (slot / "000001.data").read_bytes() == b"of a dead mount"
    directory.close()


def test_a_full_spool_takes_nothing_and_loses_nothing(tmp_path: Path) -> None:
    spool = spool_of(tmp_path, memory=0, disk=1000)
    content = spool.content()
    content.put(0, bytes(900))
    with pytest.raises(NoSpace):
        content.put(900, bytes(200))
    content.put(0, b"x" * 900)
    assert content.get(0, 900) == b"x" * 900
    content.cut(100)
    assert spool.on_disk == 100
    content.put(100, bytes(900))


def test_a_disk_that_fills_up_on_the_way_leaves_the_bytes_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = spool_of(tmp_path)
    content = spool.content()
    data = bytes(range(256)) * 1024
    content.put(0, data)
    really, calls = os.pwrite, iter(range(100))

    def pwrite(descriptor: int, piece: bytes, offset: int) -> int:
        if next(calls) > 0:
            raise OSError(errno.ENOSPC, "full")
        return really(descriptor, piece, offset)

    monkeypatch.setattr(os, "pwrite", pwrite)
    with pytest.raises(NoSpace):
        content.put(len(data), b"more")
    with pytest.raises(NoSpace):
        content.persist({"size": len(data)})
    assert content.get(0, len(data)) == data
    assert (spool.in_memory, spool.on_disk) == (4 * PAGE, 0)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    content.put(len(data), b"more")
    assert content.get(0, len(data) + 4) == data + b"more"


def test_no_directory_means_one_that_does_not_stay(tmp_path: Path) -> None:
    spool = Spool(memory_max=lambda: 0, spool_max=1000)
    content = spool.content()
    content.put(0, b"abc")
    place = spool.new_file().parent
    assert os.stat(place).st_mode & 0o777 == 0o700
    content.close()
    spool.close()
    assert not place.exists()


def test_a_directory_that_cannot_be_used_is_no_space(tmp_path: Path) -> None:
    spool = Spool(memory_max=lambda: 0, spool_max=1000, directory=tmp_path / "none")
    with pytest.raises(NoSpace):
        spool.content().put(0, b"abc")


def test_what_a_killed_mount_left_is_moved_to_recovery(tmp_path: Path) -> None:
    claimed = SpoolDirectory(tmp_path / "spool", Random(1))
    assert os.stat(claimed.path).st_mode & 0o777 == 0o700
    content = Spool(memory_max=lambda: PAGE, spool_max=PAGE, directory=claimed.path).content()
    content.put(0, b"precious")
    facts = {"path": "/card/a/b.txt", "size": 8}
    content.persist(facts)
    claimed.close()  # as the kernel does for a killed process

    again = SpoolDirectory(tmp_path / "spool", Random(2))
    assert again.owner not in again.dead_owners
    assert claimed.owner in again.dead_owners
    saved = again.rescue(tmp_path / "recovered")
    assert [path.name for path in saved] == ["card__a__b.txt"]
    assert saved[0].read_bytes() == b"precious"
    assert json.loads((tmp_path / "recovered" / "card__a__b.txt.json").read_text()) == facts
    assert again.rescue(tmp_path / "recovered") == []
    again.close()


def test_names_in_recovery_do_not_collide_and_unknown_ones_are_kept(tmp_path: Path) -> None:
    slot = SpoolDirectory(tmp_path / "spool", Random(1))
    for number in (1, 2, 3):
        (slot.path / f"{number}.data").write_bytes(b"%d" % number)
    (slot.path / "1.json").write_text('{"path": "/x"}')
    (slot.path / "2.json").write_text('{"path": "/x"}')
    (slot.path / "3.json").write_text("not JSON")
    slot.close()
    saved = SpoolDirectory(tmp_path / "spool", Random(1)).rescue(tmp_path / "r")
    assert [path.name for path in saved] == ["x", "x.1", "3.data"]
    assert [path.read_bytes() for path in saved] == [b"1", b"2", b"3"]


def test_two_mounts_do_not_share_and_a_live_one_is_left_alone(tmp_path: Path) -> None:
    first = SpoolDirectory(tmp_path, Random(1))
    (first.path / "1.data").write_bytes(b"live")
    second = SpoolDirectory(tmp_path, Random(2))
    assert second.path != first.path
    assert first.owner not in second.dead_owners
    assert second.rescue(tmp_path / "r") == []
    second_path = second.path
    (second_path / "2.data").write_bytes(b"dead")
    second.close()
    first.close()
    third = SpoolDirectory(tmp_path, Random(3))
    assert third.path == first.path
    assert {path.read_bytes() for path in third.rescue(tmp_path / "r")} == {b"live", b"dead"}
    third.close()


def test_who_takes_a_slot_that_another_mount_knows_for_dead_is_alive(tmp_path: Path) -> None:
    early = [SpoolDirectory(tmp_path, Random(n)) for n in (1, 2)]
    for each in early:
        each.close()
    first = SpoolDirectory(tmp_path, Random(3))
    assert {each.owner for each in early} <= first.dead_owners
    first.rescue(tmp_path / "r")
    second = SpoolDirectory(tmp_path, Random(2))
    assert second.path == early[1].path
    assert second.owner not in first.dead_owners
    assert first.owner not in second.dead_owners
    for each in (first, second):
        each.close()
    third = SpoolDirectory(tmp_path, Random(4))
    assert {each.owner for each in (*early, first, second)} <= third.dead_owners
    third.close()


def test_there_are_enough_slots_and_not_more(tmp_path: Path) -> None:
    claimed = [SpoolDirectory(tmp_path, Random(n)) for n in range(SLOTS)]
    with pytest.raises(OSError, match="in use"):
        SpoolDirectory(tmp_path, Random(0))
    for each in claimed:
        each.close()
