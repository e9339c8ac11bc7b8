"""Reading through the session: every size from every server, and where the server, the link or the moment is
unkind. Virtual time."""

from __future__ import annotations

from dataclasses import replace

import pytest
import trio

from mavftpfs.link.messages import Address, FtpRun
from mavftpfs.protocol.payload import MAX_DATA, Opcode, Payload
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.session.others import LEFT_OPEN
from mavftpfs.session.scheduler import ReadMode
from mavftpfs.shared.errors import (
    MavftpfsError,
    RemoteProtocolError,
)
from mavftpfs.sim.linkmodel import Duplex, LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.replies import request
from tests.support.rigs import Rig, rig
from tests.support.takingturns import taking_turns
from tests.support.transfers import ROOTS, begin_to_read, content, read_file

STRANGER = Address(255, 190)


BAD = LinkSettings(delay=0.02, loss=0.2, duplicate=0.02, reorder=0.05)
SIZES = (0, 1, 5, 238, 239, 240, 478, 4096, 35_850, 40_152, 119_500, 131_073)
EACH = pytest.mark.parametrize("profile", taking_turns(sorted(PROFILES)))
BOTH = pytest.mark.parametrize("mode", ["window", "burst"])


@BOTH
@EACH
async def test_every_size_comes_whole(profile: str, mode: ReadMode) -> None:
    files = {b"/s%d" % size: content(size, size) for size in SIZES}
    options, link = ConnectOptions(read_mode=mode), LinkSettings(delay=0.005)
    async with rig(profile, files, link=link, options=options) as here:
        for path, data in files.items():
            assert await read_file(here.connection, here.root + path) == data


