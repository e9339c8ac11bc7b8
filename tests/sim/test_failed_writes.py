"""A write that failed breaks its file: the name keeps what the card has, and nothing of the part comes."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Awaitable, Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.session.scheduler import SessionUser
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    Armed,
    CrossDevice,
    FileTooLarge,
    MavftpfsError,
    NoSpace,
    NotFound,
    WriteFailed,
)
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.rigs import KINDS, Rig, card, open_to_copy, read_file, rig, write_file
from tests.support.transfers import content

pytestmark = pytest.mark.holds("promise 3")

OLD, PART = content(3_000, 1), content(100_000, 2)
FILE, FRESH = b"/d/file", b"/d/fresh"
DEADLINE = 5.0
LONG = 300.0
"""Seconds after which everything that is tried by itself was tried."""
BEYOND = 1 << 32
"""An offset that no vehicle takes."""

here = card({FILE: OLD}, options=ConnectOptions(op_deadline=DEADLINE))
each = card({FILE: OLD}, profiles=KINDS, options=ConnectOptions(op_deadline=DEADLINE))


async def mount(here: Rig, spool: SpoolDirectory | None = None) -> Tree:
    tree = here.mount(op_deadline=DEADLINE, spool=spool)
    await tree.list(b"/d")
    return tree


async def part_of(tree: Tree, path: bytes) -> OpenFile:
    """Write a part of a file, until some of it is on its way to the card."""
    file = await open_to_copy(tree, path)
    await file.write(0, PART)
    await trio.sleep(1.0)
    return file


async def write_on(file: OpenFile) -> None:
    for at in range(len(PART), 10_000_000, len(PART)):
        await file.write(at, PART)


async def break_it(tree: Tree, path: bytes) -> OpenFile:
    file = await part_of(tree, path)
    with pytest.raises(FileTooLarge):
        await file.write(BEYOND, b"x")
    return file


# --- what makes a write fail, and how that ends


async def cut(here: Rig, patch: pytest.MonkeyPatch) -> None:
    here.link.cut()


async def fall_silent(here: Rig, patch: pytest.MonkeyPatch) -> None:
    """Answer nothing more, but go on to send heartbeats."""
    here.faults.cut_after(0)


async def arm(here: Rig, patch: pytest.MonkeyPatch) -> None:
    await here.arm()


async def fill_the_card(here: Rig, patch: pytest.MonkeyPatch) -> None:
    here.faults.refuse(Opcode.WRITE_FILE, NakCode.FAIL_ERRNO, errno.ENOSPC, times=10_000)


def failing_disk(number: int) -> Callable[[Rig, pytest.MonkeyPatch], Awaitable[None]]:
    async def fail(here: Rig, patch: pytest.MonkeyPatch) -> None:
        def pwrite(*_: object) -> int:
            raise OSError(number, os.strerror(number))

        patch.setattr(os, "pwrite", pwrite)

    return fail


CAUSES = {
    "cut": (cut, errno.ETIMEDOUT),
    "silent": (fall_silent, errno.ETIMEDOUT),
    "armed": (arm, errno.EROFS),
    "full card": (fill_the_card, errno.ENOSPC),
    "full disk": (failing_disk(errno.ENOSPC), errno.ENOSPC),
    "bad disk": (failing_disk(errno.EIO), errno.EIO),
}


async def all_is_well(here: Rig, patch: pytest.MonkeyPatch) -> None:
    """End what made a write fail, and wait until everything was tried."""
    patch.undo()
    here.link.restore()
    here.faults.cut_after(None)
    here.faults.call_off()
    here.vehicle.disarm()
    await trio.sleep(LONG)


# --- what comes of it


@pytest.mark.parametrize("cause", CAUSES)
@pytest.mark.parametrize("path", [FILE, FRESH])
async def test_nothing_of_the_part_reaches_the_card(
    each: Rig, path: bytes, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = await mount(each)
    file = await part_of(tree, path)
    begin, number = CAUSES[cause]
    await begin(each, monkeypatch)
    with pytest.raises(MavftpfsError) as told:
        await write_on(file)
    # A card that cannot rename refuses to replace a file before it can be full.
    assert errno_for(told.value) in (number, *(() if each.renames else (errno.EOPNOTSUPP,)))
    for act in (file.write(0, b"x"), file.truncate(0), file.flush(), file.fsync(), file.release()):
        with pytest.raises(WriteFailed):
            await act
    await all_is_well(each, monkeypatch)
    assert each.files() == {FILE: OLD}, "no part, and no temporary file"
    assert {name: stat.size for name, stat in await tree.list(b"/d")} == {b"file": len(OLD)}
    assert await read_file(tree, FILE) == OLD
    assert (tree.undelivered(), tree.broken()) == ([], [path])
    if each.renames or path == FRESH:  # else nothing can be replaced
        await write_file(tree, path, b"again")
        assert each.data(path) == b"again"
        assert tree.broken() == []


@pytest.mark.parametrize("path", [FILE, FRESH])
async def test_the_name_is_free_for_the_next_program_at_once(each: Rig, path: bytes) -> None:
    """A program with the old file open still reads the changes; a program that opens the name gets the card's
    file."""
    tree = await mount(each)
    file = await break_it(tree, path)
    assert bytes(await file.read(0, len(PART))) == PART
    if path == FRESH:
        if each.renames:  # else a part of it is there, and is removed before the next file is made
            with pytest.raises(NotFound):
                await tree.stat(path)
        await write_file(tree, path, b"again")
        assert each.data(path) == b"again"
    else:
        assert await read_file(tree, path) == OLD
        await tree.rename(path, b"/d/other") if each.renames else await tree.unlink(path)
    assert bytes(await file.read(0, len(PART))) == PART
    with pytest.raises(WriteFailed):
        await file.release()
    assert tree.status()["bytes_held"] == 0


async def test_what_a_failed_write_left_in_place_is_not_being_written_by_others() -> None:
    """Listings saw it grow. (The card cannot rename, and the old file was emptied.)"""
    async with rig("littlefs", {FILE: OLD}, link=LinkSettings(rate=20_000.0)) as here:
        tree = here.mount(inplace=True, dir_timeout=0.0)
        file = await part_of(tree, FILE)
        for _ in range(3):
            await trio.sleep(1.0)
            await tree.list(b"/d")
        with pytest.raises(FileTooLarge):
            await file.write(BEYOND, b"x")
        await trio.sleep(1.0)
        assert (await tree.stat(FILE)).size == len(here.data(FILE)) > 0
        await write_file(tree, FILE, b"again")
        assert here.data(FILE) == b"again"
        file.close()


@pytest.mark.parametrize("begun", [True, False])
async def test_an_old_file_that_a_write_in_place_did_not_reach_is_not_being_written_by_others(
    begun: bool,
) -> None:
    """CreateFile did not arrive, or was not sent because the session was busy. The old file is the larger."""
    async with rig("littlefs", {FILE: 3 * PART}, options=ConnectOptions(op_deadline=DEADLINE)) as here:
        tree = here.mount(inplace=True, op_deadline=DEADLINE)
        await write_file(tree, FRESH, PART)
        file = await open_to_copy(tree, FILE)

        async def keep_the_session(*, task_status: Any) -> None:
            async with here.connection.store._scheduler.turn(SessionUser(FRESH)):
                task_status.started()
                await trio.sleep_forever()

        async with trio.open_nursery() as nursery:
            if begun:
                here.faults.ignore(Opcode.CREATE_FILE)
            else:
                await nursery.start(keep_the_session)
            await file.write(0, PART)
            with pytest.raises(MavftpfsError):
                await file.fsync(ends_write=True)
            nursery.cancel_scope.cancel()
        file.close()
        here.faults.call_off()
        assert await read_file(tree, FILE) == 3 * PART
        await write_file(tree, FILE, PART)
        assert here.data(FILE) == PART


async def test_a_handle_that_wrote_nothing_breaks_nothing(here: Rig) -> None:
    """Bytes that other programs wrote with success are delivered."""
    tree = await mount(here)
    file = await part_of(tree, FRESH)
    appender = await tree.open(FRESH, write=True)
    with pytest.raises(FileTooLarge):
        await appender.write(BEYOND, b"x")
    await here.arm()
    for act in (appender.write(0, b"x"), appender.release(), file.release()):
        with pytest.raises(Armed):
            await act
    await here.disarm()
    await trio.sleep(60.0)
    assert here.data(FRESH) == PART


@pytest.mark.parametrize(
    "change",
    [lambda file: file.write(0, b"new"), lambda file: file.truncate(len(OLD) + 1)],
    ids=["write", "truncate"],
)
@pytest.mark.parametrize("profile", ["px4", "ardupilot5"])
async def test_a_first_change_for_which_there_is_no_room_leaves_a_file_that_is_read_as_before(
    profile: str, change: Callable[[OpenFile], Awaitable[Any]]
) -> None:
    """Whoever opens the file later gets the one that others put there since."""
    async with rig(profile, {FILE: OLD}) as here:
        tree = await mount(here)
        assert await read_file(tree, FILE) == OLD
        file = await tree.open(FILE, write=True)
        tree._card.spool.spool_max = 0
        with pytest.raises(NoSpace):
            await change(file)
        assert not list(tree.undelivered())
        here.replace(FILE, OLD[::-1], 1_700_000_000)
        await trio.sleep(60.0)
        assert await read_file(tree, FILE) == OLD[::-1]
        file.close()


async def test_a_new_file_of_which_the_first_write_failed_gets_no_name(here: Rig) -> None:
    tree = await mount(here)
    file = await tree.create(FRESH, exclusive=True)
    await here.arm()
    with pytest.raises(Armed):
        await file.write(0, PART)
    with pytest.raises(WriteFailed):
        await file.release()
    await here.disarm()
    await trio.sleep(LONG)
    assert here.files() == {FILE: OLD}


async def test_what_a_program_was_writing_when_the_mount_went_away_gets_no_name(here: Rig) -> None:
    tree = await mount(here)
    await part_of(tree, FILE)
    whole = await tree.create(FRESH, exclusive=True)
    await whole.write(0, PART)
    await here.lose()
    with pytest.raises(MavftpfsError):
        await whole.flush()
    await here.find()
    await tree.break_unfinished()
    assert await tree.drain(60.0) == []
    await tree.tidy_up()
    assert tree.broken() == [FILE]
    assert here.files() == {FILE: OLD, FRESH: PART}


async def test_what_is_written_after_a_refused_fsync_gets_no_name_when_the_mount_goes_away(here: Rig) -> None:
    tree = await mount(here)
    file = await part_of(tree, FILE)
    here.faults.refuse(Opcode.RENAME, NakCode.FAIL_ERRNO, errno.ENOSPC)
    with pytest.raises(MavftpfsError):
        await file.fsync()
    await file.write(len(PART), PART)
    await tree.break_unfinished()
    assert await tree.drain(60.0) == []
    assert tree.broken() == [FILE]
    assert here.files() == {FILE: OLD}


async def test_a_new_file_that_is_too_large_at_once_can_be_written_smaller(here: Rig) -> None:
    tree = await mount(here)
    file = await tree.create(FRESH, exclusive=True)
    with pytest.raises(FileTooLarge):
        await file.write(BEYOND, b"x")
    await file.write(0, PART)
    await file.release()
    assert here.data(FRESH) == PART


@pytest.mark.parametrize("closed", [False, True])
async def test_a_file_that_one_of_two_handles_broke_is_broken_for_both(here: Rig, closed: bool) -> None:
    tree = await mount(here)
    first, second = await part_of(tree, FILE), await tree.open(FILE, write=True)
    await second.write(len(PART), b"more")
    with pytest.raises(FileTooLarge):
        await second.write(BEYOND, b"x")
    if closed:
        second.close()
    for act in (first.write(0, b"x"), first.truncate(0), first.flush(), first.release()):
        with pytest.raises(WriteFailed):
            await act
    await trio.sleep(LONG)
    assert here.files() == {FILE: OLD}


async def test_what_was_delivered_before_stays(here: Rig) -> None:
    tree = await mount(here)
    file = await part_of(tree, FILE)
    await file.fsync()
    with pytest.raises(FileTooLarge):
        await file.write(BEYOND, b"x")
    await file.write(0, b"X")
    await file.release()
    assert here.data(FILE) == b"X" + PART[1:]


async def test_a_close_that_failed_breaks_nothing(here: Rig) -> None:
    """All writes were taken, so the file is whole."""
    tree = await mount(here)
    file = await part_of(tree, FILE)
    await here.lose()
    for act in (file.fsync(), file.flush(), file.release()):
        with pytest.raises(MavftpfsError):
            await act
    await here.find()
    await trio.sleep(60.0)
    assert here.data(FILE) == PART


async def test_an_fsync_that_ends_a_write_is_a_part_of_it(here: Rig) -> None:
    tree = await mount(here)
    file = await part_of(tree, FILE)
    await here.arm()
    with pytest.raises(Armed):
        await file.fsync(ends_write=True)
    await here.disarm()
    with pytest.raises(WriteFailed):
        await file.release()
    await trio.sleep(LONG)
    assert here.files() == {FILE: OLD}


@pytest.mark.parametrize("armed", [False, True])
async def test_an_append_whose_close_cannot_fetch_the_old_file(here: Rig, armed: bool) -> None:
    """There is no whole file that could be delivered later. In flight nothing is fetched: that waits."""
    tree = await mount(here)
    file = await tree.open(FILE, write=True)
    await file.write(len(OLD), b"more")
    await (here.arm() if armed else here.lose())
    with pytest.raises(Armed if armed else MavftpfsError):
        await file.flush()
    with pytest.raises(Armed if armed else WriteFailed):
        await file.release()
    await (here.disarm() if armed else here.find())
    await trio.sleep(LONG)
    assert here.files() == {FILE: OLD + b"more" if armed else OLD}
    assert tree.broken() == ([] if armed else [FILE])
    reader = await tree.open(FILE)
    with nullcontext() if armed else pytest.raises(WriteFailed):
        await reader.fsync()  # as `sync FILE` does
    await write_file(tree, FILE, b"again")
    await reader.fsync()


async def test_a_new_file_whose_first_write_fails_leaves_nothing(here: Rig) -> None:
    tree = await mount(here)
    file = await tree.create(FRESH, exclusive=True)
    await here.arm()
    with pytest.raises(Armed):
        await file.write(0, b"x")
    with pytest.raises(WriteFailed):
        await file.release()
    await here.disarm()
    await trio.sleep(LONG)
    assert here.files() == {FILE: OLD}
    assert tree.broken() == []


async def test_a_program_that_is_killed_leaves_its_part_as_on_a_local_disk(here: Rig) -> None:
    """No write of it was answered with an error."""
    tree = await mount(here)
    file = await part_of(tree, FILE)
    here.link.cut()
    with trio.move_on_after(3.0):
        await write_on(file)
    here.link.restore()
    await file.release()
    assert here.data(FILE)[: len(PART)] == PART


async def test_truncating_by_name_is_undone_and_leaves_nothing(here: Rig) -> None:
    tree = await mount(here)
    here.faults.ignore(Opcode.READ_FILE)
    with pytest.raises(MavftpfsError):
        await tree.truncate(FILE, 2_000)
    here.faults.call_off()
    assert (tree.undelivered(), tree.broken()) == ([], [])
    assert here.files() == {FILE: OLD}


async def test_a_truncation_by_name_that_is_interrupted_leaves_nothing(here: Rig) -> None:
    tree = await mount(here)
    here.faults.cut_after(6)
    with trio.move_on_after(2.0) as scope:
        await tree.truncate(FILE, 2_000)
    assert scope.cancelled_caught
    here.faults.cut_after(None)
    await trio.sleep(300)
    assert (tree.undelivered(), tree.broken()) == ([], [])
    assert here.files() == {FILE: OLD}


@pytest.mark.parametrize("path", [FILE, FRESH])
async def test_what_is_taken_back_leaves_nothing_here_either(each: Rig, path: bytes) -> None:
    """As `put` and the library do: what they sent is still where it came from."""
    tree = await mount(each)
    file = await break_it(tree, path)
    assert await file.take_back() is False
    assert (tree.broken(), tree.status()["bytes_held"]) == ([], 0)
    await tree.tidy_up()
    assert each.files() == {FILE: OLD}


# --- what is kept


@pytest.fixture
def spool(tmp_path: Path) -> SpoolDirectory:
    return SpoolDirectory(tmp_path / "spool")


def told(copies: list[Path]) -> dict[str, tuple[bytes, str]]:
    """Return what is kept, and why, by its path on the vehicle."""
    found = {}
    for copy in copies:
        facts = json.loads(copy.with_name(copy.name + ".json").read_text())
        assert facts["broken"]
        found[facts["path"]] = (copy.read_bytes(), facts["error"])
    return found


async def test_the_last_part_is_kept(here: Rig, spool: SpoolDirectory, tmp_path: Path) -> None:
    tree = await mount(here, spool)
    for data in (b"first", b"second"):
        file = await open_to_copy(tree, FRESH)
        await file.write(0, data)
        with pytest.raises(FileTooLarge):
            await file.write(BEYOND, b"x")
        with pytest.raises(WriteFailed):
            await file.release()
    ((path, (data, error)),) = told(list(tree.recover_to(tmp_path / "kept"))).items()
    assert (path, data) == (FRESH.decode(), b"second")
    assert str(BEYOND - 1) in error
    assert tree.broken() == []
    spool.close()


async def append(tree: Tree, path: bytes) -> None:
    file = await tree.open(path, write=True)
    await file.write(len(OLD), b"more")
    await file.release()


Forgetting = Callable[[Tree], Awaitable[object]]
FORGETTING: dict[str, Forgetting] = {
    "delivered": lambda tree: append(tree, FILE),
    "removed": lambda tree: tree.unlink(FILE),
    "moved away": lambda tree: tree.rename(FILE, b"/d/other"),
    "moved over": lambda tree: tree.rename(b"/d/good", FILE),
    "emptied": lambda tree: tree.open(FILE, write=True, truncate=True),
}


@pytest.mark.parametrize("forget", FORGETTING)
@pytest.mark.parametrize("is_open", [False, True])
async def test_a_part_is_kept_until_the_name_has_a_good_file_or_none(
    here: Rig, spool: SpoolDirectory, tmp_path: Path, forget: str, is_open: bool
) -> None:
    tree = await mount(here, spool)
    await write_file(tree, b"/d/good", b"good")
    file = await break_it(tree, FILE)
    if not is_open:
        file.close()
    await FORGETTING[forget](tree)
    assert tree.broken() == []
    if is_open:
        assert bytes(await file.read(0, len(PART))) == PART
        with pytest.raises(WriteFailed):
            await file.release()
    spool.close()
    again = SpoolDirectory(tmp_path / "spool")
    assert again.rescue(tmp_path / "kept") == [], "nor does the next mount find it after a kill"
    again.close()


async def test_a_new_name_that_never_was_on_the_card_is_removed_too(here: Rig) -> None:
    tree = await mount(here)
    (await break_it(tree, FRESH)).close()
    with pytest.raises(NotFound):
        await tree.unlink(FRESH)
    assert tree.broken() == []


async def test_after_a_kill_the_next_mount_offers_the_part_and_puts_nothing_back(
    here: Rig, spool: SpoolDirectory, tmp_path: Path
) -> None:
    tree = await mount(here, spool)
    file = await part_of(tree, FILE)
    await here.lose()
    with pytest.raises(MavftpfsError):
        await write_on(file)
    await here.find()
    spool.close()
    again = SpoolDirectory(tmp_path / "spool")
    ((path, (data, _)),) = told(again.rescue(tmp_path / "kept")).items()
    assert path == FILE.decode()
    assert data[: len(PART)] == PART
    tree = await mount(here, again)
    await trio.sleep(LONG)
    assert here.files() == {FILE: OLD}
    again.close()


async def test_a_part_gives_its_room_to_other_files(here: Rig) -> None:
    tree = here.mount(op_deadline=DEADLINE)
    tree._card.spool.spool_max = 150_000
    file = await part_of(tree, FRESH)
    with pytest.raises(MavftpfsError) as told:
        await write_on(file)
    assert errno_for(told.value) == errno.ENOSPC
    await write_file(tree, FILE, PART)
    assert here.data(FILE) == PART
    assert tree.broken() == []
    with pytest.raises(MavftpfsError):
        await file.write(0, b"x")


async def test_the_oldest_parts_go_when_there_are_too_many(here: Rig) -> None:
    tree = here.mount(op_deadline=DEADLINE)
    tree._card.spool.spool_max = 250_000
    names = [b"/d/a", b"/d/b", b"/d/c"]
    for name in names:
        (await break_it(tree, name)).close()
    assert tree.broken() == names[1:]


# --- what people are told


async def test_an_error_is_not_shown_once_its_cause_is_over() -> None:
    """The change that was refused in flight is sent after disarming."""
    async with rig("px4", {FILE: OLD}) as here:
        tree = here.mount()
        file = await tree.create(FRESH, exclusive=True)
        await file.write(0, PART)
        await here.arm()
        with pytest.raises(Armed):
            await file.release()
        assert "armed" in str(tree.status()["errors"])
        shown: list[object] = []
        here.faults.at(Opcode.WRITE_FILE, lambda: shown.append(tree.status()["errors"]), nth=100)
        await here.disarm()
        await trio.sleep(60.0)
        assert here.data(FRESH) == PART
        assert shown == [{}]


async def test_status_and_log_name_what_failed(here: Rig, caplog: pytest.LogCaptureFixture) -> None:
    tree = await mount(here)
    await break_it(tree, FILE)
    assert list(tree.status()["broken"]) == ["/d/file"]  # type: ignore[call-overload]
    assert tree.status()["files_undelivered"] == 0
    (record,) = [record for record in caplog.records if record.levelname == "WARNING"]
    assert "/d/file" in record.getMessage()


@pytest.mark.parametrize("carried_out", [False, True])
@pytest.mark.parametrize(
    ("profile", "nth"), [("px4", 1), ("px4-nuttx", 1), ("px4-nuttx", 2), ("ardupilot5", 2)]
)
async def test_a_file_that_breaks_while_its_replacement_is_unfinished(
    profile: str, nth: int, carried_out: bool
) -> None:
    """The name has the old file, or the whole one that an fsync was placing."""
    async with rig(profile, {FILE: OLD}, options=ConnectOptions(op_deadline=DEADLINE)) as here:
        tree = await mount(here)
        await write_file(tree, b"/d/other", b"shows how this card renames")
        await write_file(tree, b"/d/other", b"and replaces")
        await tree.unlink(b"/d/other")
        file = await part_of(tree, FILE)
        here.faults.at(Opcode.RENAME, lambda: here.faults.cut_after(0), nth=nth, drop=not carried_out)
        with pytest.raises(MavftpfsError):
            await file.fsync()
        await file.write(len(PART), b"more")
        with pytest.raises(FileTooLarge):
            await file.write(BEYOND, b"x")
        file.close()
        here.faults.cut_after(None)
        await trio.sleep(LONG)
        await tree.list(b"/d")
        assert here.files() in ({FILE: OLD}, {FILE: PART})
        assert tree.broken() == [FILE]


@pytest.mark.parametrize("theirs", [content(1_500, 9), content(200_000, 9)], ids=["small", "large"])
async def test_the_file_of_others_under_the_name_of_a_part_stays(theirs: bytes) -> None:
    """A card that cannot rename has the part under the file's own name, where others may put their file."""
    async with rig("littlefs", {FILE: OLD}, options=ConnectOptions(op_deadline=DEADLINE)) as here:
        tree = await mount(here)
        with pytest.raises(CrossDevice):
            await tree.rename(FILE, b"/d/moved")
        file = await part_of(tree, FRESH)
        here.link.cut()
        with pytest.raises(MavftpfsError):
            await write_on(file)
        here.replace(FRESH, theirs)
        here.link.restore()
        await trio.sleep(LONG)
        assert here.data(FRESH) == theirs
        file.close()


