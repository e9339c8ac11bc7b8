"""Undelivered files: the errors of programs, the times of new tries, and the files on the local disk."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import trio

from mavftpfs.cache.background import PAUSES
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.spool import SpoolContent
from mavftpfs.cache.throttle import UNMEASURED
from mavftpfs.cache.tree import Tree
from mavftpfs.mount.drain import keep_the_rest
from mavftpfs.protocol.payload import NakCode, Opcode, crc32
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    AlreadyExists,
    FileChanged,
    MavftpfsError,
    NoSpace,
    NotADirectory,
    NotDeliveredYet,
    OutcomeUnknown,
    RequestTimeout,
    SessionLost,
    SpoolFailed,
)
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.rigs import Rig, card, read_file, rig, write_file
from tests.support.transfers import content

pytestmark = pytest.mark.holds("promise 3")

OLD = bytes(range(256)) * 400
FILE, NEW = b"/d/file.txt", b"/d/new"
KIB = 1024
BIG = content(70_000)
QUICK = ConnectOptions(op_deadline=5.0)

here = card({FILE: OLD}, options=QUICK)


@pytest.fixture
async def tree(here: Rig) -> Tree:
    """A mount that has listed the directory."""
    tree = here.mount()
    await tree.list(b"/d")
    return tree


@pytest.fixture
def spool(tmp_path: Path) -> SpoolDirectory:
    return SpoolDirectory(tmp_path / "spool")


def fall_silent(here: Rig) -> None:
    """Answer nothing more, but go on to send heartbeats."""
    here.faults.cut_after(0)


def speak(here: Rig) -> None:
    """Answer again; nobody is told."""
    here.faults.cut_after(None)


async def close_in_vain(tree: Tree) -> None:
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, b"content")
    with pytest.raises(MavftpfsError):
        await file.release()


# --- what programs are told


async def test_a_checksum_is_the_vehicle_s_or_none(here: Rig, tree: Tree) -> None:
    """Never the checksum of the bytes here: a program that asks wants to know what is on the card."""
    file = await tree.open(FILE, write=True)
    await file.write(0, b"new")
    with pytest.raises(NotDeliveredYet) as caught:
        await tree.crc32(FILE)
    assert errno_for(caught.value) == errno.EAGAIN
    await file.fsync()
    assert await tree.crc32(FILE) == crc32(b"new" + OLD[3:])
    await file.release()


# --- what waits


async def test_a_lost_link_holds_writers_back_before_any_upload_began(here: Rig) -> None:
    tree = here.mount()
    file = await tree.create(NEW, exclusive=True)
    fall_silent(here)

    async def fill() -> None:
        for number in range(100):
            await file.write(number * 32 * KIB, bytes(32 * KIB))

    with pytest.raises(MavftpfsError):
        await fill()
    assert 0 < file.size <= UNMEASURED + 32 * KIB


async def test_what_can_only_go_at_the_close_holds_nobody_back(here: Rig, tree: Tree) -> None:
    """A part of a file that has to be sent whole: the local disk takes it."""
    file = await tree.open(FILE, write=True)
    before = trio.current_time()
    for at in range(0, 80 * KIB, 8 * KIB):
        await file.write(at + 1000, b"x" * 8 * KIB)
    assert trio.current_time() - before < 1
    assert here.count(Opcode.WRITE_FILE) == 0
    await file.release()
    assert here.data(FILE)[1000:1008] == b"x" * 8


# --- trying again


RENAMES = [
    ("px4", 1),
    ("mavsdk", 1),
    ("px4-nuttx", 1),
    ("px4-nuttx", 2),
    ("ardupilot5", 1),
    ("ardupilot5", 2),
]
"""Which requests give a file its name instead of an old one."""

OTHERS = OLD[::-1]
TWO = {FILE: OLD, NEW: OTHERS}
"""As large as each other; listings need not tell times."""


@asynccontextmanager
async def mounted(profile: str, files: Mapping[bytes, bytes | None]) -> AsyncIterator[tuple[Rig, Tree]]:
    """Mount a card with these files, and find out how it renames."""
    async with rig(profile, files, options=QUICK) as here:
        tree = here.mount()
        await write_file(tree, b"/d/other", b"")
        await write_file(tree, b"/d/other", b"over it")
        await tree.unlink(b"/d/other")
        yield here, tree


def silence(here: Rig, *, carried_out: bool, nth: int = 1) -> None:
    """Fall silent at a rename."""
    here.faults.at(Opcode.RENAME, lambda: fall_silent(here), nth=nth, drop=not carried_out)


async def interrupt(here: Rig, file: OpenFile, *, carried_out: bool, nth: int) -> None:
    """Deliver it, and fall silent at a rename."""
    silence(here, carried_out=carried_out, nth=nth)
    with pytest.raises(MavftpfsError):
        await file.fsync()


async def rename_unheard(here: Rig, tree: Tree, *, carried_out: bool, nth: int = 1) -> None:
    """Rename NEW over FILE, and fall silent at a rename."""
    silence(here, carried_out=carried_out, nth=nth)
    with pytest.raises(OutcomeUnknown):
        await tree.rename(NEW, FILE)
    speak(here)


@pytest.mark.parametrize("carried_out", [False, True])
@pytest.mark.parametrize(("profile", "nth"), RENAMES)
async def test_what_others_put_there_after_an_interruption_stays(
    profile: str, nth: int, carried_out: bool
) -> None:
    """A part of the old file was to stay, and that is gone."""
    async with mounted(profile, {FILE: OLD}) as (here, tree):
        file = await tree.open(FILE, write=True)
        await file.write(len(OLD), b"more")
        await interrupt(here, file, carried_out=carried_out, nth=nth)
        here.replace(FILE, b"theirs")
        speak(here)
        with pytest.raises(FileChanged):
            await file.release()
        assert here.data(FILE) == b"theirs"


@pytest.mark.parametrize("path", [FILE, NEW])
@pytest.mark.parametrize("profile", ["px4", "ardupilot5"])
async def test_what_others_put_there_before_ours_was_confirmed_stays(profile: str, path: bytes) -> None:
    """In doubt the file is compared once more under its own name, and the vehicle falls silent there."""
    async with mounted(profile, {FILE: OLD}) as (here, tree):
        here.connection.scheduler.server.distrust(reads=True)
        file = await (tree.open(path, write=True) if path == FILE else tree.create(path, exclusive=True))
        await file.write(len(OLD) if path == FILE else 0, b"more")
        sums = 2 + (path == FILE and profile == "px4")  # without times the old file is compared by one, too
        here.faults.at(Opcode.CALC_FILE_CRC32, lambda: fall_silent(here), nth=sums)
        with pytest.raises(MavftpfsError):
            await file.fsync()
        assert here.data(path).endswith(b"more"), "its name was given to it"
        here.replace(path, b"theirs")
        speak(here)
        with pytest.raises(FileChanged if path == FILE else AlreadyExists):
            await file.release()
        assert here.data(path) == b"theirs"


@pytest.mark.parametrize("carried_out", [False, True])
@pytest.mark.parametrize("path", [FILE, NEW])
@pytest.mark.parametrize(("profile", "nth"), RENAMES)
async def test_what_is_written_after_an_interruption_goes_there(
    profile: str, nth: int, path: bytes, carried_out: bool
) -> None:
    """The name may have what was sent before: that is ours, and may be replaced."""
    async with mounted(profile, {FILE: OLD}) as (here, tree):
        before = OLD if path == FILE else b""
        file = await (tree.open(path, write=True) if before else tree.create(path, exclusive=True))
        await file.write(len(before), b"more")
        await interrupt(here, file, carried_out=carried_out, nth=nth if before else 1)
        await file.write(len(before) + 4, b" and more")
        speak(here)
        await file.release()
        assert here.data(path) == before + b"more and more"
        await trio.sleep(20)
        assert here.litter() == []


@pytest.mark.parametrize("profile", ["px4-nuttx", "ardupilot5"])
async def test_an_old_file_that_is_kept_for_a_while_is_not_put_in_a_later_one_s_place(profile: str) -> None:
    """In doubt it is kept for ten seconds. Meanwhile others remove the file, and a new one is made."""
    async with rig(profile, {FILE: OLD}, options=QUICK) as here:
        tree = here.mount()
        here.connection.scheduler.server.distrust(reads=True)
        await write_file(tree, FILE, b"replaced")
        here.take(FILE)
        tree.forget_caches()
        file = await tree.create(FILE, exclusive=True)
        await file.write(0, b"a new one")
        await interrupt(here, file, carried_out=False, nth=1)
        speak(here)
        await file.release()
        assert here.data(FILE) == b"a new one"
        await trio.sleep(20)
        tree.forget_caches()
        await tree.list(b"/d")
        assert here.litter() == []


@pytest.mark.holds("promise 1")
@pytest.mark.parametrize("carried_out", [False, True])
@pytest.mark.parametrize(
    ("profile", "nth", "whole"),
    [(*each, whole) for each in RENAMES for whole in (True, False)],
)
async def test_an_append_to_a_name_of_a_rename_without_an_answer_is_refused_and_kept(
    profile: str, nth: int, whole: bool, carried_out: bool
) -> None:
    """The name may have another file now, and the handle never reads that."""
    async with mounted(profile, TWO) as (here, tree):
        file = await tree.open(FILE, write=True)
        if whole:
            await file.write(0, OLD)
        await file.write(len(OLD), b"more")
        await rename_unheard(here, tree, carried_out=carried_out, nth=nth)
        with pytest.raises(FileChanged):
            await (file.fsync() if whole else file.read(0, 1000))
        with pytest.raises(FileChanged):
            await file.release()
        await trio.sleep(10.0)
        files = here.files()
        assert files[FILE] == (OTHERS if NEW not in files else OLD)
        assert tree.undelivered() == [FILE]


@pytest.mark.parametrize("carried_out", [False, True])
async def test_a_new_content_is_not_put_over_a_file_that_got_the_name_unnoticed(carried_out: bool) -> None:
    """No byte of the old file was to stay, and the other file may be nowhere else."""
    async with mounted("px4", TWO) as (here, tree):
        file = await tree.open(FILE, write=True, truncate=True)
        await file.write(0, b"new")
        await rename_unheard(here, tree, carried_out=carried_out)
        with pytest.raises(FileChanged):
            await file.release()
        assert here.files() == ({FILE: OTHERS} if carried_out else TWO)


@pytest.mark.parametrize("data", [b"new", b""])
async def test_after_that_refusal_the_name_can_be_written_anew(data: bytes) -> None:
    """A program begins a new copy: by O_TRUNC, and through the library also by the calls that make files."""
    async with mounted("px4", TWO) as (here, tree):
        file = await tree.open(FILE, write=True, truncate=True)
        await file.write(0, data)
        await rename_unheard(here, tree, carried_out=True)
        with pytest.raises(FileChanged):
            await file.release()
        await write_file(tree, FILE, b"again")
        assert here.data(FILE) == b"again"


@pytest.mark.holds("promise 1")
async def test_who_opened_an_empty_file_does_not_write_over_what_got_its_name_unnoticed() -> None:
    async with mounted("px4", {FILE: b"", NEW: OLD}) as (here, tree):
        file = await tree.open(FILE, write=True)
        await rename_unheard(here, tree, carried_out=True)
        assert await read_file(tree, FILE) == OLD
        with pytest.raises(FileChanged):
            await file.write(0, b"more")
        await file.release()
        assert here.files() == {FILE: OLD}


@pytest.mark.holds("promise 1")
async def test_a_checksum_is_asked_for_again_after_a_rename_without_an_answer() -> None:
    """Two files may have one size and time."""
    async with mounted("mavsdk", {b"/d": None}) as (here, tree):
        here.put(FILE, OLD, 1_600_000_000)
        here.put(NEW, OTHERS, 1_600_000_000)
        tree.forget_caches()
        checksums = [await tree.crc32(path) for path in (FILE, NEW)]
        await rename_unheard(here, tree, carried_out=True)
        assert await tree.crc32(FILE) == checksums[1] != checksums[0]


async def test_it_is_tried_on_and_on_without_a_flood_of_requests(here: Rig, tree: Tree) -> None:
    asked: list[float] = []
    here.faults.at(Opcode.CREATE_FILE, lambda: asked.append(trio.current_time()), times=10_000, drop=True)
    await close_in_vain(tree)
    await trio.sleep(300)
    last_minute = [at for at in asked if at > trio.current_time() - 60]
    assert 0 < len(last_minute) < 120
    here.faults.call_off()
    await trio.sleep(2 * PAUSES[1])
    assert tree.undelivered() == []
    count = len(here.faults.requests)
    await trio.sleep(100)
    assert len(here.faults.requests) == count, "it ended"
    here.take(NEW)
    tree.forget_caches()
    await tree.list(b"/d")
    fall_silent(here)
    await close_in_vain(tree)
    speak(here)
    await trio.sleep(2 * PAUSES[0])
    assert tree.undelivered() == [], "the next one begins anew"
    assert tree._card.live == {}


@pytest.mark.parametrize("number", [errno.EACCES, errno.ENOSPC])
async def test_a_refusal_is_not_repeated_before_there_is_news(here: Rig, tree: Tree, number: int) -> None:
    here.faults.refuse(Opcode.CREATE_FILE, NakCode.FAIL_ERRNO, number, times=20)
    await close_in_vain(tree)
    count = len(here.faults.requests)
    await trio.sleep(200)
    assert len(here.faults.requests) == count
    here.faults.call_off()
    tree.link_back()
    await trio.sleep(1)
    assert tree.undelivered() == []


# --- a local disk that fails or is full


def failing(*_: object) -> bytes:
    raise OSError(errno.EIO, "bad sector")


async def begin(here: Rig, tree: Tree, data: bytes = BIG) -> OpenFile:
    """Write to a file while the vehicle says nothing."""
    file = await tree.create(NEW, exclusive=True)
    fall_silent(here)
    await file.write(0, data)
    return file


async def test_a_disk_that_fails_is_the_error_of_one_file(
    here: Rig, tree: Tree, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = await begin(here, tree)
    speak(here)
    really = os.pread

    def pread(descriptor: int, count: int, offset: int) -> bytes:
        large = os.fstat(descriptor).st_size >= len(BIG)
        return failing() if large else really(descriptor, count, offset)

    with monkeypatch.context() as patch:
        patch.setattr(os, "pread", pread)
        for act in (file.flush(), file.fsync(), file.release(), read_file(tree, NEW)):
            with pytest.raises(MavftpfsError) as told:
                await act
            assert errno_for(told.value) == errno.EIO
        await write_file(tree, b"/d/other", b"small")
        assert here.data(b"/d/other") == b"small"
        assert tree.undelivered() == [NEW]
    assert await tree.drain(100) == []
    assert here.data(NEW) == BIG


async def test_a_disk_that_fails_when_all_is_delivered_harms_nothing(
    here: Rig, tree: Tree, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last close would have kept the content as what was read; a cut changes nothing."""
    file = await begin(here, tree)
    speak(here)
    await file.fsync()
    with monkeypatch.context() as patch:
        patch.setattr(os, "ftruncate", failing)
        with pytest.raises(MavftpfsError) as told:
            await file.truncate(10)
        assert errno_for(told.value) == errno.EIO
        assert file.size == len(BIG)
        patch.setattr(os, "pread", failing)
        await file.release()
    assert await read_file(tree, NEW) == BIG


