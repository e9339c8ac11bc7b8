"""Files on their way to the card: under which name, what is compared, which errors are told.

What becomes of them if something happens at any one request is judged in test_matrix.
"""

from __future__ import annotations

import errno
import json
from contextlib import nullcontext, suppress
from pathlib import Path

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.throttle import LEAST, MOST, SECONDS, UNMEASURED
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.session.store import HURRY
from mavftpfs.session.upload import Upload
from mavftpfs.shared.errors import (
    AlreadyExists,
    Armed,
    FileBusy,
    FileChanged,
    FileTooLarge,
    FtpNak,
    NotSupported,
    OutcomeUnknown,
    RequestTimeout,
    VehicleLost,
    VerificationFailed,
)
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.replies import ack
from tests.support.rigs import KINDS, Rig, card, list_all, read_file, rig, write_file
from tests.support.transfers import content

OLD = bytes(range(256)) * 4
NEW = b"new content " * 100
FILE, OTHER, FRESH = b"/d/file.txt", b"/d/other", b"/d/new"
LONG = b"/" + b"f" * 150
FAIL_ERRNO = NakCode.FAIL_ERRNO
BACK_IN = 60.0
"""Seconds in which what was not delivered is tried again by itself."""

here = card({FILE: OLD, OTHER: NEW})
each = card({FILE: OLD, OTHER: NEW}, profiles=KINDS)
fat = card({FILE: OLD, OTHER: NEW}, profiles=["ardupilot5"])


# --- names


@pytest.mark.parametrize("data", [NEW, b""])
async def test_a_new_file_gets_its_name_when_it_is_whole(each: Rig, data: bytes) -> None:
    tree, named = each.mount(), []
    for opcode in (Opcode.TERMINATE_SESSION, Opcode.CALC_FILE_CRC32):
        each.faults.at(opcode, lambda: named.append(FRESH in each.files()))
    file = await tree.create(FRESH, exclusive=True)
    await file.write(0, data)
    assert each.count(Opcode.CREATE_FILE) == 0
    await file.release()
    assert each.data(FRESH) == data
    assert True not in named[: 1 + each.renames]
    assert each.count(Opcode.CALC_FILE_CRC32) == 2 * bool(data), "the first of a mount is compared again"
    assert await read_file(tree, FRESH) == data
    assert each.litter() == []


