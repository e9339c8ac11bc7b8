"""A file that others replace while it is open, or the vehicle restarts under it: one version or an error.

The server's session is closed when nobody wanted bytes for a while, and opened anew. Virtual time.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
import trio

from mavftpfs.cache import reading
from mavftpfs.cache.handles import ReadHandle
from mavftpfs.cache.tree import OpenFile, Tree
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.shared.errors import Armed, FileChanged
from mavftpfs.shared.model import split
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.rigs import Rig, rig, write_file
from tests.support.transfers import content

pytestmark = pytest.mark.holds("fault replaced file")

OLD = content(120_000, 1)
NEW = content(160_000, 2)
STEP = 16_384
THEN = 1_700_000_000
PATH = b"/big"
LINK = LinkSettings(rate=200_000.0, delay=0.01)
SLOW = LinkSettings(rate=12_000.0, delay=0.02)

IDLE = 4.0
"""Seconds after which the session is closed."""

TIMED = ["mavsdk", "ardupilot5"]
"""Listings tell times: sessions for many files, and one for all."""

EVERY = [*TIMED, "px4"]


def replace(here: Rig, data: bytes = NEW[: len(OLD)], mtime: int = THEN + 100) -> None:
    """Move another file over it, as others would."""
    here.replace(PATH, data, mtime)


@asynccontextmanager
async def mounted(profile: str, link: LinkSettings = LINK) -> AsyncIterator[tuple[Rig, Tree]]:
    """Mount a vehicle that has the file."""
    async with rig(profile, link=link) as here:
        here.put(PATH, OLD, THEN)
        yield here, here.mount()


@asynccontextmanager
async def opened(profile: str, link: LinkSettings = LINK) -> AsyncIterator[tuple[Rig, Tree, OpenFile]]:
    """Mount it and open the file."""
    async with mounted(profile, link) as (here, tree):
        handle = await tree.open(PATH)
        yield here, tree, handle
        handle.close()


async def read_on(handle: OpenFile, start: int = 0) -> bytes:
    """Read from there to the end."""
    return b"".join([bytes(await handle.read(at, STEP)) for at in range(start, handle.size, STEP)])


async def copy(tree: Tree, path: bytes = PATH) -> bytes:
    """Open, read to the end and close, as cp does."""
    handle = await tree.open(path)
    try:
        return await read_on(handle)
    finally:
        handle.close()


async def read_head(handle: OpenFile) -> None:
    """Read the first bytes, and wait until the session is closed."""
    assert await handle.read(0, STEP) == OLD[:STEP]
    await trio.sleep(IDLE)


@pytest.mark.holds("fault reboot", "fault boot time asked")
@pytest.mark.parametrize("unasked", [True, False])
@pytest.mark.parametrize(
    ("profile", "size"), [("mavsdk", 120_000), ("ardupilot5", 100_000), ("px4", 160_000), ("px4", None)]
)
async def test_a_copy_over_a_reboot_is_of_one_version(profile: str, size: int | None, unasked: bool) -> None:
    """size: of the successor; None = the file stays. unasked: the vehicle tells its boot time so. Where
    listings tell no times, nothing but the size tells a successor."""
    async with mounted(profile, SLOW) as (here, tree), trio.open_nursery() as nursery:
        here.vehicle.tells_time = unasked
        here.vehicle.reboot(trio.current_time() - 5.0)
        await trio.sleep(10)  # a boot time has to go back by some seconds to tell of a restart

        async def reboot() -> None:
            await trio.sleep(4.5)
            here.vehicle.reboot(trio.current_time(), downtime=4.0)
            if size:
                replace(here, NEW[:size])

        nursery.start_soon(reboot)
        if size:
            with pytest.raises(FileChanged):
                await copy(tree)
        else:
            assert await copy(tree) == OLD
        assert here.connection.vehicle.reboots == 1
        assert await copy(tree) == (NEW[:size] if size else OLD)


@pytest.mark.parametrize("profile", [*EVERY, "px4-2026"])
async def test_to_open_a_replaced_file_twice_costs_no_request_more(profile: str) -> None:
    """The first open() of a mount is answered with ESTALE: the kernel looks the name up, and opens again."""
    requests: list[int] = []
    for opens in (1, 2):
        async with opened(profile) as (here, tree, handle):
            await read_on(handle)
            await trio.sleep(30.0)
            replace(here, NEW)
            await trio.sleep(30.0)
            before = here.count(*Opcode)
            for _ in range(opens - 1):
                (await tree.open(PATH)).close()
            assert await copy(tree) == NEW
            await trio.sleep(IDLE)
            requests.append(here.count(*Opcode) - before)
    assert requests[0] == requests[1]


async def test_listings_without_times_do_not_keep_an_old_version_for_programs_that_open_it() -> None:
    """A program has the old one open."""
    async with opened("px4") as (here, tree, handle):
        await read_on(handle)
        replace(here)
        for _ in range(6):
            await trio.sleep(5.0)
            await tree.list(split(PATH)[0])
        assert await copy(tree) == NEW[: len(OLD)]


@pytest.mark.parametrize("profile", TIMED)
@pytest.mark.parametrize("closed", [False, True])
async def test_nobody_gets_the_head_of_one_file_and_the_rest_of_another(profile: str, closed: bool) -> None:
    """closed: the program closed the file after it got the head, which is cached."""
    async with opened(profile) as (here, tree, handle):
        await read_head(handle)
        if closed:
            handle.close()
        replace(here)
        with pytest.raises(FileChanged):
            await (copy(tree) if closed else read_on(handle, STEP))
        assert await copy(tree) == NEW[: len(OLD)]


async def test_a_read_whose_bytes_fell_into_doubt_leaves_the_reader_of_another_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with opened("px4") as (here, _, handle):
        assert isinstance(handle, ReadHandle)
        blocks, readers, prove = handle.file.blocks, [], reading._prove

        async def doubt_comes(*args: object, **kwargs: object) -> None:
            monkeypatch.setattr(reading, "_prove", prove)
            here.connection.scheduler.server.distrust(reads=True)
            await handle.read(STEP, STEP)  # opens the file anew
            readers.append(blocks.reader)

        monkeypatch.setattr(reading, "_prove", doubt_comes)
        assert await handle.read(0, STEP) == OLD[:STEP]
        assert blocks.reader is readers[0]


@pytest.mark.parametrize("grown", [False, True])
@pytest.mark.parametrize("profile", EVERY)
async def test_the_same_file_is_read_on(profile: str, grown: bool) -> None:
    """One that grew, to its opened size. Where listings tell no times none is asked for."""
    async with opened(profile) as (here, tree, handle):
        sweeps = tree.status()["listings_asked"]
        parts = []
        for start in range(0, len(OLD), 40_000):
            await trio.sleep(IDLE)
            if grown:
                replace(here, OLD + b"more", THEN + 1 + start)
            parts.append(bytes(await handle.read(start, 40_000)))
        assert b"".join(parts) == OLD
        assert profile in TIMED or tree.status()["listings_asked"] == sweeps


# --- changes of it wait here: what goes to the card is of one file

MID = b"mid"
SUCCESSOR = NEW[: len(OLD)]


async def wait_and_replace(here: Rig) -> None:
    """Have the server's session closed, and the file replaced."""
    await trio.sleep(IDLE)
    replace(here)