async def test_a_disk_that_fails_does_not_hide_why_the_vehicle_lacks_a_file(
    here: Rig, spool: SpoolDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = here.mount(spool=spool)
    await tree.list(b"/d")
    fall_silent(here)

    def persist(*_: object) -> None:
        raise SpoolFailed("bad sector")

    monkeypatch.setattr(SpoolContent, "persist", persist)
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, b"abc")
    with pytest.raises(RequestTimeout):
        await file.release()
    speak(here)
    assert await tree.drain(100) == []
    assert here.data(NEW) == b"abc"
    spool.close()


async def test_a_full_disk_is_told_to_the_writer_and_costs_nothing_accepted(
    here: Rig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    tree = here.mount()
    file = await begin(here, tree, BIG[:65_000])  # more than that would have the writer wait
    really = os.pwrite

    def pwrite(descriptor: int, data: bytes, offset: int) -> int:
        if offset + len(data) > 65_000:
            raise OSError(errno.ENOSPC, "full")
        return really(descriptor, data, offset)

    monkeypatch.setattr(os, "pwrite", pwrite)
    with pytest.raises(NoSpace):
        await file.write(65_000 - 10, b"more than fits")
    assert file.size == 65_000
    (copy,) = tree.recover_to(tmp_path / "kept")
    assert copy.read_bytes() == BIG[:65_000]


# --- a process that is killed


async def killed_after(here: Rig, spool: SpoolDirectory, tmp_path: Path, what: str) -> dict[str, str]:
    """Write, do something, and be killed; return what the next mount finds."""
    tree = here.mount(spool=spool)
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, BIG)
    if what == "rename":
        await tree.rename(NEW, b"/d/name", noreplace=False)
    elif what == "unlink":
        await tree.unlink(NEW)
        assert bytes(await file.read(0, len(BIG))) == BIG
    else:
        await file.fsync()
    fall_silent(here)
    if what in ("rename", "fsync and more"):
        await file.write(0, b"X")
    spool.close()
    again = SpoolDirectory(tmp_path / "spool")
    found = again.rescue(tmp_path / "recovered")
    again.close()
    assert all(path.read_bytes() == b"X" + BIG[1:] for path in found)
    return {path.name: json.loads(path.with_name(path.name + ".json").read_text())["path"] for path in found}