async def test_the_close_of_another_program_does_not_send_an_emptied_file(here: Rig) -> None:
    """Until the program that emptied the file has written, the card keeps a whole file."""
    tree = await mount(here)
    first = await open_to_copy(tree, FILE)
    await first.write(0, PART)
    async with trio.open_nursery() as nursery:
        nursery.start_soon(first.release)
        await trio.sleep(0.02)
        second = await tree.open(FILE, write=True, truncate=True)
        await trio.sleep(LONG)
        assert here.files()[FILE] in (OLD, PART)
        await second.write(0, OLD[::-1])
        await second.release()
    assert here.files() == {FILE: OLD[::-1]}


async def test_the_error_of_an_earlier_copy_does_not_send_an_emptied_file(here: Rig) -> None:
    """A shell empties the file and closes a copy of the descriptor before it writes."""
    tree = await mount(here)
    first = await open_to_copy(tree, FILE)
    await first.write(0, PART)
    here.faults.refuse(Opcode.WRITE_FILE, NakCode.FAIL_ERRNO, errno.ENOSPC, times=1)
    with pytest.raises(MavftpfsError):
        await first.flush()
    first.close()
    second = await tree.open(FILE, write=True, truncate=True)
    await second.flush()
    assert here.files() == {FILE: OLD}
    second.close()