@pytest.mark.holds("promise 3")
async def test_a_change_of_a_name_that_began_is_finished_though_its_caller_is_cancelled(
    each: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree, end = each.mount(), Upload.end
    await write_file(tree, b"/d/first", NEW)  # shows whether the card can rename
    file = await tree.create(FRESH, exclusive=True)
    await file.write(0, NEW)
    with trio.CancelScope() as caller:

        async def cancelled(upload: Upload) -> None:
            caller.cancel()
            await end(upload)

        monkeypatch.setattr(Upload, "end", cancelled)
        await file.flush()
    monkeypatch.undo()
    assert each.data(FRESH) == NEW
    assert tree.undelivered() == []
    await file.release()


@pytest.mark.holds("promise 4")
async def test_a_removal_waits_for_a_change_of_the_name_and_then_gives_up(
    each: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree, end, ended = each.mount(op_deadline=8.0), Upload.end, trio.Event()

    async def slow(upload: Upload) -> None:
        await ended.wait()
        await end(upload)

    monkeypatch.setattr(Upload, "end", slow)
    file = await tree.create(FRESH, exclusive=True)
    await file.write(0, NEW)
    each.nursery.start_soon(file.flush)
    await trio.sleep(5.0)
    began = trio.current_time()
    with pytest.raises(FileBusy):
        await tree.unlink(FRESH)
    assert trio.current_time() - began == pytest.approx(8.0)
    ended.set()
    await tree.unlink(FRESH)
    assert FRESH not in each.files()
    await file.release()


@pytest.mark.holds("promise 4")
async def test_a_second_signal_ends_a_change_of_a_name_that_gets_no_answer(fat: Rig) -> None:
    tree = fat.mount()
    fat.faults.at(Opcode.RENAME, lambda *_: fat.link.cut())
    with trio.CancelScope() as caller:
        fat.nursery.start_soon(_hurry, fat, caller)
        with pytest.raises(OutcomeUnknown):
            await write_file(tree, FILE, NEW)
    assert trio.current_time() == pytest.approx(5.0 + HURRY, abs=0.5)
    assert tree.undelivered() == [FILE], "it is kept"


async def _hurry(here: Rig, caller: trio.CancelScope) -> None:
    await trio.sleep_until(5.0)
    caller.cancel()
    here.connection.store.hurry()


async def test_whether_the_card_can_rename_is_found_out_once(each: Rig) -> None:
    tree, traits = each.mount(), each.connection.store.traits
    await write_file(tree, FRESH, NEW)
    assert traits.rename_works == each.renames
    created, renamed = each.count(Opcode.CREATE_FILE), each.count(Opcode.RENAME)
    await write_file(tree, b"/d/newer", NEW)
    assert each.count(Opcode.CREATE_FILE) == created + 1
    assert each.count(Opcode.RENAME) == renamed + each.renames


def never_rename(here: Rig, *, loses: bool) -> None:
    """Have the server ACK each rename, and do nothing; or remove the file."""

    def answer(request: Payload) -> list[Payload] | None:
        if request.opcode != Opcode.RENAME:
            return None
        if loses:
            with suppress(OSError):
                here.card.remove(request.data.split(b"\0")[0])
        return [ack(request)]

    here.server.answer = answer


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("loses", [False, True], ids=["does nothing", "removes it"])
@pytest.mark.parametrize("size", [0, 600, 50_000])
@pytest.mark.parametrize(
    ("profile", "verify_max"), [("px4", 1 << 20), ("px4", 0), ("ardupilot5", 1 << 20), ("mavsdk", 0)]
)
async def test_a_server_that_says_that_it_renames_and_does_not(
    profile: str, verify_max: int, size: int, loses: bool
) -> None:
    """Each close() said that the file is there, and nothing was on the card."""
    async with rig(profile, {FILE: OLD}) as here:
        tree = here.mount(verify_max=verify_max)
        never_rename(here, loses=loses)
        for path in (FRESH, b"/d/newer"):
            await write_file(tree, path, content(size))
            assert here.data(path) == content(size)
        if size:
            with pytest.raises(NotSupported):
                await write_file(tree, FILE, content(size))
            assert here.data(FILE) == OLD


@pytest.mark.holds("fault duplicate")
async def test_a_removal_that_arrives_twice_does_not_pass_for_a_card_that_cannot_rename() -> None:
    """The removal is that of the empty file of the rename test. Only its second answer arrives, a refusal."""
    asked: list[int] = []
    for _ in range(2):
        async with rig("mavsdk") as here:
            here.put_directory(b"/d")
            tree = here.mount()
            await tree.list(b"/d")
            if asked:
                here.faults.repeat(asked.index(Opcode.REMOVE_FILE) + 1)
                here.faults.lose_reply_to(Opcode.REMOVE_FILE)
            began = len(here.faults.requests)
            await write_file(tree, FRESH, content(70_000))
            assert here.connection.store.traits.rename_works
            asked = here.faults.requests[began:]
    assert asked.count(Opcode.REMOVE_FILE) > 2


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.ENOSPC])
async def test_a_refusal_for_another_reason_says_nothing_of_replacing(here: Rig, number: int) -> None:
    tree, traits = here.mount(), here.connection.store.traits
    here.faults.refuse(Opcode.RENAME, FAIL_ERRNO, number)
    with pytest.raises(FtpNak):
        await tree.rename(OTHER, FILE)
    assert here.files() == {FILE: OLD, OTHER: NEW}
    assert traits.rename_replaces is None
    assert traits.rename_works is not False
    renamed = here.count(Opcode.RENAME)
    await tree.rename(OTHER, FILE)
    assert here.files() == {FILE: NEW}
    assert here.count(Opcode.RENAME) == renamed + 1, "nothing was moved aside"


