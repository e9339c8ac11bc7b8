"""Calls that overlap: with the release of a file, with its delivery, with changes of its name.

What happens to a name or a content at any request of a delivery: test_overtaken.
"""

from __future__ import annotations

import errno
from collections.abc import Awaitable, Callable
from contextlib import suppress

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.shared.errors import FileBusy, FtpNak, LinkError, NotFound, RequestTimeout
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.deliveries import in_the_middle
from tests.support.rigs import KINDS, Rig, card, rig, write_file
from tests.support.worlds import content

FILE, NEW, OTHER = b"/d/file", b"/d/new", b"/d/other"
OLD, LATER = b"old" * 300, b"new" * 300
"""As long as one another: no size tells them apart."""
DATA = content(7680)
FAR = LinkSettings(delay=0.05)
SLOW = LinkSettings(rate=3000.0, queue=2000, delay=0.02)
QUICK = ConnectOptions(op_deadline=5.0)
PROMPT = 2.0

slow = card({FILE: OLD, OTHER: OLD}, profiles=["px4", "ardupilot5", "mavsdk"], link=SLOW, options=QUICK)


async def begun(tree: Tree, path: bytes, data: bytes = DATA) -> OpenFile:
    """Return a file that is written whole and not delivered."""
    file = await (
        tree.create(path, exclusive=True) if path == NEW else tree.open(path, write=True, truncate=True)
    )
    await file.write(0, data)
    return file


async def settle(here: Rig, tree: Tree) -> None:
    """Let everything happen that follows by itself; nothing of ours stays."""
    for _ in range(2):
        await trio.sleep(8)
        tree.forget_caches()
        await tree.list(b"/d")
    assert here.litter() == []
    assert tree.undelivered() == []


# --- the release of a file


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("profile", KINDS)
async def test_a_truncation_while_the_last_writer_is_being_released(profile: str) -> None:
    """The kernel releases a file after close() returned: the next call may overlap with it."""
    for pause in (0.0, 0.1, 0.25, 0.4):
        async with rig(profile, {FILE: b"x" * 700}, link=FAR) as here:
            tree = here.mount(inplace=not here.renames)
            file = await tree.open(FILE, write=True)
            await file.write(100, b"y" * 300)
            async with trio.open_nursery() as both:
                both.start_soon(file.release)
                await trio.sleep(pause)
                await tree.truncate(FILE, 250)
            assert (await tree.stat(FILE)).size == 250
            assert await tree.drain(60) == []
            assert here.files() == {FILE: b"x" * 100 + b"y" * 150}


# --- changes of names while a file is opened or read


OPENINGS = {
    "reader": lambda tree: tree.open(FILE),
    "writer": lambda tree: tree.open(FILE, write=True),
    "emptier": lambda tree: tree.open(FILE, write=True, truncate=True),
}
CHANGES: dict[str, tuple[Callable[[Tree], Awaitable[None]], bytes, bytes]] = {
    "unlink": (lambda tree: tree.unlink(FILE), OTHER, LATER),
    "rename over": (lambda tree: tree.rename(OTHER, FILE), FILE, LATER),
    "rename": (lambda tree: tree.rename(FILE, OTHER), OTHER, OLD),
}
"""The change, which name is left then, and what it has."""


async def program(tree: Tree, opening: Callable[[Tree], Awaitable[OpenFile]], later: float) -> None:
    """Open at that time, use it and close; that there is no such file is the only excuse."""
    await trio.sleep(later)
    try:
        file = await opening(tree)
    except NotFound:
        return
    old = bytes(await file.read(0, 900))
    assert old in (OLD, LATER, b"")
    if file.writable:
        await file.write(3, b"mid")
        assert await file.read(0, 900) == old[:3].ljust(3, b"\0") + b"mid" + old[6:]
    await file.release()


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("change", sorted(CHANGES))
@pytest.mark.parametrize("opening", sorted(OPENINGS))
@pytest.mark.parametrize("profile", ["px4", "ardupilot5"])
async def test_a_file_is_opened_before_or_after_its_name_is_changed(
    profile: str, opening: str, change: str
) -> None:
    """Not meanwhile: who opened would hold neither the old file nor the new one."""
    act, left, base = CHANGES[change]
    for later in (-6, -3, 1, 3, 5):
        async with rig(profile, {FILE: OLD, OTHER: LATER}, link=FAR) as here:
            tree = here.mount()
            await tree.list(b"/d")
            async with trio.open_nursery() as both:
                both.start_soon(program, tree, OPENINGS[opening], max(later, 0) * 0.05)
                await trio.sleep(max(-later, 0) * 0.05 + 0.001)
                await act(tree)
            assert await tree.drain(60) == []
            assert list(here.files()) == [left]
            written = () if change == "unlink" else (base[:3] + b"mid" + base[6:], b"\0\0\0mid")
            assert here.data(left) in (base, *written)