async def read_and_write(here: Rig, tree: Tree, writer: OpenFile) -> None:
    assert bytes(await writer.read(0, STEP)) == OLD[:STEP]
    await writer.write(100, MID)
    await wait_and_replace(here)


async def write_only(here: Rig, tree: Tree, writer: OpenFile) -> None:
    await writer.write(100, MID)
    await wait_and_replace(here)


async def write_late(here: Rig, tree: Tree, writer: OpenFile) -> None:
    """The program read no bytes that could be compared: the time of the open decides."""
    await wait_and_replace(here)
    await writer.write(100, MID)


async def write_again(here: Rig, tree: Tree, writer: OpenFile) -> None:
    await writer.write(100, MID)
    await writer.fsync()
    await wait_and_replace(here)
    await writer.write(300, MID)


async def write_and_list(here: Rig, tree: Tree, writer: OpenFile) -> None:
    """The first listing that shows a time for the delivered file shows the successor's."""
    await writer.write(100, MID)
    await writer.fsync()
    await trio.sleep(30.0)
    replace(here)
    await tree.list(b"/")
    await writer.write(300, MID)


async def cut(here: Rig, tree: Tree, writer: OpenFile) -> None:
    await wait_and_replace(here)
    await writer.truncate(1000)


@pytest.mark.parametrize("change", [read_and_write, write_only, write_late, write_again, write_and_list, cut])
@pytest.mark.parametrize("profile", TIMED)
async def test_a_change_of_the_old_file_does_not_go_into_its_successor(profile: str, change: object) -> None:
    """A file that is written whole does."""
    async with mounted(profile) as (here, tree):
        writer = await tree.open(PATH, write=True)
        await change(here, tree, writer)  # type: ignore[operator]
        for _ in range(2):
            with pytest.raises(FileChanged):
                await writer.fsync()
        assert here.data(PATH) == SUCCESSOR
        await writer.truncate(0)
        await writer.write(0, b"whole")
        await writer.release()
        assert here.data(PATH) == b"whole"