@pytest.mark.parametrize(
    ("what", "expected"),
    [
        ("rename", {"d__name": "/d/name"}),
        ("fsync and more", {"d__new": "/d/new"}),
        ("fsync", {}),
        ("unlink", {}),
    ],
)
async def test_what_a_killed_mount_leaves_is_what_the_vehicle_lacks(
    here: Rig, spool: SpoolDirectory, tmp_path: Path, what: str, expected: dict[str, str]
) -> None:
    assert await killed_after(here, spool, tmp_path, what) == expected


# --- what is kept at the end


async def test_one_file_that_cannot_be_read_does_not_keep_the_others_from_being_saved(
    here: Rig, spool: SpoolDirectory, tmp_path: Path
) -> None:
    tree = here.mount(spool=spool)
    await tree.list(b"/d")
    fall_silent(here)
    for name in (b"/d/a", b"/d/b"):
        with pytest.raises(RequestTimeout):
            await write_file(tree, name, name * 100)
    os.truncate(min(spool.path.glob("*.data")), 10)
    message = keep_the_rest(tree, tmp_path / "kept")
    assert f"2 files did not reach the vehicle; only 1 could be kept, in {tmp_path / 'kept'}" in message
    assert (tmp_path / "kept/d__b").read_bytes() == b"/d/b" * 100
    assert json.loads((tmp_path / "kept/d__b.json").read_text())["path"] == "/d/b"
    assert tree.undelivered() == [b"/d/a"], "it stays in the spool"
    assert len(list(spool.path.glob("*.data"))) == 1
    spool.close()


