"""An hour of a 57600 baud radio on virtual time: telemetry, lost frames, cuts, a reboot, arming; and programs
that write, read and rename all the while, each against a model.

What a close confirmed is on the card at that moment; what was accepted is there in the end; nothing else is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Any

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import OpenFile, Tree
from mavftpfs.compose import subscribe
from mavftpfs.session.connection import Connection
from mavftpfs.shared.errors import LocalProtocolError, MavftpfsError, NotFound
from mavftpfs.sim.linkmodel import Duplex, LinkSettings
from mavftpfs.sim.profiles import PROFILES, Storage
from mavftpfs.sim.tree import Kind
from tests.support.mounting import writable_tree
from tests.support.trees import content
from tests.support.worlds import World

RADIO = LinkSettings(rate=5760.0, queue=2048, duplex=Duplex.HALF, delay=0.02, burst_loss=0.05)
TELEMETRY = 1200.0
MINUTE = 60.0
HOUR = 3600.0
FOLDERS = {"px4-nuttx": b"/fs/microsd/d", "ardupilot": b"/d", "ardupilot5": b"/APM/d"}
LOG = content("log", 40_000)
STEP = 4096


@dataclass(eq=False)
class File:
    """What a file must hold. version: counts its changes."""

    data: bytearray = field(default_factory=bytearray)
    version: int = 0

    def put(self, offset: int, data: bytes) -> None:
        """Like pwrite."""
        self.data.extend(bytes(max(0, offset - len(self.data))))
        self.data[offset : offset + len(data)] = data
        self.version += 1

    def resize(self, size: int) -> None:
        """Like ftruncate."""
        del self.data[size:]
        self.data.extend(bytes(size - len(self.data)))
        self.version += 1


class Hour:
    """The vehicle, its mount's tree and the model."""

    def __init__(self, profile: str, seed: int) -> None:
        self.here = World(profile, RADIO, seed=seed, telemetry=TELEMETRY)
        self.folder = FOLDERS.get(profile, b"/d")
        self.renames = PROFILES[profile].storage is not Storage.LITTLEFS
        self.here.tree.add(self.folder + b"/log.ulg", LOG)
        self.files = {b"log.ulg": File(bytearray(LOG))}
        self.done: dict[str, int] = {}
        self.tree: Tree

    def mount(self, connection: Connection, nursery: trio.Nursery, seed: int) -> None:
        """Make the tree, told of what the vehicle says as a mount's is."""
        self.tree = writable_tree(connection, nursery, seed=seed, inplace=not self.renames)
        subscribe(connection, self.tree)

    def path(self, name: bytes) -> bytes:
        """Return the path of a name."""
        return self.folder + b"/" + name

    async def attempt(self, what: str, call: Callable[[], Any]) -> Any:
        """Return what a call returns, None if the vehicle or the link did not let it; count both."""
        try:
            result = await call()
        except LocalProtocolError:
            raise  # a mistake of ours, whatever the link does
        except MavftpfsError as error:
            self.count(f"{what}: {type(error).__name__}")
            return None
        self.count(what)
        return True if result is None else result

    def count(self, what: str) -> None:
        """Count what happened, for the report."""
        self.done[what] = self.done.get(what, 0) + 1

    def on_card(self, name: bytes) -> bytes | None:
        """Return what lies on the card under a name."""
        try:
            return self.here.tree.data(self.path(name))
        except OSError:
            return None

    # --- programs

    async def write(self, rng: Random, name: bytes) -> None:
        """Open, change in some way, close; what the close confirms is on the card."""
        file = self.files.get(name)
        truncate = rng.random() < 0.3
        if file is None:
            handle = await self.attempt("create", lambda: self.tree.create(self.path(name), exclusive=True))
            file = File()
        else:
            opened = lambda: self.tree.open(self.path(name), write=True, truncate=truncate)  # noqa: E731
            handle = await self.attempt("open", opened)
            if handle is not None and truncate:
                file.resize(0)
        if handle is None:
            return
        self.files[name] = file
        for _ in range(rng.randrange(1, 4)):
            await self.change(rng, handle, file)
            await trio.sleep(rng.random())
        if await self.attempt("fsync", handle.fsync) is not None:
            assert self.on_card(name) == bytes(file.data), f"{name!r} was confirmed"
        await self.attempt("release", handle.release)
        handle.close()

    async def change(self, rng: Random, handle: OpenFile, file: File) -> None:
        """Write somewhere, append, or cut."""
        size = len(file.data)
        if rng.random() < 0.15:
            to = rng.randrange(size + 500)
            if await self.attempt("truncate", lambda: handle.truncate(to)) is not None:
                file.resize(to)
            return
        at = rng.choice((0, size, size, rng.randrange(size + 1)))
        data = rng.randbytes(rng.choice((5, 239, 600, 3000)))
        if await self.attempt("write", lambda: handle.write(at, data)) is not None:
            file.put(at, data)

    async def read(self, rng: Random, name: bytes) -> None:
        """Read a file; if nobody changed it meanwhile it is the model's."""
        file = self.files.get(name)
        if file is None:
            return
        version, expected = file.version, bytes(file.data)
        data = await self.attempt("read", lambda: self.read_all(name))
        if data is not None and self.files.get(name) is file and file.version == version:
            assert data == expected, f"{name!r} read back"

    async def read_all(self, name: bytes) -> bytes:
        """Return a file's content."""
        handle = await self.tree.open(self.path(name))
        try:
            return b"".join([bytes(await handle.read(at, STEP)) for at in range(0, handle.size, STEP)])
        finally:
            await handle.release()

    async def move(self, rng: Random, names: list[bytes]) -> None:
        """Rename or remove; what fails did all or nothing."""
        old, new = rng.sample(names, 2)
        before = dict(self.files)
        after = {name: file for name, file in before.items() if name not in (old, new)}
        if old not in before:
            return
        if self.renames and rng.random() < 0.7:
            after[new] = before[old]
            call, what = (lambda: self.tree.rename(self.path(old), self.path(new))), "rename"
        else:
            after = {name: file for name, file in before.items() if name != old}
            call, what = (lambda: self.tree.unlink(self.path(old))), "unlink"
        if await self.attempt(what, call) is None:
            after = await self.find_out(names, before, after)
        for name in names:
            self.files.pop(name, None)
            if name in after:
                self.files[name] = after[name]

    async def find_out(
        self, names: list[bytes], before: dict[bytes, File], after: dict[bytes, File]
    ) -> dict[bytes, File]:
        """Ask until the vehicle answers which of both it is."""
        for _ in range(200):
            await trio.sleep(10)
            self.tree.forget_caches()
            try:
                shown = [await self.size(name) for name in names]
            except MavftpfsError:
                continue
            for state in (before, after):
                if shown == [len(state[name].data) if name in state else None for name in names]:
                    return state
            raise AssertionError(f"neither before nor after: {shown}")
        raise AssertionError("the vehicle never came back")

    async def size(self, name: bytes) -> int | None:
        try:
            return (await self.tree.stat(self.path(name))).size
        except NotFound:
            return None

    # --- the day's trouble

    async def trouble(self, rng: Random) -> None:
        """Cuts of the link, a reboot every quarter of an hour, arming now and then."""
        vehicle, link = self.here.vehicle, self.here.link
        for number in range(10_000):
            await trio.sleep(rng.uniform(30, 120))
            if number % 7 == 3:
                vehicle.reboot(trio.current_time(), downtime=rng.choice((0.0, 8.0)))
            elif number % 3 == 1:
                vehicle.arm()
                await trio.sleep(rng.uniform(5, 40))
                vehicle.disarm()
            else:
                link.cut()
                await trio.sleep(rng.choice((0.5, 4.0, 15.0, 45.0)))
                link.restore()
            link.kick()

    async def end(self) -> None:
        """Deliver everything: the card is the model."""
        self.here.link.restore()
        self.here.vehicle.disarm()
        self.here.link.kick()
        await trio.sleep(20)
        assert await self.tree.drain(900) == []
        for _ in range(3):  # a listing, and time to clean up after it
            self.tree.forget_caches()
            shown = {name for name, _ in await self.tree.list(self.folder)}
            await trio.sleep(20)
        assert shown == set(self.files)
        entries = [entry for entry in self.here.tree.entries(self.folder) if entry.stat.kind is Kind.FILE]
        litter = {entry.name for entry in entries} - set(self.files)
        assert not litter, f"{sorted(litter)} on the card"
        for name, file in self.files.items():
            assert self.on_card(name) == bytes(file.data), f"{name!r} in the end"
        status = self.tree.status()
        assert (status["bytes_held"], status["files_undelivered"]) == (0, 0)