async def test_what_cannot_be_replaced_safely_stays() -> None:
    async with rig("littlefs", {FILE: OLD}) as here:
        tree = here.mount()
        for size in (300, 1100, 0):
            with pytest.raises(NotSupported):
                await tree.truncate(FILE, size)
            assert await read_file(tree, FILE) == OLD
        assert tree.undelivered() == []
        with pytest.raises(NotSupported):
            await write_file(tree, FILE, NEW)
        assert here.files() == {FILE: OLD}
        assert await read_file(tree, FILE) == NEW, "what was accepted is kept and shown"


@pytest.mark.holds("rule 14.25")
async def test_what_is_cut_goes_to_the_card_as_a_whole(each: Rig) -> None:
    tree = each.mount(inplace=not each.renames)
    for size in (700, 300, 1100, 0):
        before = each.data(FILE)
        await tree.truncate(FILE, size)
        assert each.data(FILE) == before[:size].ljust(size, b"\0") == await read_file(tree, FILE)
    assert each.count(Opcode.TRUNCATE_FILE) == 0


async def test_a_part_of_a_large_file_is_refused_where_it_would_be_sent_whole(
    here: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mavftpfs.cache.throttle.MOST_REWRITE", len(OLD) - 1)
    file = await here.mount().open(FILE, write=True)
    with pytest.raises(FileTooLarge, match="write a new file instead"):
        await file.write(5, b"x")
    await file.release()
    assert here.data(FILE) == OLD


@pytest.mark.parametrize("writes", [False, True])
async def test_small_files_before_it_are_no_reason_to_refuse_a_part_of_a_large_one(writes: bool) -> None:
    """Small files take round trips. Taken for a rate, they made 300 kB in 3 s EFBIG."""
    few, some = content(300), content(300_000)
    card = {b"/d/log": some} | {b"/d/%d" % number: few for number in range(40)}
    async with rig("px4", card, link=LinkSettings(rate=300_000.0, delay=0.02)) as here:
        tree = here.mount()
        for number in range(40):
            if writes:
                await write_file(tree, b"/d/new%d" % number, few)
            else:
                await read_file(tree, b"/d/%d" % number)
        file = await tree.open(b"/d/log", write=True)
        await file.write(0, b"x")
        await file.release()
        assert here.data(b"/d/log") == b"x" + some[1:]


@pytest.mark.parametrize("stale", [False, True], ids=["", "stale errno"])
async def test_overwriting_in_place_needs_no_room_for_both_files(stale: bool) -> None:
    """The delivery then tries a rename on an empty file. ArduPilot's refusal may have the errno of an earlier
    request."""
    async with rig("littlefs", {FILE: OLD}) as here:
        here.card.capacity = len(NEW)
        if stale:
            here.faults.refuse(Opcode.RENAME, NakCode.FILE_EXISTS, times=9)
        await write_file(here.mount(inplace=True), FILE, NEW)
        assert here.files() == {FILE: NEW}
        traits = here.connection.store.traits
        assert (traits.rename_works, traits.rename_replaces) == (False, None)


@pytest.mark.holds("fault full card")
async def test_overwriting_in_place_that_failed_goes_on_later() -> None:
    """The file there is the old one, or a part of the new one, and nobody else's."""
    async with rig("littlefs", {FILE: OLD}) as here:
        tree = here.mount(inplace=True)
        await write_file(tree, FILE, NEW)
        for number, nth in enumerate((1, 2, 3), 1):
            here.faults.refuse(Opcode.WRITE_FILE, FAIL_ERRNO, errno.EIO, nth=nth)
            file = await tree.open(FILE, write=True, truncate=True)
            await file.write(0, b"%d" % number * 700)
            with pytest.raises(FtpNak):
                await file.flush()
            await trio.sleep(100)
            await file.flush()
            assert here.data(FILE) == b"%d" % number * 700
            await file.release()


async def test_a_part_in_place_that_is_listed_in_flight_is_not_the_file_of_others() -> None:
    """The program overwrites every byte of the old file, and does not empty it, as rsync --inplace does."""
    new = content(60_000)
    async with rig("littlefs", {FILE: new[::-1]}, link=LinkSettings(rate=20_000.0)) as here:
        tree = here.mount(inplace=True)
        file = await tree.open(FILE, write=True)
        await file.write(0, new)
        async with trio.open_nursery() as nursery:
            nursery.start_soon(_is_refused_in_flight, file)
            await trio.sleep(2)
            await here.arm()
        assert 0 < len(here.data(FILE)) < len(new)
        await trio.sleep(30)
        await tree.list(b"/d")
        await here.disarm()
        assert await tree.drain(60) == []
        assert here.data(FILE) == new


async def _is_refused_in_flight(file: OpenFile) -> None:
    with pytest.raises(Armed):
        await file.release()


async def test_what_others_wrote_before_anything_of_ours_went_out_in_place_stays() -> None:
    async with rig("littlefs", {FILE: OLD}) as here:
        tree = here.mount(inplace=True)
        await write_file(tree, OTHER, NEW)  # finds out that it cannot rename
        file = await tree.open(FILE, write=True)
        await file.write(0, OLD[::-1])
        here.faults.at(Opcode.OPEN_FILE_RO, here.vehicle.arm)  # while it is asked whether the base is there
        with pytest.raises(Armed):
            await file.flush()
        here.put(FILE, NEW)
        here.vehicle.disarm()
        await trio.sleep(15)
        with pytest.raises(FileChanged):
            await file.flush()
        assert here.data(FILE) == NEW
        file.close()


@pytest.mark.parametrize("then", ["others", "later", "removed", "taken back"])
@pytest.mark.parametrize("carried_out", [False, True])
async def test_a_new_file_of_which_it_is_not_known_whether_it_was_made_in_place(
    carried_out: bool, then: str
) -> None:
    """No byte of ours was sent: what others put there stays. An empty file is nothing that could be lost."""
    async with rig("littlefs", {FILE: OLD}, options=ConnectOptions(op_deadline=15.0)) as here:
        tree = here.mount()
        await write_file(tree, OTHER, content(70_000))  # finds out that it cannot rename
        file = await tree.create(FRESH, exclusive=True)
        await file.write(0, NEW)
        here.faults.at(Opcode.CREATE_FILE, lambda: here.faults.cut_after(0), drop=not carried_out)
        with pytest.raises(RequestTimeout):
            await file.fsync()
        if then == "others":
            here.put(FRESH, OLD)
        here.faults.cut_after(None)
        if then == "removed":
            await tree.unlink(FRESH)
        if then == "taken back":
            assert await file.take_back() is False
        with pytest.raises(AlreadyExists) if then == "others" else nullcontext():
            await file.release()
        await trio.sleep(100)
        assert here.files().get(FRESH) == {"others": OLD, "later": NEW}.get(then)


@pytest.mark.holds("promise 3")
@pytest.mark.parametrize("target_too", [False, True])
@pytest.mark.parametrize("verify_max", [1 << 20, 0])
async def test_a_temporary_that_vanished_is_not_taken_for_success(
    here: Rig, verify_max: int, target_too: bool
) -> None:
    """While the link was lost between the verification and the rename, somebody tidied up."""
    tree = here.mount(verify_max=verify_max)
    here.put(FILE, NEW[::-1])  # of the same size
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, NEW)
    here.faults.at(Opcode.RENAME, here.link.cut, drop=True)
    with pytest.raises(RequestTimeout):
        await file.fsync()
    for path in here.litter():
        here.take(path)
    if target_too:
        here.take(FILE)
    await here.find()
    await file.release()
    assert here.data(FILE) == NEW


