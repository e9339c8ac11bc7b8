"""Changes of names: done once, or the caller is told; they end in time, and wait for nobody else's.

What loss, doubling and silence do to each of them at each request is judged in test_matrix. That nothing of
ours is open where a name changes is asserted in every test with a Rig (support/faults.py).
"""

from __future__ import annotations

from collections.abc import Awaitable

import pytest
import trio

from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.pathlocks import SLACK
from mavftpfs.protocol.payload import Opcode
from mavftpfs.shared.errors import FileBusy, FileChanged, FtpNak, RequestTimeout
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.rigs import Rig, read_file, write_file
from tests.support.takingturns import taking_turns
from tests.support.transfers import MemorySource, begin_to_read, content, know, path

EVERY_PROFILE = sorted(PROFILES)


@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_an_existing_directory_is_not_taken_for_ours(profile: str) -> None:
    """The mkdir of an existing directory is refused even if the reply to it was lost."""
    here = Rig(profile, {b"/d": None})
    here.put(b"/d/dir/inner", b"x")
    async with here.connected() as connection:
        here.faults.lose_reply_to(Opcode.CREATE_DIRECTORY)
        with pytest.raises(FtpNak) as refusal:
            await connection.store.make_directory(path(profile, "dir"))
        assert refusal.value.code == 8


@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_an_upload_makes_room_for_a_change_of_its_path(profile: str) -> None:
    here = Rig(profile, {b"/d": None}, LinkSettings(rate=20_000.0, delay=0.02))
    async with here.connected() as connection:
        know(connection, profile)
        source = MemorySource(bytes(300_000))
        upload = connection.store.open_upload(path(profile, "file"), source)
        await trio.sleep(1)
        await connection.store.remove(path(profile, "file"))
        assert not source.todo.empty  # it did not wait for the upload's end
        await upload.end()
    assert here.server.open_sessions == 0


async def test_readers_of_a_removed_file_get_no_more_of_it() -> None:
    here = Rig("px4", {b"/d/file": bytes(60_000)}, LinkSettings(rate=20_000.0, delay=0.02))
    async with here.connected() as connection:
        reader, sink = await begin_to_read(connection, b"/d/file", 1000)
        await connection.store.remove(b"/d/file")
        for _ in range(2):
            with pytest.raises(FileChanged):
                await sink.wait_for(0, 60_000)
            reader.want(0, 60_000, demand=True)


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_a_look_misses_no_name_because_other_names_go(profile: str) -> None:
    """A page begins where the one before ended, by number: what moved up meanwhile is on neither."""
    names = [b"name of some length %02d" % number for number in range(60)]
    here = Rig(profile, {b"/d": None}, LinkSettings(delay=0.1))
    for name in names:
        here.card.add(path(profile, name.decode()), b"x")
    here.card.add_directory(path(profile, "zone"))
    async with here.connected() as connection, trio.open_nursery() as nursery:
        await connection.store.list_directory(path(profile, "")[:-1])

        async def refused() -> None:
            with pytest.raises(RequestTimeout):
                await connection.store.remove_directory(path(profile, "zone"))

        here.faults.ignore(Opcode.REMOVE_DIRECTORY)
        nursery.start_soon(refused)
        await trio.sleep(30.3)  # it looks
        for name in names[:30]:
            nursery.start_soon(connection.store.remove, path(profile, name.decode()))


@pytest.mark.parametrize("profile", ["px4", "mavsdk"])
async def test_nor_because_names_go_whose_requests_went_out_before_the_look(profile: str) -> None:
    """The requests are lost once, so the second transmissions arrive after the first page of the look."""
    here = Rig(profile, {b"/d": None}, LinkSettings(delay=0.1))
    names = [path(profile, f"name of some length {number:02}") for number in range(60)]
    for name in names[:10]:
        here.card.add(name, b"x")
    here.card.add_directory(path(profile, "zone"))
    for name in names[10:]:
        here.card.add(name, b"x")
    async with here.connected() as connection, trio.open_nursery() as nursery:
        await connection.store.list_directory(path(profile, "")[:-1])
        here.faults.ignore(Opcode.REMOVE_DIRECTORY)
        here.faults.at(Opcode.REMOVE_FILE, lambda: None, times=5, drop=True)

        async def remove_soon(name: bytes) -> None:
            await trio.sleep(29.9)  # the look begins after 30 s
            await connection.store.remove(name)

        for name in names[:5]:
            nursery.start_soon(remove_soon, name)
        with pytest.raises(RequestTimeout):
            await connection.store.remove_directory(path(profile, "zone"))


