"""Calls that overlap: with the release of a file, with its delivery, with changes of its name.

If a program removes, renames over or empties a file while the mount delivers it, the mount cancels the
delivery. A local disk does that at once, whatever the size, and fsync and close of a file without a name
succeed. Here it costs a few round trips, at any moment of a delivery; the old file stays until there is
another one, and nothing of a removed file comes back or stays on the card.
"""

from __future__ import annotations

import errno
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.throttle import UNMEASURED
from mavftpfs.cache.tree import Tree
from mavftpfs.cache.writing import QUIET
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.shared.errors import FileChanged, FtpNak, LinkError, MavftpfsError, NotFound, RequestTimeout
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.rigs import KINDS, RENAMING, Rig, card, open_to_copy, rig
from tests.support.transfers import content

FILE, NEW, OTHER = b"/d/file", b"/d/new", b"/d/other"
OLD, LATER = b"old" * 300, b"new" * 300
"""As long as one another: no size tells them apart."""
DATA = content(7680)
FAR = LinkSettings(delay=0.05)
SLOW = LinkSettings(rate=3000.0, queue=2000, delay=0.02)
QUICK = ConnectOptions(op_deadline=5.0)
PROMPT = 2.0
"""Seconds for a few round trips, with what is in the queue of a slow link at the time."""

slow = card({FILE: OLD, OTHER: OLD}, profiles=["px4", "ardupilot5", "mavsdk"], link=SLOW, options=QUICK)


async def begun(tree: Tree, path: bytes, data: bytes = DATA) -> OpenFile:
    """Return a file that is written whole and not delivered."""
    file = await open_to_copy(tree, path)
    await file.write(0, data)
    return file


@asynccontextmanager
async def in_the_middle(file: OpenFile, waiting: int = 1) -> AsyncIterator[None]:
    """Enter when so many tasks have waited for the delivery for a second; leaving waits for its end."""
    async with trio.open_nursery() as nursery:
        for _ in range(waiting):  # one delivers, the others wait for their turn
            nursery.start_soon(file.fsync)
        await trio.sleep(1.05)
        yield


async def settle(here: Rig, tree: Tree) -> None:
    """Wait for everything that follows by itself; no temporary file stays."""
    for _ in range(2):
        await trio.sleep(8)
        tree.forget_caches()
        await tree.list(b"/d")
    assert here.litter() == []
    assert tree.undelivered() == []


# --- the release of a file


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("profile", KINDS)
async def test_a_file_that_is_read_and_changed_a_second_after_its_last_change(profile: str) -> None:
    """The rest of a changed file is fetched when its program pauses. This one has closed it, and opened it
    again to read."""
    async with rig(profile, {FILE: DATA}, link=LinkSettings(delay=0.02)) as here:
        tree = here.mount(inplace=True)
        file = await tree.open(FILE, write=True)
        await file.write(0, b"1")
        changed = trio.current_time()
        await file.flush()
        await file.release()
        file = await tree.open(FILE, write=True)
        assert bytes(await file.read(0, 9)) == b"1" + DATA[1:9]
        await trio.sleep_until(changed + QUIET + 0.01)
        await file.write(1, b"2")
        await file.flush()
        await file.release()
        assert here.data(FILE) == b"12" + DATA[2:]


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


async def program(tree: Tree, opening: str, later: float, change: str) -> None:
    """Open at that time, use the file and close; the only error allowed is that the file is gone."""
    await trio.sleep(later)
    try:
        file = await OPENINGS[opening](tree)
    except NotFound:
        return
    with suppress(*() if change == "rename" or opening == "emptier" else (FileChanged,)):
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
    """An open in between would be of neither the old file nor the new one."""
    act, left, base = CHANGES[change]
    for later in (-6, -3, 1, 3, 5):
        async with rig(profile, {FILE: OLD, OTHER: LATER}, link=FAR) as here:
            tree = here.mount()
            await tree.list(b"/d")
            async with trio.open_nursery() as both:
                both.start_soon(program, tree, opening, max(later, 0) * 0.05, change)
                await trio.sleep(max(-later, 0) * 0.05 + 0.001)
                await act(tree)
            assert await tree.drain(60) == []
            assert list(here.files()) == [left]
            written = () if change == "unlink" else (base[:3] + b"mid" + base[6:], b"\0\0\0mid")
            assert here.data(left) in (base, *written)


@pytest.mark.holds("fault overlap")
async def test_a_reader_never_gets_bytes_of_what_replaces_its_file() -> None:
    """Another handle delivered the file, so the next read opens it anew: at any moment."""
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