@pytest.mark.holds("fault lost")
@BOTH
@EACH
async def test_little_of_a_large_file_is_asked_for_twice_over_a_bad_link(
    profile: str, mode: ReadMode
) -> None:
    data, options = content(300_000), ConnectOptions(read_mode=mode)
    async with rig(profile, {b"/big": data}, link=BAD, options=options) as here:
        assert await read_file(here.connection, here.root + b"/big") == data
        asked = here.count(Opcode.READ_FILE, Opcode.BURST_READ_FILE)
        assert asked <= 1.5 * (-(-len(data) // MAX_DATA)) / (1 - BAD.loss) ** 2
    assert here.server.open_sessions == 0


@BOTH
@pytest.mark.parametrize("profile", ["px4", "px4-2026", "ardupilot", "mavsdk"])
async def test_replies_may_be_shorter_than_asked(profile: str, mode: ReadMode) -> None:
    """As PX4 may clamp them to what a radio carries (servers.md 7)."""
    data = content(20_000)
    here = Rig(profile, {b"/big": data}, LinkSettings(delay=0.02))
    here.server.profile = here.server.firmware.profile = replace(here.server.profile, longest_reply=91)
    async with here.connected(ConnectOptions(read_mode=mode)) as connection:
        assert await read_file(connection, here.root + b"/big") == data


@BOTH
@pytest.mark.parametrize("profile", ["px4", "px4-2026", "mavsdk"])
async def test_a_clamp_may_come_and_go_while_a_file_is_read(profile: str, mode: ReadMode) -> None:
    """A signed link carries fewer bytes of a reply, and it may be signed only for a while."""
    data = content(60_000)
    here = Rig(profile, {b"/big": data}, LinkSettings(rate=20_000.0, delay=0.02))

    async def clamp() -> None:
        for longest in (91, MAX_DATA, 78, MAX_DATA) * 3:
            firmware = here.server.firmware
            here.server.profile = firmware.profile = replace(here.server.profile, longest_reply=longest)
            await trio.sleep(0.4)

    async with here.connected(ConnectOptions(read_mode=mode)) as connection, trio.open_nursery() as nursery:
        nursery.start_soon(clamp)
        assert await read_file(connection, here.root + b"/big") == data
        assert here.count(Opcode.READ_FILE) <= 3.5 * len(data) / MAX_DATA


async def test_a_card_that_pauses_is_not_asked_twice_over_usb() -> None:
    """Requests that go out during a pause only overflow the buffer of a server so near."""
    data = content(1_000_000)
    async with rig("px4-nuttx", {b"/big": data}, link=LinkSettings(delay=0.001)) as here:
        assert await read_file(here.connection, here.root + b"/big") == data
        assert here.count(Opcode.READ_FILE) <= 1.25 * (-(-len(data) // MAX_DATA))


@EACH
async def test_what_has_no_size_is_read_to_its_end_over_a_bad_link(profile: str) -> None:
    """Where a read may cross the end, the bytes are right; where it may not (MAVSDK), that is an error."""
    data = content(10_000)
    async with rig(profile, {b"/f": data}, link=BAD) as here:
        try:
            assert await here.connection.store.read_whole(here.root + b"/f", 20_000) == data
        except MavftpfsError:
            assert profile.startswith("mavsdk")


async def test_an_open_reply_without_a_size_is_an_error_at_once() -> None:
    async with rig("px4", {b"/f": b"hello"}, link=LinkSettings(delay=0.02)) as here:
        here.server.change = lambda request, reply: [
            reply._replace(size=0, data=b"") if request.opcode == Opcode.OPEN_FILE_RO else reply
        ]
        began = trio.current_time()
        with pytest.raises(RemoteProtocolError):
            await read_file(here.connection, b"/f")
        assert trio.current_time() - began < 2.0
        assert here.count(Opcode.OPEN_FILE_RO) == 1
        await trio.sleep(3)
        assert here.server.open_sessions == 0


@pytest.mark.holds("rule 14.31")
async def test_a_long_listing_with_times_is_not_taken_for_silence() -> None:
    here = Rig("mavsdk", link=LinkSettings(rate=5760.0, delay=0.1))
    for index in range(200):
        here.card.add(b"/d/file%03d" % index, b"x")
    async with here.connected() as connection:
        began = trio.current_time()
        listing = await connection.store.list_directory(b"/d")
        assert trio.current_time() - began > 3.0
        assert len(listing.entries) == 200
        assert all(entry.mtime is not None for entry in listing.entries)
        assert connection.engine.traits.lists_times is True
        assert not here.count(Opcode.LIST_DIRECTORY)


@pytest.mark.holds("rule 14.39")
@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_a_whole_read_beside_another_client_is_not_believed(profile: str) -> None:
    """Servers share session ids, and of an `@` file no checksum can prove the bytes. It is read once more,
    when the other client is done."""
    here = Rig(profile, link=LinkSettings(rate=5000.0, delay=0.02))
    data = content(20_000, 2)
    here.card.add(b"/f", data)
    async with here.connected() as connection, trio.open_nursery() as nursery:

        async def interfere() -> None:
            vehicle = connection.vehicle
            assert vehicle.address is not None
            for _ in range(12):
                await trio.sleep(1.0)
                session = connection.engine.home_session if profile == "ardupilot" else 0
                reply = Payload(9, session, Opcode.ACK, 0, Opcode.READ_FILE).encode()
                vehicle.on_message(FtpRun(vehicle.address, STRANGER, [reply]), trio.current_time())

        nursery.start_soon(interfere)
        began = trio.current_time()
        assert await connection.store.read_whole(b"/f", 100_000) == data
        assert trio.current_time() - began > 12.0 + LEFT_OPEN
        assert here.count(Opcode.OPEN_FILE_RO) == 2


@pytest.mark.holds("rule 14.12")
@pytest.mark.parametrize(
    ("profile", "loads"), [("px4", False), ("ardupilot", False), ("mavsdk", False), ("ardupilot5", True)]
)
async def test_files_are_read_beside_a_client_that_leaves_our_session_alone(
    profile: str, loads: bool
) -> None:
    """A ground station that shows directories all the time, or reads in a session of its own."""
    here = Rig(
        profile,
        {b"/f": content(120_000), b"/theirs": content(120_000, seed=9)},
        LinkSettings(rate=60_000.0, delay=0.02),
    )
    async with here.mounted(b"/") as tree, trio.open_nursery() as nursery:

        async def chatter() -> None:
            if loads:
                here.another_asks(Opcode.OPEN_FILE_RO, b"/theirs")
            while True:
                await trio.sleep(0.1)
                here.another_asks(*((Opcode.READ_FILE,) if loads else (Opcode.LIST_DIRECTORY, b"/")))

        if loads:
            assert await read_file(here.connection, b"/theirs")  # tells how session ids are given out
        nursery.start_soon(chatter)
        await trio.sleep(0.3)
        file = await tree.open(b"/f")
        assert bytes(await file.read(0, 120_000)) == content(120_000)
        if profile != "mavsdk":  # it has no files that need this
            assert await here.connection.store.read_whole(b"/f", 1 << 20) == content(120_000)
        assert here.connection.store.in_doubt()
        file.close()
        nursery.cancel_scope.cancel()


@pytest.mark.holds("promise 5")
@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_a_whole_read_survives_a_lost_session(profile: str) -> None:
    here = Rig(profile, link=LinkSettings(rate=5000.0, delay=0.02))
    data = content(20_000, 2)
    here.card.add(b"/f", data)
    async with here.connected() as connection, trio.open_nursery() as nursery:

        async def close_it() -> None:
            await trio.sleep(2.0)
            session = connection.scheduler.server.opened
            assert session is not None
            wire = request(777, Opcode.TERMINATE_SESSION, session=session.id).encode()
            now, own = trio.current_time(), connection.vehicle.own
            here.vehicle.foreign_request(wire, own, now, audible=False)

        nursery.start_soon(close_it)
        assert await connection.store.read_whole(b"/f", 100_000) == data
        assert here.count(Opcode.OPEN_FILE_RO) == 2


@pytest.mark.parametrize(("pause", "doubted"), [(2.0, True), (11.0, False)])
async def test_what_was_read_shortly_before_is_under_suspicion_though_closed(
    pause: float, doubted: bool
) -> None:
    async with rig("px4", {b"/f": b"hello"}, link=LinkSettings(delay=0.02)) as here:
        file = await here.mount().open(b"/f")
        assert await file.read(0, 5) == b"hello"
        file.close()
        await trio.sleep(pause)
        here.another_asks(Opcode.NONE)
        await trio.sleep(0.5)
        assert here.connection.scheduler.server.others.heard_at > 0.0
        assert here.invalidated == ([b"/f"] if doubted else [])
        here.connection.scheduler.server.distrust(reads=True)
        assert len(here.invalidated) == doubted, "those bytes are gone"


@pytest.mark.holds("rule 14.31")
async def test_times_that_could_not_be_asked_for_are_not_refused() -> None:
    """While a stale session is waited out nobody may speak: that is our silence, not the server's."""
    here = Rig("ardupilot5", {b"/d/f": b"x"}, LinkSettings(delay=0.02))
    async with here.connected() as connection, trio.open_nursery() as nursery:

        async def keep_quiet() -> None:
            await connection.driver.be_silent(3.5)

        for _ in range(3):
            nursery.start_soon(keep_quiet)
            await trio.sleep(0.01)
            await connection.store.list_directory(b"/d")
        assert connection.engine.traits.lists_times is None
        await connection.store.list_directory(b"/d")
        assert connection.engine.traits.lists_times is True


@pytest.mark.holds("rule 14.15")
@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
async def test_bursts_through_the_caches(profile: str) -> None:
    """Whole, in the middle, behind what is there, and two files in turns, over a bad link."""
    here = Rig(
        profile, link=LinkSettings(rate=200_000.0, delay=0.02, loss=0.02, duplicate=0.01, reorder=0.02)
    )
    files = {b"/f": content(300_000, 3), b"/g": content(239 * 500, 4)}
    for path, data in files.items():
        here.card.add(path, data)
    async with here.connected(ConnectOptions(read_mode="burst")):
        tree = here.mount(root=b"/", cache_size=1 << 20)
        opened = {path: await tree.open(path) for path in files}

        async def read_all(path: bytes, start: int) -> None:
            for offset in range(start, len(files[path]), 131_072):
                data = await opened[path].read(offset, 131_072)
                assert bytes(data) == files[path][offset : offset + 131_072]

        assert bytes(await opened[b"/f"].read(150_001, 10)) == files[b"/f"][150_001:150_011]
        async with trio.open_nursery() as nursery:
            nursery.start_soon(read_all, b"/f", 1)
            nursery.start_soon(read_all, b"/g", 0)
        for file in opened.values():
            await file.release()
        assert here.count(Opcode.BURST_READ_FILE) >= 5
        assert here.count(Opcode.READ_FILE) < 300_000 / 239 / 2
    assert here.server.open_sessions == 0


@pytest.mark.holds("rule 14.18")
@pytest.mark.parametrize("profile", ["mavsdk", "px4", "px4-nuttx"])
async def test_beside_bursts_that_fill_the_radio_a_listing_is_answered(profile: str) -> None:
    """One burst after the other left no room for the answer in a short queue, and nothing was asked again."""
    radio = LinkSettings(rate=5760.0, delay=0.025, duplex=Duplex.HALF, queue=2048)
    data = content(150_000)
    here = Rig(profile, {b"/d/big": data}, radio)
    root = ROOTS.get(profile, b"") + b"/d"
    for number in range(20):
        here.card.add(root + b"/fresh%d/f" % number, b"small")
    async with here.connected(ConnectOptions(read_mode="burst")) as connection:
        reader, sink = await begin_to_read(connection, root + b"/big", 0)
        for _ in range(4):
            listing = await connection.store.list_directory(root)
            assert len(listing.entries) == 21
            await trio.sleep(0.7)
        assert await sink.wait_for(0, len(data)) == data
        assert here.count(Opcode.BURST_READ_FILE) >= 4
        reader.close()