LIMIT = CacheOptions().op_deadline + SLACK
RADIO = LinkSettings(rate=5760.0, delay=0.05)
D = b"/d"


def made(profile: str, settings: LinkSettings | None = None) -> Rig:
    here = Rig(profile, link=settings or LinkSettings())
    for name in (b"/a", b"/b"):
        here.card.add(D + name, b"x" * 30)
    return here


@pytest.mark.holds("promise 4")
async def test_nobody_else_waits_for_a_long_delivery() -> None:
    here = made("mavsdk", RADIO)
    here.card.add(D + b"/long", content(300_000))
    async with here.mounted(D) as tree:
        file = await tree.open(D + b"/long", write=True)
        await file.write(100, b"s" * 1000)

        async def deliver() -> None:
            await file.flush()

        async def timed(change: Awaitable[None], limit: float) -> None:
            began = trio.current_time()
            await change
            assert trio.current_time() - began <= limit

        async def busy(change: Awaitable[None]) -> None:
            with pytest.raises(FileBusy):
                await change

        async with trio.open_nursery() as outer:
            outer.start_soon(deliver)
            await trio.sleep(20)
            async with trio.open_nursery() as nursery:
                nursery.start_soon(timed, busy(tree.rename(D + b"/long", D + b"/other")), LIMIT)
                await trio.sleep(1)
                nursery.start_soon(timed, tree.mkdir(D + b"/new"), 5.0)
                nursery.start_soon(timed, tree.unlink(D + b"/a"), 5.0)
            await timed(tree.unlink(D + b"/long"), 5.0)  # for it the delivery is called off
        await file.release()


async def test_a_refusal_on_a_link_that_doubles_nothing_costs_no_listing() -> None:
    here = Rig("mavsdk", {b"/d/file": b"content"})
    async with here.connected() as connection:
        with pytest.raises(FtpNak):
            await connection.store.remove(path("mavsdk", "missing"))
    assert not {Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME} & set(here.faults.requests)


@pytest.mark.parametrize("same", [False, True])
async def test_six_changes_are_not_answered_in_the_time_of_one(same: bool) -> None:
    here = made("px4")
    async with here.mounted(D) as tree:
        here.faults.cut_after(0)

        async def one(number: int) -> None:
            await trio.sleep(3 * number)
            began = trio.current_time()
            with pytest.raises(RequestTimeout):
                await tree.mkdir(D + b"/new%d" % (0 if same else number))
            assert trio.current_time() - began <= LIMIT

        async with trio.open_nursery() as nursery:
            for number in range(6):
                nursery.start_soon(one, number)


@pytest.mark.parametrize("profile", ["px4", "ardupilot", "ardupilot5", "mavsdk"])
async def test_a_file_whose_temporary_file_another_client_removed_is_sent_again(profile: str) -> None:
    here = Rig(profile, {b"/file": b"before"})
    async with here.mounted(listed=b"/") as tree:
        await write_file(tree, b"/other", b"teaches how this server renames")
        litter: list[bytes] = []

        def remove() -> None:
            new = [name for name in here.litter() if here.data(name) == b"after"]
            litter.extend(new)
            for name in new:
                here.take(name)

        here.faults.at(Opcode.RENAME, remove)
        await write_file(tree, b"/file", b"after")
        assert litter
        assert await read_file(tree, b"/file") == here.data(b"/file") == b"after"


@pytest.mark.holds("promise 2", "rule 14.4")
@pytest.mark.parametrize("removes", ["source", "target"])
async def test_a_rename_without_an_answer_is_not_done_twice_beside_a_reader_on_nuttx(removes: str) -> None:
    """An old NuttX removes the target of a rename whose source is gone, and so the file that was renamed. Its
    server knows a repetition only by its last reply, which may be a reader's."""
    files = {b"/d/a": content(500, 1), b"/d/b": content(400, 2), b"/d/big": content(3_000_000)}
    here = Rig("px4-nuttx", files, LinkSettings(rate=400_000.0, delay=0.005))
    here.server.firmware.storage.removes_first = True
    async with here.mounted(b"/d") as tree, trio.open_nursery() as nursery:
        nursery.start_soon(read_file, tree, b"/d/big")
        await trio.sleep(0.5)
        here.faults.lose_reply_to(Opcode.RENAME)
        if removes == "source":
            await tree.rename(b"/d/a", b"/d/new")
            assert here.data(b"/d/new") == content(500, 1)
        else:
            await write_file(tree, b"/d/b", content(300, 3))
            assert here.data(b"/d/b") == content(300, 3)
        nursery.cancel_scope.cancel()