@pytest.mark.holds("promise 3")
@pytest.mark.parametrize("path", [FILE, LONG])
async def test_what_could_not_be_removed_brings_nothing_back(fat: Rig, path: bytes) -> None:
    tree = fat.mount()
    fat.put(path, OLD)
    await write_file(tree, OTHER, OLD)  # whether a rename replaces files is known from now on
    removed = fat.count(Opcode.REMOVE_FILE)
    fat.faults.refuse(Opcode.REMOVE_FILE, NakCode.FAIL)
    await write_file(tree, path, NEW)
    assert fat.count(Opcode.REMOVE_FILE) == removed + 1
    await tree.unlink(path)
    await list_all(fat, tree)
    assert set(fat.files()) == {OTHER, FILE} - {path}


@pytest.mark.parametrize("refused", [1, 2])
@pytest.mark.parametrize("profile", ["px4", "ardupilot5"])
async def test_what_is_refused_a_name_again_and_again_does_not_fill_the_card(
    profile: str, refused: int
) -> None:
    """No listing is made that would show it."""
    async with rig(profile, {FILE: OLD} | {b"/d/%d" % number: b"x" for number in range(10)}) as here:
        tree = here.mount()
        await tree.list(b"/d")
        file = await tree.open(FILE, write=True, truncate=True)
        await file.write(0, NEW)
        for _ in range(5):
            here.faults.call_off()
            here.faults.refuse(Opcode.RENAME, FAIL_ERRNO, errno.EACCES, nth=refused)
            with suppress(FtpNak):
                await file.flush()
            assert here.litter() == []
            if not tree.undelivered():
                await file.write(0, b"x")
        here.faults.call_off()
        await file.release()
        assert here.data(FILE) in (NEW, b"x" + NEW[1:])


