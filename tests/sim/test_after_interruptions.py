"""What programs do with a name beside, or after, an interrupted change of it."""

from __future__ import annotations

from itertools import count

import pytest
import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import FileChanged, NoSpace, RequestTimeout
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.faults import STATION
from tests.support.replies import request
from tests.support.rigs import Rig, open_to_copy, read_file, rig, write_file

FAT = "ardupilot5"
OLD, NEW = b"old" * 10, b"new!" * 20

pytestmark = pytest.mark.holds("promise 3")


async def learn(here: Rig) -> Tree:
    """Mount, and learn how the card renames, so that each copy over a file takes three requests."""
    tree = here.mount()
    await tree.list(b"/")
    for data in (b"1", b"2"):
        await write_file(tree, b"/learnt", data)
    await trio.sleep(20.0)
    return tree


async def lose(here: Rig, tree: Tree, path: bytes, data: bytes, *, drop: bool = False) -> None:
    """Copy a file; the vehicle falls silent at the first rename, which is not executed if it is dropped."""
    here.faults.at(Opcode.RENAME, lambda: here.faults.cut_after(0), drop=drop)
    with pytest.raises(RequestTimeout):
        await write_file(tree, path, data)


@pytest.mark.parametrize("delay", [0.45, 0.5, 0.55])
async def test_a_repair_beside_the_removal_of_what_it_was_about_to_repair(delay: float) -> None:
    """The removal of two old files was refused; a program removes one while the other one is repaired."""
    async with rig(FAT, {b"/a": OLD, b"/b": OLD}, link=LinkSettings(delay=0.05)) as here:
        tree = here.mount()
        await tree.list(b"/")
        await write_file(tree, b"/a", b"first")
        here.faults.refuse(Opcode.REMOVE_FILE, NakCode.FAIL, times=2)
        async with trio.open_nursery() as nursery:
            for path in (b"/a", b"/b"):
                nursery.start_soon(write_file, tree, path, NEW)
        here.faults.at(Opcode.REMOVE_FILE, lambda: None, drop=True)
        await trio.sleep(delay)
        await tree.unlink(b"/b")
        await trio.sleep(30.0)
        assert here.files() == {b"/a": NEW}


@pytest.mark.parametrize("what", ["cp", "new name"])
async def test_a_copy_to_a_name_whose_old_file_another_mount_left_aside(what: str) -> None:
    """Its mount was killed. The copy is still under way when the old file would get its name back."""
    async with rig(FAT, {b"/.mavftpfs-aaaaaaaoabc-file": OLD}) as here:
        tree = here.mount()
        await tree.list(b"/")
        await trio.sleep(40.0)
        file = await open_to_copy(tree, b"/file")
        for piece in range(30):
            await file.write(piece * 1000, bytes(1000))
            await trio.sleep(1.0)
        await file.release()
        if what == "cp":
            await write_file(tree, b"/file", NEW)
        await trio.sleep(700.0)
        assert here.files() == {b"/file": NEW if what == "cp" else bytes(30_000)}


async def test_another_clients_file_is_not_replaced_after_a_commit_that_was_interrupted() -> None:
    """The program goes on to write the file of which its fsync failed, though the vehicle has it."""
    async with rig("px4", {b"/learnt": OLD}) as here:
        tree = here.mount()
        await write_file(tree, b"/learnt", NEW)
        file = await tree.create(b"/file", exclusive=True)
        await file.write(0, b"one")
        here.faults.at(Opcode.RENAME, lambda: here.faults.cut_after(0))
        with pytest.raises(RequestTimeout):
            await file.fsync()
        await file.write(3, b" two")
        here.faults.cut_after(None)
        await trio.sleep(20.0)
        here.replace(b"/file", b"somebody else's")
        await trio.sleep(20.0)
        with pytest.raises(FileChanged):
            await file.release()
        assert here.files()[b"/file"] == b"somebody else's"


async def test_a_vehicle_without_checksums_tells_by_a_listing_what_was_committed() -> None:
    async with rig("px4", {b"/file": OLD}) as here:
        tree = here.mount()
        here.faults.refuse(Opcode.CALC_FILE_CRC32, NakCode.UNKNOWN_COMMAND, times=10**9)
        await write_file(tree, b"/learnt", b"1")
        await lose(here, tree, b"/file", NEW)
        here.faults.cut_after(None)
        await trio.sleep(20.0)
        assert tree.undelivered() == []
        await tree.unlink(b"/file")
        assert sorted(here.files()) == [b"/learnt"]


async def test_a_vehicle_without_checksums_gets_what_was_not_committed_again() -> None:
    async with rig("px4", {b"/file": OLD}) as here:
        tree = here.mount()
        here.faults.refuse(Opcode.CALC_FILE_CRC32, NakCode.UNKNOWN_COMMAND, times=10**9)
        await write_file(tree, b"/learnt", b"1")
        await lose(here, tree, b"/file", OLD[::-1], drop=True)
        here.faults.cut_after(None)
        await trio.sleep(60.0)
        assert here.files() == {b"/file": OLD[::-1], b"/learnt": b"1"}