@pytest.mark.parametrize("profile", ["px4", "ardupilot5"])
async def test_a_read_under_way_goes_on_when_the_file_is_renamed(profile: str) -> None:
    one, two = content(12_000, 1), content(12_000, 2)

    async def read(file: OpenFile, expected: bytes) -> None:
        assert bytes(await file.read(0, len(expected))) == expected

    for later in (0, 3, 8):
        link = LinkSettings(rate=20_000.0, delay=0.02)
        async with rig(profile, {FILE: one, OTHER: two}, link=link) as here:
            tree = here.mount()
            file, replaced = await tree.open(FILE), await tree.open(OTHER)
            began = trio.current_time()
            async with trio.open_nursery() as both:
                both.start_soon(read, file, one)
                both.start_soon(read, replaced, two)
                await trio.sleep(later * 0.05)
                await tree.rename(FILE, OTHER)
            assert trio.current_time() - began < 10
            for handle in (file, replaced):
                await handle.release()
            await trio.sleep(5)
            assert here.files() == {OTHER: one}


@pytest.mark.holds("fault overlap")
async def test_a_reader_never_gets_bytes_of_what_replaces_its_file() -> None:
    """Its file was delivered by another handle, so it opens it anew at the next read: at any moment."""
    for later in range(0, 30, 3):
        async with rig("px4", {FILE: OLD, OTHER: LATER}, link=FAR) as here:
            tree = here.mount()
            writer, reader = await tree.open(FILE, write=True), await tree.open(FILE)
            await writer.write(0, b"O")
            await writer.release()
            async with trio.open_nursery() as both:
                both.start_soon(tree.rename, OTHER, FILE)
                await trio.sleep(later * 0.02 + 0.001)
                assert bytes(await reader.read(0, 900)) == b"Old" + OLD[3:]
            await reader.release()


async def test_who_opened_an_older_version_follows_the_renames_too() -> None:
    """Logs are rotated, and are as long as each other."""
    async with rig("px4", {FILE: OLD}) as here:
        tree = here.mount(dir_timeout=0.0)
        first = await tree.open(FILE)
        await tree.rename(FILE, OTHER)
        last = await tree.open(OTHER)
        await tree.rename(OTHER, b"/d/third")
        for name in (FILE, OTHER):
            here.put(name, LATER)
        for file in (first, last):
            assert bytes(await file.read(0, 900)) == OLD
            await file.release()


# --- deliveries that are called off


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("refused", [False, True])
async def test_a_name_that_stays_gets_its_file(slow: Rig, refused: bool) -> None:
    """The program hears 0 when the card has it, as if nobody had tried."""
    tree = slow.mount()
    await tree.list(b"/d")
    file = await begun(tree, FILE)
    async with in_the_middle(file, waiting=2):
        if refused:
            slow.faults.refuse(Opcode.REMOVE_FILE, NakCode.FAIL_ERRNO, errno.EACCES, times=10)
        else:
            slow.faults.at(Opcode.REMOVE_FILE, lambda: None, times=100, drop=True)
        with pytest.raises(FtpNak if refused else RequestTimeout):
            await tree.unlink(FILE)
        slow.faults.call_off()
        assert slow.data(FILE) == OLD
    assert slow.data(FILE) == DATA
    await file.release()
    await settle(slow, tree)


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("profile", ["px4", "ardupilot5"])
@pytest.mark.parametrize("path", [NEW, FILE])
async def test_a_name_goes_in_the_moment_of_any_answer(path: bytes, profile: str) -> None:
    """Called off, the delivery may have got what it waited for, and may just be about to go on. Answers
    take no time here."""
    data = content(700)
    for count in range(1, 50):
        async with rig(profile, {FILE: OLD, OTHER: OLD}) as here:
            tree, now, delivered = here.mount(verify="none"), trio.Event(), trio.Event()
            file = await begun(tree, path, data)
            here.faults.after(count, now.set)

            async def deliver(
                file: OpenFile = file, now: trio.Event = now, delivered: trio.Event = delivered
            ) -> None:
                await file.fsync()
                delivered.set()
                now.set()

            async with trio.open_nursery() as waiting:
                waiting.start_soon(deliver)
                await now.wait()
                if delivered.is_set():
                    assert count > 5
                    return
                await tree.unlink(path)
            assert bytes(await file.read(0, len(data))) == data
            await file.release()
            await settle(here, tree)
            assert set(here.files()) == {FILE, OTHER} - {path}, f"answer {count}"
    raise AssertionError("it was never delivered")


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("path", [NEW, FILE])
async def test_a_removal_that_was_given_up_loses_nothing(slow: Rig, path: bytes) -> None:
    """It had ended the upload: what that left on the vehicle is ours."""
    tree, data = slow.mount(), content(70_000)
    file = await begun(tree, path, data)
    await trio.sleep(1.05)
    with trio.move_on_after(0.01) as scope:
        await tree.unlink(path)
    assert scope.cancelled_caught
    await trio.sleep(5)
    await file.fsync()
    assert slow.data(path) == data
    await file.release()
    await settle(slow, tree)