# --- verification


@pytest.mark.holds("promise 2", "rule 14.23")
async def test_a_mismatch_is_sent_once_more(each: Rig) -> None:
    each.faults.spoil = 1
    await write_file(each.mount(), FRESH, NEW)
    assert each.data(FRESH) == NEW
    assert each.count(Opcode.CALC_FILE_CRC32) == 3, "one more for the first of a mount"


async def test_a_second_mismatch_is_an_error_and_the_old_file_stays(here: Rig) -> None:
    here.faults.spoil = 1000
    tree = here.mount()
    with pytest.raises(VerificationFailed):
        await write_file(tree, FILE, NEW)
    assert here.files() == {FILE: OLD, OTHER: NEW}
    here.faults.spoil = 0
    assert await tree.drain(10) == []
    assert here.data(FILE) == NEW


@pytest.mark.holds("promise 2")
async def test_an_unanswered_checksum_counts_as_verified_by_size(here: Rig) -> None:
    here.faults.ignore(Opcode.CALC_FILE_CRC32)
    tree = here.mount()
    await write_file(tree, FRESH, NEW)
    assert (tree.status()["checksums_unanswered"], tree.status()["verified_by_size"]) == (1, 1)


@pytest.mark.parametrize("verify_max", [0, len(NEW) - 1])
async def test_what_is_too_large_is_not_summed(here: Rig, verify_max: int) -> None:
    await write_file(here.mount(verify_max=verify_max), FRESH, NEW)
    assert here.count(Opcode.CALC_FILE_CRC32) == 0


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize(("verify_max", "data"), [(0, NEW), (1 << 20, bytes(5000))])
async def test_what_was_cut_off_is_noticed_by_its_size(here: Rig, verify_max: int, data: bytes) -> None:
    """The checksum of zeros is right, however many there are."""
    here.faults.at(Opcode.TERMINATE_SESSION, lambda: here.put(here.litter()[0], data[:300]))
    await write_file(here.mount(verify_max=verify_max), FRESH, data)
    assert here.data(FRESH) == data
    assert here.count(Opcode.CREATE_FILE) == 2


