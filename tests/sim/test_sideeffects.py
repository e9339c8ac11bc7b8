"""Requests that change names, against every profile: done once, or the caller is told."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Literal

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.crc import crc32
from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import Connection, ConnectOptions
from mavftpfs.session.store import Store
from mavftpfs.shared.errors import Armed, FileChanged, FtpNak, PathTooLong, RequestTimeout
from mavftpfs.shared.model import join
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES, Storage
from mavftpfs.sim.tree import Kind
from tests.support.faults import Faults
from tests.support.sources import MemorySource
from tests.support.takingturns import taking_turns
from tests.support.uploads import know
from tests.support.worlds import ROOTS, World, begin_to_read, content, path, read_file, world

EVERY_PROFILE = sorted(PROFILES)
RENAMING = [name for name in EVERY_PROFILE if PROFILES[name].storage is not Storage.LITTLEFS]
BAD = LinkSettings(rate=60_000.0, delay=0.02, loss=0.25)


def names(here: World) -> list[bytes]:
    found = [entry.name for entry in here.tree.entries(path(here.profile, ""))]
    return sorted(name for name in found if name not in (b".", b".."))


@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
@pytest.mark.parametrize("seed", range(2))
async def test_each_works_over_a_link_that_loses_much(profile: str, seed: int, autojump: MockClock) -> None:
    here = World(profile, BAD, seed=seed)
    here.tree.add(path(profile, "old"), b"content")
    renames = profile in RENAMING
    async with here.connection(ConnectOptions(op_deadline=60.0)) as connection:
        store = connection.store
        await store.make_directory(path(profile, "sub"))
        await store.create_empty(path(profile, "empty"))
        assert await store.stat_size(path(profile, "old")) == 7
        if renames:
            await store.rename(path(profile, "old"), path(profile, "sub/new"))
            await store.rename(path(profile, "sub"), path(profile, "moved"))
            assert here.tree.data(path(profile, "moved/new")) == b"content"
            await store.remove(path(profile, "moved/new"))
            await store.remove_directory(path(profile, "moved"))
        else:
            await store.remove(path(profile, "old"))
            await store.remove_directory(path(profile, "sub"))
        assert names(here) == [b"empty"]
        await store.remove(path(profile, "empty"))
        assert names(here) == []
        await trio.sleep(5)
        assert here.vehicle.server.open_sessions == 0


Act = Callable[[Store, str], Awaitable[None]]

ACTS: dict[str, tuple[Opcode, Act, list[bytes]]] = {
    "mkdir": (
        Opcode.CREATE_DIRECTORY,
        lambda store, profile: store.make_directory(path(profile, "new")),
        [b"dir", b"file", b"new"],
    ),
    "remove": (Opcode.REMOVE_FILE, lambda store, profile: store.remove(path(profile, "file")), [b"dir"]),
    "rmdir": (
        Opcode.REMOVE_DIRECTORY,
        lambda store, profile: store.remove_directory(path(profile, "dir")),
        [b"file"],
    ),
    "rename": (
        Opcode.RENAME,
        lambda store, profile: store.rename(path(profile, "file"), path(profile, "new")),
        [b"dir", b"new"],
    ),
    "create": (
        Opcode.CREATE_FILE,
        lambda store, profile: store.create_empty(path(profile, "new")),
        [b"dir", b"file", b"new"],
    ),
}


@pytest.mark.holds("fault refused retry")
@pytest.mark.parametrize("profile", EVERY_PROFILE)
@pytest.mark.parametrize("act", sorted(ACTS))
async def test_a_lost_reply_is_found_out(profile: str, act: str, autojump: MockClock) -> None:
    """The second execution is refused (where nothing replays): the listing tells that the first worked."""
    opcode, run, expected = ACTS[act]
    if act == "rename" and profile not in RENAMING:
        return
    here = world(profile, file=b"content")
    here.tree.add_directory(path(profile, "dir"))
    faults = Faults(here)
    async with here.connection() as connection:
        faults.lose_reply_to(opcode)
        async with trio.open_nursery() as nursery:  # another request in between ends the replay
            nursery.start_soon(run, connection.store, profile)
            await trio.sleep(0.05)
            await connection.store.list_directory(path(profile, "")[:-1])
        assert names(here) == expected
    # The textbook's server gives ids that cannot be guessed when the reply with the id is lost.
    assert here.vehicle.server.open_sessions == int(profile == "spec" and act == "create")


@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_refusals_are_refusals(profile: str, autojump: MockClock) -> None:
    here = world(profile, file=b"content")
    here.tree.add(path(profile, "dir/inner"), b"x")
    here.tree.add_directory(path(profile, "empty"))
    async with here.connection() as connection:
        store = connection.store
        for attempt in (
            lambda: store.remove(path(profile, "missing")),
            lambda: store.remove_directory(path(profile, "dir")),
            lambda: store.make_directory(path(profile, "dir")),
            lambda: store.make_directory(path(profile, "empty")),
            lambda: store.make_directory(path(profile, "no/such")),
            lambda: store.rename(path(profile, "missing"), path(profile, "other")),
            lambda: store.create_empty(path(profile, "no/such")),
            lambda: store.stat_size(path(profile, "missing")),
        ):
            with pytest.raises(FtpNak):
                await attempt()
        assert names(here) == [b"dir", b"empty", b"file"]
    assert here.vehicle.server.open_sessions == 0


@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_an_existing_directory_is_not_taken_for_ours(profile: str, autojump: MockClock) -> None:
    """Its reply lost, mkdir of what was there before must still be refused."""
    here = world(profile)
    here.tree.add(path(profile, "dir/inner"), b"x")
    faults = Faults(here)
    async with here.connection() as connection:
        faults.lose_reply_to(Opcode.CREATE_DIRECTORY)
        with pytest.raises(FtpNak) as refusal:
            await connection.store.make_directory(path(profile, "dir"))
        assert refusal.value.code == 8


@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "px4-2026"])
async def test_a_sticky_file_exists_hides_no_other_refusal(profile: str, autojump: MockClock) -> None:
    here = world(profile, file=b"content")
    here.tree.add_directory(path(profile, "dir"))
    faults = Faults(here)

    async def spoil(connection: Connection) -> None:
        with pytest.raises(FtpNak):
            await connection.scheduler.metadata(Simple(Opcode.CREATE_DIRECTORY, path(profile, "dir")))

    async with here.connection() as connection:
        await spoil(connection)
        with pytest.raises(FtpNak) as refusal:
            await connection.store.remove(path(profile, "missing"))
        assert refusal.value.code == 10
        await spoil(connection)
        await connection.store.remove(path(profile, "file"))
        await spoil(connection)
        source = MemorySource(b"hello")
        upload = await connection.store.open_upload(path(profile, "new"), source)
        await upload.finish()
        await spoil(connection)
        faults.lose_reply_to(Opcode.TERMINATE_SESSION)
        source.add(b" world")
        upload.wake()
        await upload.finish()
        assert here.tree.data(path(profile, "new")) == b"hello world"


@pytest.mark.holds("fault refused retry")
@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_silence_is_unknown_unless_the_listing_tells(profile: str, autojump: MockClock) -> None:
    here = world(profile, file=b"content")
    faults = Faults(here)
    async with here.connection() as connection:
        faults.ignore(Opcode.REMOVE_FILE)
        with pytest.raises(RequestTimeout):
            await connection.store.remove(path(profile, "file"))
        assert names(here) == [b"file"]
        for _ in range(20):
            faults.lose_reply_to(Opcode.CREATE_DIRECTORY)
        await connection.store.make_directory(path(profile, "dir"))


@pytest.mark.holds("promise 6")
@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_our_own_session_is_closed_before_a_path_changes(profile: str, autojump: MockClock) -> None:
    here = world(profile, LinkSettings(rate=20_000.0, delay=0.02), file=bytes(60_000), other=b"x")
    faults = Faults(here)
    open_then: list[list[bytes]] = []
    async with here.connection() as connection:
        reader, sink = await begin_to_read(connection, path(profile, "file"), 1000)
        faults.at(Opcode.REMOVE_FILE, lambda: open_then.append(here.vehicle.server.open_paths))
        await connection.store.remove(path(profile, "file"))
        assert open_then == [[]]
        with pytest.raises(FileChanged):
            await sink.wait_for(0, 60_000)
        reader.want(0, 60_000, demand=True)
        with pytest.raises(FileChanged):
            await sink.wait_for(0, 60_000)
        assert await read_file(connection, path(profile, "other")) == b"x"


@pytest.mark.parametrize("profile", RENAMING)
async def test_readers_follow_a_rename(profile: str, autojump: MockClock) -> None:
    data = content(40_000)
    here = world(profile, LinkSettings(rate=20_000.0, delay=0.02))
    here.tree.add(path(profile, "dir/file"), data)
    faults = Faults(here)
    open_then: list[list[bytes]] = []
    async with here.connection() as connection:
        _, sink = await begin_to_read(connection, path(profile, "dir/file"), 1000)
        faults.at(Opcode.RENAME, lambda: open_then.append(here.vehicle.server.open_paths))
        await connection.store.rename(path(profile, "dir"), path(profile, "moved"))
        assert open_then == [[]]
        assert await sink.wait_for(0, 40_000) == data
    assert here.tree.stat(path(profile, "moved/file")).kind is Kind.FILE


@pytest.mark.parametrize("probed", [False, True], ids=["unknown", "probed"])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_an_upload_makes_room_for_a_change_of_its_path(
    profile: str, probed: bool, autojump: MockClock
) -> None:
    here = world(profile, LinkSettings(rate=20_000.0, delay=0.02))
    faults = Faults(here)
    open_then: list[list[bytes]] = []
    async with here.connection() as connection:
        if probed:
            know(connection, profile)
        source = MemorySource(bytes(300_000))
        upload = await connection.store.open_upload(path(profile, "file"), source)
        await trio.sleep(1)
        faults.at(Opcode.REMOVE_FILE, lambda: open_then.append(here.vehicle.server.open_paths))
        await connection.store.remove(path(profile, "file"))
        assert open_then == [[]]
        assert not source.dirty.empty  # it did not wait for the upload's end
        await upload.abort()
    assert here.vehicle.server.open_sessions == 0


async def test_a_tiny_checksum_is_asked_for_again_soon(autojump: MockClock) -> None:
    here = world("px4", file=b"content")
    faults = Faults(here)
    async with here.connection() as connection:
        faults.lose_reply_to(Opcode.CALC_FILE_CRC32)
        began = trio.current_time()
        await connection.store.crc32(b"/d/file", size=7)
        assert trio.current_time() - began < 4
        assert faults.requests.count(Opcode.CALC_FILE_CRC32) == 2


async def test_too_long_a_rename_is_refused_before_a_byte_is_sent(autojump: MockClock) -> None:
    here = world("px4")
    faults = Faults(here)
    async with here.connection() as connection:
        with pytest.raises(PathTooLong):
            await connection.store.rename(b"/d/" + b"a" * 116, b"/d/" + b"b" * 117)
    assert faults.requests == []


async def test_a_sticky_file_exists_does_not_hide_the_whitelist(autojump: MockClock) -> None:
    here = world("px4-nuttx")
    here.tree.add(b"/etc/rc", b"#")
    here.tree.add_directory(path("px4-nuttx", "dir"))
    async with here.connection() as connection:
        with pytest.raises(FtpNak):
            await connection.scheduler.metadata(Simple(Opcode.CREATE_DIRECTORY, path("px4-nuttx", "dir")))
        with pytest.raises(FtpNak) as refusal:
            await connection.store.remove(b"/etc/rc")
        assert refusal.value.code == 9


@pytest.mark.parametrize("profile", [name for name in EVERY_PROFILE if name != "spec"])
async def test_what_may_still_be_open_is_closed_first_too(profile: str, autojump: MockClock) -> None:
    """A CreateFile whose ACK never came may have opened the file that is then removed."""
    here = world(profile)
    faults = Faults(here)
    open_then: list[list[bytes]] = []
    async with here.connection(ConnectOptions(op_deadline=5.0)) as connection:
        faults.cut_after(1)
        upload = await connection.store.open_upload(path(profile, "new"), MemorySource(b"x"))
        with pytest.raises(RequestTimeout):
            await upload.finish()
        await upload.abort()
        faults.cut_after(None)
        assert here.vehicle.server.open_sessions == 1
        faults.at(Opcode.REMOVE_FILE, lambda: open_then.append(here.vehicle.server.open_paths))
        await connection.store.remove(path(profile, "new"))
        assert open_then == [[]]


DOUBLING = LinkSettings(delay=0.01, duplicate=1.0)
DOUBLED = {
    "remove": Opcode.REMOVE_FILE,
    "remove_directory": Opcode.REMOVE_DIRECTORY,
    "make_directory": Opcode.CREATE_DIRECTORY,
    "rename": Opcode.RENAME,
}


@pytest.mark.holds("fault duplicate", "fault refused retry")
@pytest.mark.parametrize("act", ["remove", "remove_directory", "make_directory", "rename"])
@pytest.mark.parametrize("profile", EVERY_PROFILE)
async def test_a_request_doubled_by_the_network_whose_first_answer_is_lost(
    profile: str, act: str, autojump: MockClock
) -> None:
    """MAVSDK executes both, and all that comes back is the refusal of the second one."""
    if profile == "littlefs" and act == "rename":
        return  # it has none
    here = world(profile, DOUBLING, file=b"content")
    here.tree.add_directory(path(profile, "empty"))
    faults = Faults(here)
    async with here.connection() as connection:
        store = connection.store
        await store.stat_size(path(profile, "file"))  # answered twice, which shows what this link does
        faults.lose_reply_to(DOUBLED[act])
        if act == "remove":
            await store.remove(path(profile, "file"))
        elif act == "make_directory":
            await store.make_directory(path(profile, "made"))
        elif act == "rename":
            await store.rename(path(profile, "file"), path(profile, "renamed"))
        else:
            await store.remove_directory(path(profile, "empty"))
    left = {
        "remove": [b"empty"],
        "remove_directory": [b"file"],
        "make_directory": [b"empty", b"file", b"made"],
        "rename": [b"empty", b"renamed"],
    }
    assert names(here) == left[act]


@pytest.mark.parametrize("profile", RENAMING)
async def test_a_rename_is_the_first_request_that_the_network_doubles(
    profile: str, autojump: MockClock
) -> None:
    """Refused for nothing it would count as proof that the server renames none, and no file is replaced."""
    here = world(profile, file=b"content")
    faults = Faults(here)
    async with here.connection() as connection:
        await connection.store.stat_size(path(profile, "file"))
        faults.lose_reply_to(Opcode.RENAME)
        faults.at(Opcode.RENAME, lambda: setattr(here.model, "settings", LinkSettings(delay=0.01)))
        here.model.settings = DOUBLING  # until both copies of it are there
        await connection.store.rename(path(profile, "file"), path(profile, "renamed"))
    assert names(here) == [b"renamed"]


async def test_a_refusal_on_a_link_that_doubles_nothing_costs_no_listing(autojump: MockClock) -> None:
    here = world("mavsdk", file=b"content")
    faults = Faults(here)
    async with here.connection() as connection:
        with pytest.raises(FtpNak):
            await connection.store.remove(path("mavsdk", "missing"))
    assert not {Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME} & set(faults.requests)


@pytest.mark.parametrize("taken", [3, 30])
@pytest.mark.parametrize("in_root", [False, True])
@pytest.mark.parametrize("profile", taking_turns(EVERY_PROFILE))
async def test_who_looks_misses_no_name_because_we_take_others_away(
    profile: str, in_root: bool, taken: int, autojump: MockClock
) -> None:
    """A page begins where the one before ended, by number: what moved up meanwhile is on neither."""
    names = [b"name of some length %02d" % number for number in range(60)]
    here = world(profile, LinkSettings(delay=0.1))
    directory = ROOTS.get(profile, b"/") if in_root else path(profile, "")[:-1]
    for name in names:
        here.tree.add(join(directory, name), b"x")
    shown: set[bytes] = set()
    async with here.connection() as connection, trio.open_nursery() as nursery:

        async def sweep() -> None:
            entries, _ = await connection.store._changes._entries(directory)
            shown.update(entry.name for entry in entries)

        await connection.store.list_directory(directory)
        nursery.start_soon(sweep)
        await trio.sleep(0.5)
        for name in names[:taken]:
            await connection.store.remove(join(directory, name))
    assert shown >= set(names[taken:])


@pytest.mark.holds("promise 9")
@pytest.mark.parametrize("when_armed", ["ro", "ok"])
async def test_no_checksum_is_asked_for_in_flight(
    when_armed: Literal["ro", "ok"], autojump: MockClock
) -> None:
    """The vehicle reads the whole file for it (promise 9)."""
    here = world("px4", file=b"content")
    faults = Faults(here)

    async def fly(armed: bool) -> None:
        (here.vehicle.arm if armed else here.vehicle.disarm)()
        here.link.kick()
        await trio.sleep(0.5)

    async with here.connection(ConnectOptions(when_armed=when_armed)) as connection:
        await fly(True)
        with pytest.raises(Armed):
            await connection.store.crc32(b"/d/file")
        assert Opcode.CALC_FILE_CRC32 not in faults.requests
        await fly(False)
        assert await connection.store.crc32(b"/d/file") == crc32(b"content")