@pytest.mark.parametrize("more", [b"", b"more"])
@pytest.mark.parametrize("path", [NEW, FILE])
async def test_a_delivery_that_was_given_up_at_its_very_end_goes_on(path: bytes, more: bytes) -> None:
    """Nobody waits for the end of the upload any more, which takes nothing more."""
    async with rig("px4", {FILE: OLD}, link=FAR) as here:
        tree, ending = here.mount(), trio.Event()
        file = await begun(tree, path)
        here.faults.at(Opcode.CALC_FILE_CRC32, ending.set)
        async with trio.open_nursery() as waiting:
            waiting.start_soon(file.fsync)
            await ending.wait()
            await trio.sleep(0.06)
            waiting.cancel_scope.cancel()
        await file.write(len(DATA), more)
        await file.release()
        assert tree.undelivered() == []
        assert here.data(path) == DATA + more


# --- files that are emptied while what they held is on its way


async def test_emptying_waits_for_no_room(slow: Rig) -> None:
    """Who writes too fast has to wait; who empties the file makes room, also for the other."""
    tree = slow.mount(dirty_max=64 * 1024)
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, content(128 * 1024))
    async with trio.open_nursery() as writing:
        writing.start_soon(file.write, 0, b"short")
        await trio.sleep(1.05)
        before = trio.current_time()
        other = await tree.open(NEW, write=True, truncate=True)
        assert trio.current_time() - before < PROMPT
    assert trio.current_time() - before < 2 * PROMPT
    await other.release()
    await file.release()
    assert slow.data(NEW) == b"short"


async def test_emptying_does_not_wait_for_ever() -> None:
    """The renames of a replacement are not called off; they may last longer than a call may."""
    async with rig("px4", {FILE: OLD}, options=ConnectOptions(op_deadline=50.0)) as here:
        tree = here.mount()
        await write_file(tree, OTHER, b"it")
        file = await begun(tree, FILE)
        here.faults.at(Opcode.RENAME, lambda: None, times=1000, drop=True)
        async with trio.open_nursery() as waiting:
            waiting.start_soon(file.fsync)
            await trio.sleep(5.0)
            before = trio.current_time()
            with pytest.raises(FileBusy):
                await tree.open(FILE, write=True, truncate=True)
            assert trio.current_time() - before == pytest.approx(30.0)
            here.faults.call_off()
        assert here.data(FILE) == DATA
        await file.release()


@pytest.mark.parametrize("nth", [1, 2, 3])
@pytest.mark.parametrize(("old", "new"), [(b"", b""), (OLD, b""), (OLD, OLD)])
@pytest.mark.parametrize("profile", ["px4-nuttx", "ardupilot5"])
async def test_what_was_taken_back_may_have_got_its_place(
    profile: str, old: bytes, new: bytes, nth: int
) -> None:
    """Nobody knows whether the card has what it had before: that is not to be taken for delivered."""
    async with rig(profile, {FILE: old}, options=QUICK) as here:
        tree = here.mount()
        file = await tree.open(FILE, write=True)
        await file.write(len(old), b"short" * 100)
        here.faults.at(Opcode.RENAME, lambda: here.faults.cut_after(0), nth=nth)
        with suppress(LinkError, RequestTimeout):
            await file.fsync()
        here.faults.call_off()
        here.faults.cut_after(None)
        await file.truncate(len(new))
        await file.fsync()
        assert here.data(FILE) == new
        await file.release()
        await settle(here, tree)
        assert here.files() == {FILE: new}