@pytest.mark.holds("promise 9")
async def test_no_checksum_is_asked_for_in_flight() -> None:
    """Where a file is in doubt it is not delivered then."""
    async with rig(options=ConnectOptions(when_armed="ok")) as here:
        tree = here.mount(when_armed="ok")
        await here.arm()
        await write_file(tree, b"/new", NEW)
        assert here.data(b"/new") == NEW
        here.connection.scheduler.server.distrust(reads=True)
        with pytest.raises(Armed):
            await write_file(tree, b"/newer", NEW)
        assert b"/newer" not in here.files()
        assert here.count(Opcode.CALC_FILE_CRC32) == 0


@pytest.mark.holds("promise 9")
@pytest.mark.parametrize("path", [FRESH, FILE])
async def test_armed_while_the_checksum_is_asked_for(here: Rig, path: bytes) -> None:
    """The file on the card is compared after the vehicle was disarmed."""
    tree = here.mount()
    here.faults.at(Opcode.TERMINATE_SESSION, here.vehicle.arm)
    with pytest.raises(Armed):
        await write_file(tree, path, b"x" * 5000)
    sent = here.count(Opcode.WRITE_FILE)
    await here.disarm()
    await trio.sleep(BACK_IN)
    assert tree.undelivered() == []
    assert here.data(path) == b"x" * 5000
    assert here.count(Opcode.WRITE_FILE) == sent
    assert here.litter() == []


@pytest.mark.holds("promise 3")
async def test_a_close_that_waits_too_long_for_a_change_of_its_path_is_delivered_later(here: Rig) -> None:
    tree = here.mount()
    file = await tree.create(FRESH, exclusive=True)
    await file.write(0, NEW)
    async with tree._card.paths.hold(FRESH, lasting=True):
        with pytest.raises(RequestTimeout):
            await file.flush()
        with suppress(RequestTimeout):
            await file.release()
    await trio.sleep(BACK_IN)
    assert here.data(FRESH) == NEW


@pytest.mark.parametrize("restarts", [False, True])
async def test_what_was_written_is_believed_from_the_moment_when_it_was_verified(
    here: Rig, restarts: bool
) -> None:
    """Not from when the program closed it: somebody else may have changed it before that."""
    tree = here.mount(dir_timeout=20)
    file = await tree.open(FILE, write=True, truncate=True)
    await file.write(0, OLD)
    await file.fsync()
    await trio.sleep(0 if restarts else 15)
    here.put(FILE, OLD[::-1])
    if restarts:
        await here.reboot()
    await file.release()
    await trio.sleep(0 if restarts else 15)
    assert await read_file(tree, FILE) == OLD[::-1]


# --- errors


@pytest.mark.holds("promise 3")
async def test_an_error_is_told_at_every_close_until_the_bytes_are_there(here: Rig) -> None:
    tree = here.mount()
    file = await tree.create(FRESH, exclusive=True)
    await file.write(0, NEW)
    await here.lose()
    for ask in (file.flush, file.fsync, file.flush):
        with pytest.raises(VehicleLost):
            await ask()
    assert tree.undelivered() == [FRESH]
    assert list(tree.status()["errors"]) == ["/d/new"]  # type: ignore[call-overload]
    assert tree.status()["bytes_undelivered"] == len(NEW)
    reader = await tree.open(FRESH)
    await reader.flush()
    with pytest.raises(VehicleLost):
        await reader.fsync()  # `sync FILE` opens for reading
    with pytest.raises(VehicleLost):
        await file.flush()
    await here.find()
    await reader.fsync()
    assert here.data(FRESH) == NEW
    await reader.release()
    await file.release()
    assert (tree.undelivered(), tree.status()["errors"], tree.status()["bytes_held"]) == ([], {}, 0)