async def test_the_end_of_a_copy_by_turns_is_compared() -> None:
    """Between two comparisons the reader gets unproven bytes, except for the last ones."""
    async with opened("ardupilot5") as (here, tree, handle):
        await read_head(handle)
        listing = tree._card.directories.known(split(PATH)[0])
        assert listing is not None
        listing.ended_at = float("inf")  # so it is never listed again only to compare
        replace(here)
        with pytest.raises(FileChanged):
            await read_on(handle, STEP)


@pytest.mark.parametrize("profile", TIMED)
async def test_turns_of_two_readers_cost_few_listings(profile: str) -> None:
    async with mounted(profile) as (here, tree):
        here.put(b"/second", OLD, THEN)
        here.put(b"/third", OLD, THEN)
        await tree.stat(PATH)
        before, began = int(str(tree.status()["listings_asked"])), trio.current_time()
        got: list[bytes] = []

        async def one(path: bytes) -> None:
            got.append(await copy(tree, path))

        async with trio.open_nursery() as nursery:
            nursery.start_soon(one, b"/second")
            nursery.start_soon(one, b"/third")
        assert got == [OLD] * 2
        asked = int(str(tree.status()["listings_asked"])) - before
        assert asked <= 2 * ((trio.current_time() - began) / 2.0 + 2)


@pytest.mark.parametrize("profile", EVERY)
@pytest.mark.parametrize("size", [len(OLD), len(OLD) - 1])
async def test_an_open_for_writing_that_is_refused_proves_nothing_of_the_old_bytes(
    profile: str, size: int
) -> None:
    """The vehicle is armed while the open waits for a listing, after others replaced the file."""
    async with mounted(profile) as (here, tree):
        assert await copy(tree) == OLD
        await trio.sleep(30.0)
        replace(here, NEW[:size])
        async with trio.open_nursery() as nursery:

            async def arm() -> None:
                await trio.sleep(LINK.delay)
                tree.armed_changed(True)

            nursery.start_soon(arm)
            with pytest.raises(Armed):
                await tree.open(PATH, write=True, truncate=True)
        tree.armed_changed(False)
        handle = await tree.open(PATH)
        assert not handle.keep_cache
        assert await read_on(handle) == NEW[:size]
        handle.close()


async def test_a_truncation_by_name_that_notices_another_file_tells_those_who_read_the_old_one() -> None:
    """A checksum tells it, where listings tell no times."""
    async with rig("px4") as here:
        tree = here.mount()
        await write_file(tree, PATH, OLD)
        handle = await tree.open(PATH)
        assert await handle.read(0, STEP) == OLD[:STEP]
        replace(here)
        with pytest.raises(FileChanged):
            await tree.truncate(PATH, STEP)
        with pytest.raises(FileChanged):
            await read_on(handle, STEP)
        assert await copy(tree) == NEW[: len(OLD)]
        handle.close()


LARGE, CHANGE = 300_000, b"x" * 100
ONE, TWO = content(LARGE, 5), content(LARGE, 6)
QUICK = ConnectOptions(op_deadline=5.0)


