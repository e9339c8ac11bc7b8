"""Repair of the files that interruptions leave on the card, beside the programs that use its names."""

from __future__ import annotations

import errno
from contextlib import suppress
from typing import Any

import pytest
import trio

from mavftpfs.cache import looking, namespace, uploads
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.shared.errors import FileBusy, FileTooLarge, MavftpfsError, RequestTimeout
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.rigs import Rig, rig, write_file
from tests.support.transfers import content

OLD, NEW = content(3_000, 1), content(20_000, 2)
FILE, OTHER = b"/d/file", b"/d/other"
QUICK = ConnectOptions(op_deadline=5.0)


def torn(here: Rig) -> None:
    here.connection.store.traits.rename_works = True
    here.connection.store.traits.rename_replaces = False


async def write_and_lose_the_link(here: Rig, tree: Tree, *, nth: int) -> None:
    """Write the file anew; the link is cut at the nth rename of its commit, until the close failed."""
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, NEW)
    here.faults.at(Opcode.RENAME, lambda: here.faults.cut_after(0), nth=nth, drop=True)
    with pytest.raises(MavftpfsError):
        await file.release()
    here.faults.cut_after(None)


@pytest.mark.parametrize("nth", [1, 2])
async def test_a_file_taken_back_in_the_gap_gets_its_old_file_back(nth: int) -> None:
    async with rig("ardupilot5", {FILE: OLD}, options=QUICK) as here:
        torn(here)
        tree = here.mount(op_deadline=5.0)
        await tree.list(b"/d")
        file = await tree.open(FILE, write=True, truncate=True)
        await file.write(0, NEW)
        here.faults.at(Opcode.RENAME, lambda: here.faults.cut_after(0), nth=nth, drop=True)
        with suppress(MavftpfsError):
            await file.fsync()
        there = await file.take_back()
        here.faults.cut_after(None)
        await trio.sleep(300)
        await tree.list(b"/d")
        await trio.sleep(300)
        assert here.files().get(FILE) in (OLD, NEW), (there, here.files().keys())
        assert here.litter() == []


async def test_a_file_unsure_in_a_directory_that_gets_another_name_is_delivered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with rig("ardupilot5", {FILE: OLD}, options=QUICK) as here:
        torn(here)
        tree = here.mount(op_deadline=5.0)
        await tree.list(b"/d")
        deliver_below = namespace._deliver_below

        async def and_then_another_program_writes(*args: Any) -> None:
            await deliver_below(*args)
            await write_and_lose_the_link(here, tree, nth=2)

        monkeypatch.setattr(namespace, "_deliver_below", and_then_another_program_writes)
        with pytest.raises(FileBusy):
            await tree.rename(b"/d", b"/e")
        await trio.sleep(600)
        assert tree.undelivered() == [], tree.status()["errors"]
        assert here.files() == {FILE: NEW}