@pytest.mark.parametrize("data", [b"abc", b""])
async def test_a_file_that_could_not_be_made_can_be_made_later_or_removed(here: Rig, data: bytes) -> None:
    tree = here.mount()
    file = await tree.create(FRESH, exclusive=True)
    await file.write(0, data)
    here.faults.refuse(Opcode.CREATE_FILE, FAIL_ERRNO, errno.ENOSPC, times=2)
    for ask in (file.fsync, file.flush):
        with pytest.raises(FtpNak):
            await ask()
    await file.flush()
    assert here.data(FRESH) == data
    await file.release()
    here.faults.refuse(Opcode.CREATE_FILE, FAIL_ERRNO, errno.ENOSPC)
    with pytest.raises(FtpNak):
        await write_file(tree, b"/d/newer", NEW)
    await tree.unlink(b"/d/newer")
    assert (tree.undelivered(), tree.status()["bytes_held"]) == ([], 0)
    assert b"newer" not in dict(await tree.list(b"/d"))


@pytest.mark.holds("promise 9")
async def test_armed_means_an_error_at_once_and_delivery_after(here: Rig) -> None:
    tree = here.mount()
    file, other = await tree.create(FRESH, exclusive=True), await tree.open(FILE, write=True)
    await file.write(0, NEW)
    await here.arm()
    before, asked = trio.current_time(), len(here.faults.requests)
    asks = [
        file.flush(),
        file.fsync(),
        other.write(0, b"x"),
        other.truncate(1),
        tree.create(b"/d/x", exclusive=False),
        tree.open(FILE, write=True),
        tree.open(FILE, write=True, truncate=True),
        tree.truncate(FILE, 0),
        tree.mkdir(b"/d/y"),
        tree.rmdir(b"/d"),
        tree.unlink(FILE),
        tree.rename(FILE, b"/d/z"),
        file.release(),
    ]
    for ask in asks:
        with pytest.raises(Armed):
            await ask
    assert trio.current_time() - before < 1
    assert len(here.faults.requests) == asked
    await here.disarm()
    await trio.sleep(1)
    assert here.data(FRESH) == NEW
    assert tree.undelivered() == []


@pytest.mark.parametrize("profile", ["px4", "mavsdk"])
@pytest.mark.parametrize("now", [OLD + b"grown on the vehicle", OLD[:10]])
@pytest.mark.parametrize("read", [False, True], ids=["fetched", "compared"])
async def test_a_part_is_not_written_into_a_file_that_changed(profile: str, now: bytes, read: bool) -> None:
    """The draft is stale from then on, whichever request found it out."""
    async with rig(profile, {FILE: OLD}) as here:
        tree = here.mount()
        file = await tree.open(FILE, write=True)
        if read:
            await file.read(0, len(OLD))
        await file.write(len(OLD), b"appended")
        here.put(FILE, now)
        for _ in range(2):
            with pytest.raises(FileChanged):
                await file.flush()
            with pytest.raises(FileChanged):
                await file.write(0, b"x")
        file.close()
        assert here.files() == {FILE: now}
        assert tree.undelivered() == [FILE]


async def test_emptying_does_not_trust_a_remembered_size_of_nothing(here: Rig) -> None:
    tree = here.mount()
    here.put(FRESH, b"")
    await tree.stat(FRESH)
    here.put(FRESH, b"grown")
    file = await tree.open(FRESH, write=True, truncate=True)
    await file.fsync()
    await file.release()
    assert here.data(FRESH) == b""


# --- while the program still writes