async def test_the_part_of_a_failed_write_goes_with_its_directory() -> None:
    async with rig(FAT, {b"/d/other": OLD}) as here:
        tree = here.mount()
        await tree.list(b"/d")
        file = await tree.create(b"/d/file", exclusive=True)
        await file.write(0, bytes(200_000))
        await trio.sleep(1.0)
        tree._card.spool.spool_max = 200_001
        with pytest.raises(NoSpace):
            await file.write(200_000, b"more")
        assert here.litter()
        await tree.rename(b"/d", b"/e")
        file.close()
        await trio.sleep(60.0)
        assert here.files() == {b"/e/other": OLD}


async def test_a_rename_over_a_file_whose_old_file_is_aside() -> None:
    async with rig(FAT, {b"/file": OLD, b"/other": b"other"}) as here:
        tree = await learn(here)
        await lose(here, tree, b"/file", NEW)
        here.faults.cut_after(None)
        await tree.rename(b"/other", b"/file")
        await trio.sleep(60.0)
        assert here.files() == {b"/file": b"other", b"/learnt": b"2"}


async def test_a_new_file_gets_no_name_in_flight() -> None:
    """Its rename was lost, and the vehicle is armed when it comes back: no name lacks its file."""
    async with rig(FAT, {b"/file": OLD}) as here:
        tree = await learn(here)
        await lose(here, tree, b"/new", NEW, drop=True)
        here.vehicle.arm()
        await trio.sleep(3.0)
        here.faults.cut_after(None)
        await trio.sleep(60.0)
        assert b"/new" not in here.files()
        here.vehicle.disarm()
        await trio.sleep(20.0)
        assert here.files() == {b"/file": OLD, b"/learnt": b"2", b"/new": NEW}


async def late_open(here: Rig, tree: Tree) -> None:
    """Read a file; the network delivers its open once more after it was closed, and loses that answer."""
    here.faults.orphans = True
    held: list[tuple[bytes, Address]] = []
    handle = here.server.handle

    def hold(wire: bytes, source: Address, now: float) -> None:
        if wire[3] == Opcode.OPEN_FILE_RO and not held:
            held.append((wire, source))
        handle(wire, source, now)

    here.server.handle = hold  # type: ignore[method-assign]
    await read_file(tree, b"/file")
    await trio.sleep(3.0)
    here.faults.lose_reply_to(Opcode.OPEN_FILE_RO)
    here.server.handle(*held[0], trio.current_time())
    here.link.kick()
    await trio.sleep(0.5)


@pytest.mark.parametrize("profile", ["ardupilot", "ardupilot5"])
async def test_a_file_that_a_late_open_left_open_keeps_no_upload_from_the_card(profile: str) -> None:
    """ArduPilot refuses to create a file while one is open under the same id, which nobody had noticed."""
    async with rig(profile, {b"/file": OLD}) as here:
        tree = here.mount()
        await tree.list(b"/")
        await late_open(here, tree)
        await write_file(tree, b"/new", NEW)
        assert here.files() == {b"/file": OLD, b"/new": NEW}


async def test_bytes_are_not_kept_of_a_file_that_the_server_had_closed_before_it_was_told_to() -> None:
    """A client that is not heard here takes the session of a read, and closes it before the read is over."""
    async with rig("px4", {b"/file": OLD * 1000, b"/other": NEW * 1000}) as here:
        outgoing = here.server.outgoing
        here.server.outgoing = lambda now: [one for one in outgoing(now) if one[0] != STATION]  # type: ignore
        seq = count(30_000, 10)

        def other(opcode: Opcode, data: bytes = b"") -> None:
            wire = request(next(seq), opcode, session=0, data=data).encode()
            here.server.handle(wire, STATION, trio.current_time())

        def take() -> None:
            other(Opcode.RESET_SESSIONS)
            other(Opcode.OPEN_FILE_RO, b"/other")

        tree = here.mount()
        await tree.list(b"/")
        here.faults.at(Opcode.READ_FILE, take, nth=60)
        here.faults.at(Opcode.TERMINATE_SESSION, lambda: other(Opcode.TERMINATE_SESSION))
        await read_file(tree, b"/file")
        await trio.sleep(5.0)
        assert await read_file(tree, b"/file") == OLD * 1000


async def test_a_truncation_that_is_cancelled_at_each_request_ends_alone() -> None:
    """Its content is forgotten while the upload, which just got its file open, is about to send from it."""
    for cut in count(1):
        async with rig("px4-2026", {b"/file": OLD}) as here:
            tree = here.mount()
            await tree.list(b"/")
            await trio.sleep(3.0)
            with trio.CancelScope() as caller:
                here.faults.after(cut, caller.cancel)
                await tree.truncate(b"/file", 7)
            await trio.sleep(20.0)
            whole = (OLD, OLD[:7]) if caller.cancelled_caught else (OLD[:7],)
            assert list(here.files()) == [b"/file"]
            assert here.files()[b"/file"] in whole
            if not caller.cancel_called:
                return