async def test_an_upload_that_is_under_way_sends_nothing_of_a_file_that_was_saved(
    spool: SpoolDirectory, tmp_path: Path
) -> None:
    """A second signal ends the last delivery; the task that sends runs on until the link is closed."""
    async with rig("px4", {FILE: OLD}, link=LinkSettings(rate=20_000.0, delay=0.01)) as here:
        tree = here.mount(spool=spool)
        with trio.move_on_after(3.0):
            await write_file(tree, NEW, content(200_000))
        assert "1 file did not reach the vehicle" in keep_the_rest(tree, tmp_path / "kept")
        await trio.sleep(30.0)
        assert NEW[3:] not in [entry.name for entry in here.card.entries(b"/d")]
        spool.close()


async def test_a_changed_file_is_made_whole_while_its_program_pauses(
    here: Rig, tree: Tree, tmp_path: Path
) -> None:
    """The vehicle is gone before the program closes the file: what is kept is a file, not a part of one."""
    file = await tree.open(FILE, write=True)
    await file.write(0, b"new")
    await trio.sleep(30.0)
    fall_silent(here)
    with pytest.raises(RequestTimeout):
        await file.release()
    (copy,) = tree.recover_to(tmp_path / "kept")
    assert copy.read_bytes() == b"new" + OLD[3:]
    assert json.loads(copy.with_name(copy.name + ".json").read_text())["whole"]


