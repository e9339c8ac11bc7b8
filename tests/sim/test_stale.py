"""A session that is not ours keeps our requests out: a killed client's goes away, a living one's is told."""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.link.messages import Address
from mavftpfs.protocol.operations import OpenFile
from mavftpfs.protocol.payload import Opcode, request
from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.shared.errors import FtpNak, SessionBusy
from tests.support.worlds import World


def ardupilot() -> World:
    here = World("ardupilot")
    here.tree.mkdir(b"/d")
    return here


def others_session(connection: Connection) -> int:
    """An id that this connection asks for never."""
    return connection.engine.home_session % 255 + 1


async def open_elsewhere(connection: Connection) -> None:
    """Leave a session open under an id that is not this connection's, as a killed client does."""
    await connection.driver.run(OpenFile(Opcode.CREATE_FILE, b"/d/left", others_session(connection)))


@pytest.mark.holds("fault stale session")
async def test_a_listing_outlasts_the_session_of_a_killed_client(autojump_clock: MockClock) -> None:
    here = ardupilot()
    async with here.connection() as connection:
        await open_elsewhere(connection)
        began = trio.current_time()
        listing = await connection.store.list_directory(b"/d")
        assert [entry.name for entry in listing.entries] == [b"left"]
        assert 3 < trio.current_time() - began < 5
        assert (
            connection.engine.stats.naks == 1 + 2
        )  # opcode 16 is unknown there, and a listing ends with one
        assert not connection.scheduler.server.kept_out


async def test_listings_at_once_do_not_keep_the_dead_session_alive(autojump_clock: MockClock) -> None:
    here = ardupilot()
    async with here.connection() as connection, trio.open_nursery() as nursery:
        await open_elsewhere(connection)
        began = trio.current_time()

        async def look(after: float) -> None:
            await trio.sleep(after)
            await connection.store.list_directory(b"/d")
            assert trio.current_time() - began < 6

        for number in range(5):
            nursery.start_soon(look, number / 2)


async def test_a_session_in_use_is_told_in_time_and_is_not_asked_for_often(autojump_clock: MockClock) -> None:
    here = ardupilot()
    options = ConnectOptions(op_deadline=20.0)
    async with here.connection(options) as connection, trio.open_nursery() as nursery:
        await open_elsewhere(connection)
        wire = request(77, Opcode.NONE, session=others_session(connection)).encode()

        async def keep_in_use() -> None:
            while True:
                here.vehicle.server.handle(wire, Address(255, 190), trio.current_time())
                await trio.sleep(1)

        nursery.start_soon(keep_in_use)
        began = trio.current_time()
        with pytest.raises(SessionBusy):
            await connection.store.list_directory(b"/d")
        assert 10 < trio.current_time() - began < 20
        assert connection.engine.stats.naks == 3
        assert connection.scheduler.server.kept_out
        nursery.cancel_scope.cancel()


async def test_another_refusal_is_told_at_once(autojump_clock: MockClock) -> None:
    here = ardupilot()
    async with here.connection() as connection:
        began = trio.current_time()
        with pytest.raises(FtpNak):
            await connection.store.list_directory(b"/missing")
        assert trio.current_time() - began < 1


async def test_a_change_outlasts_it_too(autojump_clock: MockClock) -> None:
    here = ardupilot()
    async with here.connection() as connection:
        await open_elsewhere(connection)
        began = trio.current_time()
        await connection.store.make_directory(b"/d/new")
        assert 3 < trio.current_time() - began < 5
        listing = await connection.store.list_directory(b"/d")
        assert {entry.name for entry in listing.entries} == {b"left", b"new"}