BYTES, NEWER = content(3000, 1), content(3500, 2)
RADIO = LinkSettings(rate=6000.0, delay=0.05)


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("profile", ["px4-nuttx", "mavsdk"])
async def test_a_file_gets_another_name_while_it_is_written(profile: str) -> None:
    """Then the card has the accepted bytes, and the program goes on; some servers get all bytes again."""
    piece = content(32768)
    async with rig(profile, {b"/d/z": b""}, link=LinkSettings(rate=20_000.0, delay=0.05)) as here:
        tree = here.mount()
        file = await tree.create(FILE, exclusive=True)

        async def write() -> None:
            for number in range(12):
                await file.write(number * len(piece), piece)
            await file.flush()
            await file.release()

        async with trio.open_nursery() as nursery:
            nursery.start_soon(write)
            await trio.sleep(10)
            await tree.rename(FILE, OTHER)
            assert len(here.data(OTHER)) >= 2 * len(piece)
        assert here.data(OTHER) == 12 * piece


@pytest.mark.parametrize("profile", RENAMING)
async def test_the_old_file_stays_while_nobody_waits(profile: str) -> None:
    """The mount cancels for good a delivery that it retries by itself, after the link was cut."""
    async with rig(profile, {FILE: BYTES}, link=RADIO) as here:
        tree = here.mount()
        await tree.list(b"/d")
        file = await begun(tree, FILE, content(60_000))
        here.faults.cut_after(60)
        with pytest.raises(MavftpfsError):
            await file.release()
        here.faults.cut_after(None)
        await trio.sleep(5)
        began = trio.current_time()
        file = await tree.open(FILE, write=True, truncate=True)
        assert trio.current_time() - began < PROMPT
        await trio.sleep(100)
        assert here.data(FILE) == BYTES
        await file.write(0, NEWER)
        await file.release()
        assert here.data(FILE) == NEWER


@pytest.mark.holds("fault overlap")
async def test_a_removal_that_was_given_up_loses_nothing(slow: Rig) -> None:
    """The removal had ended the upload, so the file that the upload left on the vehicle is this mount's. (A
    new file is removed at once.)"""
    tree, data = slow.mount(), content(70_000)
    file = await begun(tree, FILE, data)
    await trio.sleep(1.05)
    with trio.move_on_after(0.01) as scope:
        await tree.unlink(FILE)
    assert scope.cancelled_caught
    await trio.sleep(5)
    await file.fsync()
    assert slow.data(FILE) == data
    await file.release()
    await settle(slow, tree)


# --- files that are emptied while what they held is on its way


async def test_emptying_waits_for_no_room(slow: Rig) -> None:
    """A writer that is too fast has to wait. One that empties the file makes room, also for the other."""
    tree = slow.mount()
    file = await tree.create(NEW, exclusive=True)
    await file.write(0, content(2 * UNMEASURED))
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


@pytest.mark.parametrize("profile", RENAMING)
async def test_emptying_calls_off_a_delivery_that_waits_for_its_path(profile: str) -> None:
    """A rename has the path, and no answer. All of the file was sent before it was emptied."""
    async with rig(profile, {FILE: OLD}, options=ConnectOptions(op_deadline=50.0)) as here:
        tree = here.mount()
        file = await tree.open(FILE, write=True)
        here.faults.at(Opcode.RENAME, lambda: None, times=1000, drop=True)
        async with trio.open_nursery() as renaming:
            renaming.start_soon(tree.rename, FILE, NEW)
            await trio.sleep(1.0)
            await file.write(0, LATER)
            async with trio.open_nursery() as waiting:
                waiting.start_soon(file.fsync)
                await trio.sleep(1.0)
                here.faults.call_off()
                await file.truncate(0)
                assert here.count(Opcode.WRITE_FILE) == 0
        await file.write(0, b"it")
        await file.release()
        await settle(here, tree)
        assert here.files() == {NEW: b"it"}


@pytest.mark.parametrize("nth", [1, 2, 3])
@pytest.mark.parametrize(("old", "new"), [(b"", b""), (OLD, b""), (OLD, OLD)])
@pytest.mark.parametrize("profile", ["px4-nuttx", "ardupilot5"])
async def test_what_was_taken_back_may_have_got_its_place(
    profile: str, old: bytes, new: bytes, nth: int
) -> None:
    """The mount must not count the new file as delivered, because the card may still have the old one."""
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
