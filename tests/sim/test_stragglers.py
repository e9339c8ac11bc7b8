"""A write request that the network held back, and that arrives when another file is open under the same id.

WriteFile carries a session id and an offset, and nothing that tells which file is meant (servers.md 1 and 8).
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import Connection
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.sources import MemorySource
from tests.support.worlds import ROOTS, World

DOUBLING = LinkSettings(delay=0.02, duplicate=1.0, reorder=0.1)
LATE = 0.1
"""Seconds after the end of its file: 2.5 round trips, when the next file's first bytes may be written."""

FIRST, SECOND = b"a" * 500, b"b" * 400


@pytest.fixture
def autojump() -> MockClock:
    return MockClock(autojump_threshold=0)


def hold_back_a_write(here: World, start: Callable[..., object]) -> None:
    """Have the first WriteFile come once more, LATE after the first Terminate."""
    server = here.vehicle.server
    handle = server.handle
    kept: list[tuple[bytes, Address]] = []

    async def arrive_late() -> None:
        await trio.sleep(LATE)
        handle(*kept[0], trio.current_time())

    def watch(wire: bytes, source: Address, now: float) -> None:
        if wire[3] == Opcode.WRITE_FILE and not kept:
            kept.append((wire, source))
        if wire[3] == Opcode.TERMINATE_SESSION and len(kept) == 1:
            kept.append(kept[0])
            start(arrive_late)
        handle(wire, source, now)

    server.handle = watch  # type: ignore[method-assign]


async def put(connection: Connection, path: bytes, data: bytes) -> None:
    upload = await connection.store.open_upload(path, MemorySource(data), create=True)
    await upload.finish()
    await upload.abort()


@pytest.mark.parametrize("profile", sorted(PROFILES))
async def test_a_late_write_does_not_reach_the_next_file(profile: str, autojump: MockClock) -> None:
    here = World(profile, DOUBLING)
    root = ROOTS.get(profile, b"") + b"/d"
    here.tree.add_directory(root)
    async with trio.open_nursery() as nursery, here.connection() as connection:
        await connection.store.list_directory(root)  # answered twice, which shows what this link does
        hold_back_a_write(here, nursery.start_soon)
        await put(connection, root + b"/first", FIRST)
        await put(connection, root + b"/second", SECOND)
    assert here.tree.data(root + b"/first") == FIRST
    assert here.tree.data(root + b"/second") == SECOND


async def test_a_link_that_keeps_the_order_costs_no_wait(autojump: MockClock) -> None:
    here = World("px4", LinkSettings(delay=0.02))
    here.tree.add_directory(b"/d")
    async with here.connection() as connection:
        await connection.store.list_directory(b"/d")
        began = trio.current_time()
        await put(connection, b"/d/first", FIRST)
        await put(connection, b"/d/second", SECOND)
        assert trio.current_time() - began < 8 * 0.04