async def test_a_program_that_overwrites_every_byte_makes_nothing_be_fetched(here: Rig, tree: Tree) -> None:
    """As rsync --inplace does."""
    file = await tree.open(FILE, write=True)
    for at in range(0, len(OLD), 10_000):
        await file.write(at, OLD[::-1][at : at + 10_000])
        await trio.sleep(0.1)
    await file.release()
    assert here.data(FILE) == OLD[::-1]
    assert here.count(Opcode.READ_FILE, Opcode.BURST_READ_FILE) == 0


@pytest.mark.parametrize("truncate", [True, False])
@pytest.mark.parametrize("asked", [b"/d/file.txt", b"/d/file.txt/below"])
async def test_a_directory_that_others_put_in_the_place_of_a_file_that_is_written(
    here: Rig, tree: Tree, truncate: bool, asked: bytes
) -> None:
    """A program that looks into it is told that it is a file, and takes nothing from the one that writes."""
    file = await tree.open(FILE, write=True, truncate=truncate)
    await file.write(0, BIG)
    here.take(FILE)
    here.put_directory(FILE)
    tree.forget_caches()
    with pytest.raises(NotADirectory):
        await tree.list(asked)
    if truncate:
        await file.release()
        assert here.data(FILE) == BIG
    else:
        with pytest.raises(FileChanged):
            await file.release()
        assert tree.undelivered() == [FILE]


@pytest.mark.parametrize(
    ("profile", "codes"), [("px4", (NakCode.FAIL_ERRNO, 9)), ("ardupilot", (NakCode.FILE_NOT_FOUND,))]
)
async def test_a_session_that_is_lost_for_long_is_no_refusal(profile: str, codes: tuple[int, ...]) -> None:
    here = Rig(profile, {b"/d": None})
    async with here.mounted() as tree:
        here.faults.refuse(Opcode.WRITE_FILE, *codes, times=100_000)
        with pytest.raises(SessionLost):
            await write_file(tree, b"/d/file", b"whole")
        here.faults.call_off()
        await trio.sleep(60)
        assert here.data(b"/d/file") == b"whole"