async def test_a_name_that_was_moved_away_does_not_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mount looks what has the name while a `mv` of it is under way."""
    async with rig("px4", {FILE: OLD}, options=QUICK, link=LinkSettings(delay=0.05)) as here:
        tree = here.mount(op_deadline=5.0)
        await write_file(tree, b"/d/first", OLD)
        await tree.list(b"/d")
        deliver_below, until_known = namespace._deliver_below, looking.until_known

        async def and_then_another_program_writes(*args: Any) -> None:
            await deliver_below(*args)
            await write_and_lose_the_link(here, tree, nth=1)
            here.faults.call_off()
            here.faults.at(Opcode.RENAME, now.set)

        now = trio.Event()

        async def look_then(*args: Any) -> None:
            await now.wait()
            await until_known(*args)

        monkeypatch.setattr(looking, "LOOK_AGAIN", 0.01)
        monkeypatch.setattr(looking, "until_known", look_then)
        monkeypatch.setattr(namespace, "_deliver_below", and_then_another_program_writes)
        moved = b"/d/moved"
        try:
            await tree.rename(FILE, moved)
        except FileBusy:
            moved = FILE
        now.set()
        await trio.sleep(600)
        assert tree.undelivered() == [], tree.status()["errors"]
        assert here.files() == {moved: NEW, b"/d/first": OLD}, here.files().keys()


async def test_no_temporary_file_stays_because_the_one_aside_could_not_be_removed() -> None:
    async with rig("ardupilot5", {FILE: OLD}, options=QUICK) as here:
        torn(here)
        here.connection.store.in_doubt = lambda since=0.0: True
        tree = here.mount(op_deadline=5.0)
        await tree.list(b"/d")
        await write_file(tree, FILE, NEW)
        assert len(here.litter()) == 1
        here.faults.at(Opcode.REMOVE_FILE, lambda: here.faults.cut_after(0), drop=True)
        with pytest.raises(MavftpfsError):
            await write_file(tree, FILE, OLD)
        here.faults.cut_after(None)
        await trio.sleep(600)
        await tree.list(b"/d")
        await trio.sleep(30)
        assert tree.undelivered() == []
        assert here.data(FILE) == OLD
        assert here.litter() == []


async def test_a_cancelled_removal_of_a_temporary_file_is_made_up_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with rig("px4", {FILE: OLD}) as here:
        tree = here.mount()
        await tree.list(b"/d")
        file = await tree.create(OTHER, exclusive=True)
        await file.write(0, NEW)
        here.faults.spoil = 1
        with trio.CancelScope() as caller:
            end = uploads.forget_attempt

            def cancelled(*args: Any) -> None:
                end(*args)
                caller.cancel()

            monkeypatch.setattr(uploads, "forget_attempt", cancelled)
            await file.fsync()
        monkeypatch.undo()
        assert await file.take_back() is False
        await trio.sleep(100)
        await tree.tidy_up()
        assert here.litter() == []


@pytest.mark.parametrize("number", [0, 1, 4])
async def test_repair_does_not_put_an_old_file_over_a_new_one(number: int) -> None:
    """A mount was killed after it had moved the old file aside; a minute later the next one gives that its
    name back, while a program makes the file anew. The name is in quarantine, so both wait."""
    async with rig("px4-nuttx", {b"/d/x": OLD}, link=LinkSettings(delay=0.1)) as here:
        tree, store = here.mount(), here.connection.store
        await write_file(tree, b"/d/first", OLD)
        here.put(b"/d/.mavftpfs-aaaaaaaoaaa-file", OLD)
        tree.forget_caches()
        await tree.list(b"/d")
        file = await tree.create(FILE, exclusive=True)
        await file.write(0, NEW)
        await trio.sleep(55.0)
        store._quarantine.on_changed(here.root + FILE, trio.current_time(), 5.0)  # repeated, after 5 s
        await trio.sleep(number * 0.5)
        told = None
        try:
            await file.release()
        except MavftpfsError as error:
            told = error
        await trio.sleep(30)
        await tree.list(b"/d")
        assert told is not None or here.data(FILE) == NEW, here.files().keys()


@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "ardupilot5", "mavsdk"])
async def test_a_directory_that_was_moved_aside_for_a_file_is_shown(profile: str) -> None:
    """A program empties a file; others make it a directory before the program closes it."""
    async with rig(profile, {FILE: OLD}) as here:
        tree = here.mount()
        await tree.list(b"/d")
        await write_file(tree, b"/d/first", OLD)
        file = await tree.open(FILE, write=True, truncate=True)
        await file.write(0, NEW)
        here.take(FILE)
        here.put_directory(FILE)
        here.put(FILE + b"/inside", b"theirs")
        with suppress(MavftpfsError):
            await file.release()
        await trio.sleep(60)
        shown = await tree.list(b"/d")
        inside = [path for path in here.files() if path.endswith(b"/inside")]
        assert len(inside) == 1
        assert inside[0].split(b"/")[2] in dict(shown)


async def test_no_error_is_shown_of_a_file_that_the_vehicle_turned_out_to_have() -> None:
    async with rig("px4", {FILE: OLD}, options=QUICK) as here:
        tree = here.mount(op_deadline=5.0)
        await write_file(tree, b"/d/first", OLD)
        file = await tree.open(FILE, write=True, truncate=True)
        await file.write(0, NEW)
        here.faults.lose_reply_to(Opcode.RENAME)
        here.faults.at(Opcode.RENAME, lambda: here.faults.cut_after(1))
        with pytest.raises(MavftpfsError):
            await file.fsync()
        here.faults.cut_after(None)
        await trio.sleep(60)
        assert here.data(FILE) == NEW
        assert tree.undelivered() == []
        assert tree.status()["errors"] == {}
        file.close()


@pytest.mark.parametrize("profile", ["px4", "mavsdk", "ardupilot5"])
async def test_what_was_taken_back_does_not_come_when_a_reader_has_it_open(profile: str) -> None:
    async with rig(profile, {FILE: OLD}, options=QUICK) as here:
        tree = here.mount(op_deadline=5.0)
        await tree.list(b"/d")
        await write_file(tree, b"/d/first", OLD)
        file = await tree.open(FILE, write=True, truncate=True)
        reader = await tree.open(FILE)
        await file.write(0, NEW)
        here.faults.at(Opcode.RENAME, lambda: here.faults.cut_after(0), drop=True)
        with suppress(MavftpfsError):
            await file.fsync()
        await file.take_back()
        here.faults.cut_after(None)
        # the user sees that it did not come, and puts something else there
        other = await tree.open(FILE, write=True, truncate=True)
        await other.write(0, b"third")
        await other.release()
        await trio.sleep(300)
        assert here.data(FILE) == b"third"
        reader.close()


@pytest.mark.parametrize("how", ["arm", "refuse"])
@pytest.mark.parametrize("profile", ["ardupilot5", "px4-nuttx"])
async def test_the_only_copy_of_the_old_file_stays_until_the_new_one_is_there(profile: str, how: str) -> None:
    """A mv over the file was interrupted in the gap; then a program writes the file anew, and that fails."""
    async with rig(profile, {FILE: OLD, OTHER: b"moved"}, options=ConnectOptions(op_deadline=5.0)) as here:
        here.connection.store.traits.rename_works = True
        if profile == "ardupilot5":
            here.connection.store.traits.rename_replaces = False
        tree = here.mount(op_deadline=5.0)
        await tree.list(b"/d")
        here.faults.at(Opcode.RENAME, lambda: here.faults.cut_after(0), nth=2, drop=True)
        with pytest.raises(RequestTimeout):
            await tree.rename(OTHER, FILE)
        assert OLD in here.files().values()
        here.faults.cut_after(None)
        here.faults.call_off()
        here.faults.refuse(Opcode.RENAME, 1, times=4)  # repair cannot give the name back just now
        await trio.sleep(3.0)
        here.faults.call_off()

        def trouble() -> None:
            if how == "arm":
                here.vehicle.arm()
            else:
                here.faults.refuse(Opcode.RENAME, 1, times=50)

        here.faults.at(Opcode.REMOVE_FILE, trouble)
        told = None
        try:
            await write_file(tree, FILE, NEW)
        except MavftpfsError as error:
            told = error
        await trio.sleep(30)
        assert {OLD, NEW} & set(here.files().values()), (told, here.files().keys())


@pytest.mark.parametrize("how", ["cut", "armed"])
async def test_a_program_removes_what_the_vehicle_never_had(how: str) -> None:
    """As rsync removes its temporary file after a failed close, on a link that comes and goes."""
    async with rig("px4", {OTHER: OLD}, options=QUICK) as here:
        tree = here.mount(op_deadline=5.0)
        await tree.list(b"/d")
        file = await tree.create(FILE, exclusive=True)
        await file.write(0, NEW)
        here.faults.at(
            Opcode.WRITE_FILE, lambda: here.faults.cut_after(0) if how == "cut" else here.vehicle.arm()
        )
        with pytest.raises(MavftpfsError):
            await file.release()
        await tree.unlink(FILE)
        assert tree.undelivered() == []
        assert [name for name, _ in await tree.list(b"/d")] == [b"other"]
        await trio.sleep(10)
        assert here.count(Opcode.REMOVE_FILE) == 0  # nothing is changed in flight
        here.faults.cut_after(None)
        here.vehicle.disarm()
        await trio.sleep(100)
        assert here.files() == {OTHER: OLD}
        assert here.litter() == []


async def leave_a_temporary_file(here: Rig, tree: Tree) -> None:
    """Have the card refuse to remove the temporary file of a failed write, so that it is tried again soon."""
    here.faults.refuse(Opcode.REMOVE_FILE, NakCode.FAIL_ERRNO, errno.EACCES, times=10)
    file = await tree.create(FILE, exclusive=True)
    await file.write(0, bytes(200_000))
    await trio.sleep(1.0)
    with pytest.raises(FileTooLarge):
        await file.write(1 << 32, b"x")
    file.close()
    await trio.sleep(1.0)
    assert here.litter()
    here.faults.call_off()


async def test_a_repair_whose_listing_became_void_is_made_up_for() -> None:
    async with rig("px4", {OTHER: OLD}) as here:
        tree = here.mount()
        await tree.list(b"/d")
        await leave_a_temporary_file(here, tree)
        here.faults.at(Opcode.LIST_DIRECTORY, tree.forget_caches)
        here.faults.at(Opcode.LIST_DIRECTORY_WITH_TIME, tree.forget_caches)
        await trio.sleep(60.0)
        assert here.files() == {OTHER: OLD}


async def test_a_repair_follows_a_directory_that_gets_another_name() -> None:
    async with rig("px4", {OTHER: OLD}) as here:
        tree = here.mount()
        await tree.list(b"/d")
        await leave_a_temporary_file(here, tree)
        await tree.rename(b"/d", b"/e")
        await trio.sleep(60.0)
        assert here.files() == {b"/e/other": OLD}


async def test_a_repair_that_takes_long_goes_by_no_old_listing(monkeypatch: pytest.MonkeyPatch) -> None:
    """While a `ls` gives a first name its old file back, a program makes the second name's file anew, and
    another `ls` lists the directory."""
    async with rig("px4", {OTHER: OLD}) as here:
        tree = here.mount()
        card: Any = tree._card
        mine = b"/d/.mavftpfs-" + card.own.owner
        here.put(mine + b"oaaa-first", OLD)
        here.put(mine + b"obbb-file", OLD)
        rename, begun, go_on = card.names.rename, trio.Event(), trio.Event()

        async def slow(old: bytes, new: bytes, **how: Any) -> None:
            if new == b"/d/first":
                begun.set()
                await go_on.wait()
            await rename(old, new, **how)

        monkeypatch.setattr(card.names, "rename", slow)
        here.nursery.start_soon(tree.list, b"/d")
        await begun.wait()
        file = await tree.create(FILE, exclusive=True)
        await file.write(0, NEW)
        here.put(mine + b"nccc", b"part")
        tree.forget_caches()
        await tree.list(b"/d")
        await file.release()
        go_on.set()
        await trio.sleep(60.0)
        assert here.files() == {OTHER: OLD, b"/d/first": OLD, FILE: NEW}
