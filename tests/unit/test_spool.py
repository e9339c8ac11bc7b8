"""Where undelivered bytes wait, and what the next mount finds after a kill."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from mavftpfs.cache import spool as spooling
from mavftpfs.cache.recovery import SLOTS, SpoolDirectory
from mavftpfs.cache.spool import Spool, SpoolContent
from mavftpfs.shared.errors import NoSpace, SpoolFailed

pytestmark = pytest.mark.holds("promise 3")


PAGE = 64 * 1024


def test_bytes_lie_on_disk_until_they_are_not_wanted(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    content = SpoolContent(spool)
    assert list(tmp_path.iterdir()) == []
    content.put(0, b"some")
    content.put(9, b"more")
    assert spool.held == 8
    assert (tmp_path / "000001.data").read_bytes() == b"some".ljust(9, b"\0") + b"more"
    assert content.get(2, 4) + content.get(9, 13) == b"memore"
    content.close()
    assert spool.held == 0
    assert list(tmp_path.iterdir()) == []


def test_what_a_dead_mount_left_is_neither_reused_nor_discarded(tmp_path: Path) -> None:
    slot = tmp_path / "slot0"
    slot.mkdir()
    (slot / "000001.data").write_bytes(b"of a dead mount")
    directory = SpoolDirectory(tmp_path)
    content = SpoolContent(Spool(directory.path))
    content.put(0, b"mine")
    content.persist({"size": 4})
    assert content.get(0, 4) == b"mine"
    directory.discard()
    assert [path.name for path in directory.path.iterdir()] == ["owner"]
    assert (slot / "000001.data").read_bytes() == b"of a dead mount"
    directory.close()


def test_a_full_spool_takes_nothing_and_loses_nothing(tmp_path: Path) -> None:
    spool = Spool(tmp_path, spool_max=1000)
    content = SpoolContent(spool)
    content.put(0, bytes(900))
    with pytest.raises(NoSpace):
        content.put(900, bytes(200))
    content.put(0, b"x" * 900)
    assert content.get(0, 900) == b"x" * 900
    content.cut(100)
    assert spool.held == 100
    content.put(100, bytes(900))


def test_a_disk_that_fills_up_on_the_way_takes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = Spool(tmp_path)
    content = SpoolContent(spool)
    content.put(0, b"old")
    really, calls = os.pwrite, iter(range(100))

    def pwrite(descriptor: int, piece: bytes, offset: int) -> int:
        if next(calls) > 0:
            raise OSError(errno.ENOSPC, "full")
        return really(descriptor, piece[:PAGE], offset)

    data = bytes(range(256)) * 1024
    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", pwrite)
        with pytest.raises(NoSpace):
            content.put(3, data)
    assert spool.held == 3
    content.put(1000, b"far", zeros=997)
    assert content.get(0, 1003) == b"old".ljust(1000, b"\0") + b"far"
    content.cut(3)
    content.put(3, data)
    assert content.get(0, 3 + len(data)) == b"old" + data


def test_names_in_recovery_do_not_collide_and_unknown_ones_are_kept(tmp_path: Path) -> None:
    slot = SpoolDirectory(tmp_path / "spool")
    facts = [json.dumps({"path": f"/{name}"}) for name in ("x.json", "x", "x.json")]
    for number, text in enumerate([*facts, "not JSON"]):
        (slot.path / f"{number}.data").write_bytes(b"%d" % number)
        (slot.path / f"{number}.json").write_text(text)
    slot.close()
    saved = SpoolDirectory(tmp_path / "spool").rescue(tmp_path / "r")
    assert [path.read_bytes() for path in saved] == [b"0", b"1", b"2", b"3"]
    assert [path.name for path in saved] == ["x.json", "x.1", "x.json.1", "3.data"]
    assert len(list((tmp_path / "r").iterdir())) == 2 * len(saved), "each has its description"


def test_there_are_enough_slots_and_not_more(tmp_path: Path) -> None:
    claimed = [SpoolDirectory(tmp_path) for n in range(SLOTS)]
    with pytest.raises(OSError, match="in use"):
        SpoolDirectory(tmp_path)
    for each in claimed:
        each.close()


# --- a process that is killed while a program writes


def written(tmp_path: Path) -> tuple[SpoolDirectory, SpoolContent]:
    """A file that was written, and not closed."""
    directory = SpoolDirectory(tmp_path / "spool")
    content = SpoolContent(Spool(directory.path), b"/card/log.bin")
    content.put(0, b"so far")
    return directory, content


def rescued(directory: SpoolDirectory, tmp_path: Path) -> dict[str, bytes]:
    """Return the files that the next mount offers, without the descriptions."""
    directory.close()  # as the kernel does for a killed process
    again = SpoolDirectory(tmp_path / "spool")
    found = again.rescue(tmp_path / "recovered")
    assert [path.name for path in again.path.iterdir()] == ["owner"]
    again.close()
    return {path.name: path.read_bytes() for path in found}


@pytest.mark.parametrize("close", [False, True])
def test_the_description_names_the_vehicle_whenever_it_is_written(tmp_path: Path, close: bool) -> None:
    vehicle = {"system": 1, "uid": "0123456789abcdef"}
    spool = Spool(tmp_path, vehicle=lambda: vehicle)
    content = SpoolContent(spool, b"/card/log.bin")
    content.put(0, b"so far")
    if close:
        content.persist({"path": "/card/log.bin", "size": 6})
    facts = json.loads((tmp_path / "000001.json").read_text())
    assert {name: facts.get(name) for name in vehicle} == vehicle


def test_killed_between_the_name_and_the_first_byte(tmp_path: Path) -> None:
    directory, content = written(tmp_path)
    content.cut(0)
    assert rescued(directory, tmp_path) == {}
    assert not (tmp_path / "recovered").exists()


@pytest.mark.parametrize("change", [lambda content: content.put(6, b"more"), lambda content: content.cut(2)])
def test_what_could_not_be_written_down_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[SpoolContent], None]
) -> None:
    """The text still says that the vehicle has it all."""
    directory, content = written(tmp_path)
    content.mark_unneeded()

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "full")

    with monkeypatch.context() as patch:
        patch.setattr(spooling, "write_facts", full)
        with pytest.raises(NoSpace):
            change(content)
    content.put(6, b", and more")
    assert rescued(directory, tmp_path) == {"card__log.bin": b"so far, and more"}


def test_more_than_was_written_down_says_so(tmp_path: Path) -> None:
    """The description of a failed close is outdated once the program wrote more."""
    directory, content = written(tmp_path)
    content.persist({"path": "/card/log.bin", "size": 6})
    content.put(6, b"!")
    assert rescued(directory, tmp_path) == {"card__log.bin": b"so far!"}
    assert "size" not in json.loads((tmp_path / "recovered/card__log.bin.json").read_text())


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b'{"path": "/ca',
        b"[1]",
        b"null",
        b'{"path": 7}',
        b"\xff\xfe",
        b'{"path": "\\ud800"}',
        b"[" * 9999,
        b'{"path": "a\\u0000b"}',
        b'{"path": "/.."}',
        b'{"path": "/"}',
    ],
)
def test_no_text_that_is_left_behind_breaks_the_next_mount(tmp_path: Path, text: bytes) -> None:
    slot = SpoolDirectory(tmp_path / "spool")
    (slot.path / "000001.data").write_bytes(b"bytes")
    (slot.path / "000001.json").write_bytes(text)
    (slot.path / "000001.new").write_bytes(b'{"pa')
    (slot.path / "000002.json").write_bytes(b"of nothing")
    assert list(rescued(slot, tmp_path).values()) == [b"bytes"]
    assert all(path.parent == tmp_path / "recovered" for path in (tmp_path / "recovered").iterdir())


def test_one_file_that_cannot_be_moved_keeps_no_other_one_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slot = SpoolDirectory(tmp_path / "spool")
    for number in (1, 2, 3):
        (slot.path / f"00000{number}.data").write_bytes(b"%d" % number)
        (slot.path / f"00000{number}.json").write_text("{}")
    slot.close()
    really = shutil.move

    def move(source: Path, target: Path) -> object:
        if source.name == "000002.data":
            target.write_bytes(b"part of a copy")
            raise OSError(errno.ENOSPC, "full")
        return really(source, target)

    monkeypatch.setattr(shutil, "move", move)
    again = SpoolDirectory(tmp_path / "spool")
    assert [path.read_bytes() for path in again.rescue(tmp_path / "r")] == [b"1", b"3"]
    assert sorted(path.name for path in (tmp_path / "r").glob("*.data")) == ["000001.data", "000003.data"]
    content = SpoolContent(Spool(again.path))
    content.put(0, b"new")
    again.discard()
    again.close()
    third = SpoolDirectory(tmp_path / "spool")
    with pytest.raises(OSError, match="full"):
        third.rescue(tmp_path / "r")
    assert (slot.path / "000002.data").read_bytes() == b"2"
    third.close()


# --- a local disk that fails


def test_zeros_behind_a_cut_are_zeros_on_the_disk_too(tmp_path: Path) -> None:
    content = SpoolContent(Spool(tmp_path))
    content.put(0, b"x" * (PAGE + 9))
    content.cut(PAGE + 5)
    content.cut(3)
    content.persist({"size": PAGE + 9})
    assert content.get(0, 3) == b"xxx"
    (data,) = tmp_path.glob("*.data")
    assert data.read_bytes() == b"xxx".ljust(PAGE + 9, b"\0")


def failing(*_: object) -> bytes:
    raise OSError(errno.EIO, "bad sector")


def test_a_disk_that_fails_is_an_error_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spool = Spool(tmp_path)
    content = SpoolContent(spool, b"/f")
    content.put(0, b"abcdef")
    acts: dict[str, Callable[[], object]] = {
        "pread": lambda: content.get(0, 3),
        "pwrite": lambda: content.put(0, b"x"),
        "ftruncate": lambda: content.cut(2),
    }
    for name, act in acts.items():
        with monkeypatch.context() as patch:
            patch.setattr(os, name, failing)
            with pytest.raises(SpoolFailed):
                act()
    assert content.get(0, 6) == b"abcdef"
    with monkeypatch.context() as patch:
        patch.setattr(os, "pread", lambda *_: b"ab")
        with pytest.raises(SpoolFailed):
            content.get(0, 3)
    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", failing)
        content.close()
    (data,) = tmp_path.glob("*.data")
    data.unlink()
    data.with_suffix(".json").unlink()
    assert spool.held == 0
    assert list(tmp_path.iterdir()) == []


def test_a_name_that_cannot_be_written_down_is_no_space_and_nothing_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = SpoolContent(Spool(tmp_path), b"/f")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", failing)
        with pytest.raises(NoSpace):
            content.put(0, b"bytes")
    assert list(tmp_path.iterdir()) == []