async def replace_while_the_rest_is_fetched(here: Rig) -> None:
    """Be silent in the middle of fetching, of which the program hears nothing, and have the file replaced."""
    here.faults.cut_after(700)
    await trio.sleep(20)
    here.faults.cut_after(None)
    here.replace(PATH, TWO, THEN + 100)


@pytest.mark.parametrize("profile", ["px4", "mavsdk"])
async def test_the_rest_of_a_changed_file_is_of_one_version(profile: str) -> None:
    """px4: listings tell no times."""
    files = {PATH: ONE, b"/large": content(2_000_000, 9)}
    async with rig(profile, files, options=QUICK) as here:
        tree = here.mount(op_deadline=5.0, cache_size=1 << 20)
        file = await tree.open(PATH, write=True)
        await file.write(290_000, CHANGE)
        await replace_while_the_rest_is_fetched(here)
        await copy(tree, b"/large")  # the blocks of the file leave the cache
        with pytest.raises(FileChanged):
            await file.flush()
        await trio.sleep(100)
        assert here.data(PATH) == TWO
        file.close()


@pytest.mark.parametrize("when", ["never", "before", "meanwhile"])
async def test_the_rest_of_a_file_that_is_cut_is_of_one_version(when: str) -> None:
    """Listings tell no times; nothing leaves the cache."""
    async with rig("px4", {PATH: ONE}, options=QUICK) as here:
        tree = here.mount(op_deadline=5.0)
        file = await tree.open(PATH, write=True)
        if when == "before":
            await file.truncate(250_000)
        await file.write(1_000, CHANGE)
        await replace_while_the_rest_is_fetched(here)
        if when == "meanwhile":
            await file.truncate(250_000)
        with pytest.raises(FileChanged):
            await file.release()
        await trio.sleep(60)
        assert here.data(PATH) == TWO


async def test_bytes_that_are_read_before_a_file_is_cut_are_not_mixed_with_its_successors() -> None:
    async with rig("px4", {PATH: ONE}) as here:
        tree = here.mount()
        file = await tree.open(PATH, write=True)
        assert bytes(await file.read(0, STEP)) == ONE[:STEP]
        here.replace(PATH, TWO, THEN + 100)
        await file.truncate(250_000)
        await file.write(1_000, CHANGE)
        with pytest.raises(FileChanged):
            await file.release()
        assert here.data(PATH) == TWO


async def test_fetched_bytes_that_come_late_do_not_fill_the_next_version(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A listing of a long directory is waited for, and meanwhile the program writes another file."""
    async with mounted("mavsdk") as (here, tree):
        file = await tree.open(PATH, write=True)
        await file.write(40_000, CHANGE)
        prove, proceed, entered = reading._prove, trio.Event(), trio.Event()

        async def slow(*args: Any, **kwargs: Any) -> None:
            entered.set()
            await proceed.wait()
            await prove(*args, **kwargs)

        monkeypatch.setattr(reading, "_prove", slow)
        await entered.wait()
        monkeypatch.setattr(reading, "_prove", prove)
        await file.truncate(0)
        await file.write(40_000, b"y" * 10_000)
        await file.fsync()
        expected = bytes(40_000) + b"y" * 10_000
        assert here.data(PATH) == expected
        proceed.set()
        await trio.sleep(10)
        assert bytes(await file.read(0, 50_000)) == expected
        await file.write(49_000, b"z")
        await file.release()
        assert here.data(PATH) == expected[:49_000] + b"z" + expected[49_001:]


@pytest.mark.parametrize("profile", TIMED)
async def test_a_program_that_read_the_end_first_gets_one_version(profile: str) -> None:
    """As unzip reads. No later read of the end proves its bytes."""
    async with opened(profile) as (here, tree, handle):
        assert await handle.read(len(OLD) - STEP, STEP) == OLD[-STEP:]
        listing = tree._card.directories.known(split(PATH)[0])
        assert listing is not None
        listing.ended_at = float("inf")
        await trio.sleep(IDLE)
        replace(here)
        with pytest.raises(FileChanged):
            await handle.read(0, STEP)