async def test_bytes_travel_while_the_program_still_writes(here: Rig) -> None:
    file = await here.mount().create(FRESH, exclusive=True)
    await file.write(0, bytes(100_000))
    await trio.sleep(10)
    (there,) = here.litter()
    assert len(here.data(there)) == 100_000 // 239 * 239  # the rest waits to fill a request
    for number in range(3):
        await file.write(50_000, b"again %d" % number)
        await trio.sleep(10)
    await file.release()
    assert here.data(FRESH) == bytes(50_000) + b"again 2" + bytes(49_993)
    assert here.count(Opcode.CREATE_FILE) <= 3, "a file whose sent bytes change is sent by the close"


@pytest.mark.holds("promise 4")
async def test_a_pause_of_the_link_gives_no_half_file_its_name() -> None:
    """The program is still writing: later bytes would count as the change of a part, and be refused."""
    async with rig(link=LinkSettings(rate=10_000.0, delay=0.05)) as here:
        file = await here.mount().create(b"/new", exclusive=True)
        data = content(400_000)

        async def pause_the_link() -> None:
            await trio.sleep(15)
            here.link.cut()
            await trio.sleep(8)
            here.link.restore()

        here.nursery.start_soon(pause_the_link)
        for at in range(0, len(data), 20_000):
            assert b"/new" not in here.files()
            await file.write(at, data[at : at + 20_000])
        await file.flush()
        assert here.data(b"/new") == data
        assert here.count(Opcode.RENAME) == 2  # with the one that shows whether the card can
        await file.release()


async def rate_and_limit(rate: float, size: int) -> tuple[float, object]:
    """Write a file over a link; return its rate and how much may wait then."""
    async with rig(link=LinkSettings(rate=rate, delay=0.001)) as here:
        tree = here.mount()
        assert tree.status()["unacked_max"] == UNMEASURED
        file = await tree.create(b"/new", exclusive=True)
        began = trio.current_time()
        await file.write(0, content(size))
        await file.flush()
        took = trio.current_time() - began
        await file.release()
        return size / took, tree.status()["unacked_max"]


@pytest.mark.holds("promise 4")
async def test_what_may_wait_is_what_ten_seconds_bring() -> None:
    """A close cannot be killed."""
    rate, limit = await rate_and_limit(30_000.0, 200_000)
    assert limit == pytest.approx(SECONDS * rate, rel=0.2)
    assert (await rate_and_limit(1000.0, 10_000))[1] == LEAST
    assert (await rate_and_limit(1.2e6, 300_000))[1] == MOST


# --- the end of a mount


async def test_what_is_still_open_when_the_mount_ends_is_not_kept(here: Rig, tmp_path: Path) -> None:
    """A kernel that lost its mount closes nothing: the next mount must not offer what was delivered."""
    spool = SpoolDirectory(tmp_path / "spool")
    tree = here.mount(spool=spool)
    file = await tree.create(FRESH, exclusive=True)
    await file.write(0, bytes(300_000))
    assert await tree.drain(100) == []
    spool.discard()
    assert [path.name for path in spool.path.iterdir()] == ["owner"]
    spool.close()


async def test_what_cannot_be_delivered_is_moved_with_its_description(here: Rig, tmp_path: Path) -> None:
    tree = here.mount()
    new = await tree.create(FRESH, exclusive=True)
    await new.write(0, NEW)
    await new.truncate(5000)
    part = await tree.open(FILE, write=True)
    await part.write(500, b"part")
    await here.lose()
    assert sorted(await tree.drain(5)) == [FILE, FRESH]
    files = {path.name: path for path in tree.recover_to(tmp_path / "rescued")}
    assert files["d__new"].read_bytes() == NEW.ljust(5000, b"\0")
    assert files["d__file.txt"].read_bytes()[500:504] == b"part"
    whole, changed = (
        json.loads(files[name].with_name(f"{name}.json").read_text()) for name in ("d__new", "d__file.txt")
    )
    assert whole["whole"]
    assert changed["held"] == [[500, 504]]
    assert not changed["whole"]