async def spend(profile: str, seed: int, seconds: float) -> dict[str, int]:
    """Spend that time on a radio; returns what was done and what failed, by kind."""
    hour = Hour(profile, seed)
    async with hour.here.connection() as connection, trio.open_nursery() as nursery:
        hour.mount(connection, nursery, seed)
        writers = [[b"w0-%d" % n for n in range(3)], [b"w1-%d" % n for n in range(3)]]
        moved = [b"m%d" % n for n in range(3)]

        async def program(number: int, step: Callable[[Random], Any]) -> None:
            rng = Random(seed * 100 + number)
            stop = trio.current_time() + seconds
            while trio.current_time() < stop:
                await step(rng)
                await trio.sleep(rng.uniform(0.5, 8))

        async def writes_and_moves(rng: Random) -> None:
            await hour.write(rng, rng.choice(moved))
            await hour.move(rng, moved)

        async with trio.open_nursery() as troubles:
            troubles.start_soon(hour.trouble, Random(seed))
            async with trio.open_nursery() as programs:
                programs.start_soon(program, 1, lambda rng: hour.write(rng, rng.choice(writers[0])))
                programs.start_soon(program, 2, lambda rng: hour.write(rng, rng.choice(writers[1])))
                programs.start_soon(program, 3, lambda rng: hour.read(rng, rng.choice(sorted(hour.files))))
                programs.start_soon(program, 4, writes_and_moves)
            troubles.cancel_scope.cancel()
        await hour.end()
        nursery.cancel_scope.cancel()
    return hour.done


@pytest.mark.soak
@pytest.mark.parametrize("profile", sorted(PROFILES))
async def test_an_hour_of_radio_loses_no_byte(profile: str, autojump: MockClock) -> None:
    done = await spend(profile, seed=1, seconds=HOUR)
    assert done["fsync"] > 100, done


@pytest.mark.holds("promise 3")
@pytest.mark.parametrize("profile", ["px4", "px4-nuttx", "ardupilot", "mavsdk"])
async def test_three_minutes_of_radio_lose_no_byte(profile: str, autojump: MockClock) -> None:
    done = await spend(profile, seed=2, seconds=3 * MINUTE)
    assert done["fsync"] > 5, done
