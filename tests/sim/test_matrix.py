"""Each operation meets each event at each of its requests, on each server; a model of a local disk judges.

What must hold, whatever happens and whenever:
- A call that succeeds did all of it: the card shows that at once.
- A call that fails did all or nothing, and what a failed close holds is delivered when the event is over.
- In flight, and after the power went, no file is half there, and no name lost its file.
- In the end the card holds what a local disk would hold, nothing of ours beside it, and no session is open.
- Each call ends in time.

The daily run takes one request of each cell; the soak takes all of them.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import count as counted
from pathlib import Path
from random import Random
from typing import Any
from zlib import crc32

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.reserved import is_reserved
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.shared.errors import FileTooLarge, MavftpfsError, WriteFailed
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES, Storage
from tests.support.rigs import GOOD_LINK, Rig
from tests.support.takingturns import ALIKE
from tests.support.transfers import content

State = dict[bytes, bytes | None]
"""What is in the directory: contents of files by name, None for a directory."""

OLD, OTHER, NEW, LARGE = content(900, 1), content(400, 2), content(700, 3), content(70_000, 4)
BEFORE: State = {b"file": OLD, b"other": OTHER, b"sub": None}
QUICK = ConnectOptions(op_deadline=8.0)
IN_TIME = 60.0
"""Virtual seconds. A call makes a few requests, each of which may take the deadline and 4 s to find out."""
CHANGING = {
    Opcode.CREATE_DIRECTORY, Opcode.CREATE_FILE, Opcode.REMOVE_DIRECTORY, Opcode.REMOVE_FILE, Opcode.RENAME
}  # fmt: skip

DOUBLING = LinkSettings(delay=0.01, duplicate=0.01)
"""A link that delivers one frame in a hundred twice."""

Call = Callable[[Tree], Awaitable[None]]
D = b"/d"


# --- operations


async def write(tree: Tree, path: bytes, offset: int, data: bytes, *, truncate: bool = False) -> None:
    """Open, write, close: what a program does that checks its close()."""
    file = await tree.open(path, write=True, truncate=truncate)
    try:
        await file.write(offset, data)
        await file.flush()
    finally:
        await file.release()


async def list_names(tree: Tree) -> None:
    """Run ls, when what was listed before is too old."""
    tree.forget_caches()
    assert {name for name, _ in await tree.list(D)} == set(BEFORE)


async def read(tree: Tree) -> None:
    """Run cat."""
    file = await tree.open(b"/d/file")
    try:
        assert bytes(await file.read(0, 2000)) == OLD
    finally:
        await file.release()


async def create(tree: Tree) -> None:
    """Run cp to a new name."""
    file = await tree.create(b"/d/new", exclusive=False)
    try:
        await file.flush()  # as a shell does before a program writes
        await file.write(0, NEW)
        await file.flush()
    finally:
        await file.release()


async def touch(tree: Tree) -> None:
    """Make an empty file."""
    await (await tree.create(b"/d/new", exclusive=True)).release()


async def replace(tree: Tree) -> None:
    """Run cp over a file."""
    await write(tree, b"/d/file", 0, NEW, truncate=True)


async def change(tree: Tree) -> None:
    """Write some bytes in the middle."""
    await write(tree, b"/d/file", 200, NEW[:100])


async def append(tree: Tree) -> None:
    """Run echo >> file."""
    await write(tree, b"/d/file", len(OLD), NEW)


async def fail(file: OpenFile) -> None:
    """Have a program told that a write failed, while a part of the file is on its way, and close."""
    try:
        await file.write(0, LARGE)
        await trio.sleep(0.1)
        with pytest.raises(FileTooLarge):
            await file.write(1 << 32, b"beyond the end of what a vehicle takes")
        with pytest.raises(WriteFailed):
            await file.flush()
    finally:
        with suppress(MavftpfsError):
            await file.release()


async def fail_to_create(tree: Tree) -> None:
    """Run cp to a new name; a write is refused."""
    await fail(await tree.create(b"/d/new", exclusive=False))


async def fail_to_replace(tree: Tree) -> None:
    """Run cp over a file; a write is refused."""
    await fail(await tree.open(b"/d/file", write=True, truncate=True))


async def truncate(tree: Tree) -> None:
    """Run truncate -s."""
    await tree.truncate(b"/d/file", 300)


async def rename(tree: Tree) -> None:
    """Run mv to a free name."""
    await tree.rename(b"/d/file", b"/d/new")


async def rename_over(tree: Tree) -> None:
    """Run mv over a file."""
    await tree.rename(b"/d/file", b"/d/other")


async def rename_over_open(tree: Tree) -> None:
    """Run mv over a file that a program reads."""
    file = await tree.open(b"/d/other")
    try:
        await rename_over(tree)
    finally:
        await file.release()


async def unlink(tree: Tree) -> None:
    """Run rm."""
    await tree.unlink(b"/d/file")


async def mkdir(tree: Tree) -> None:
    """Run mkdir."""
    await tree.mkdir(b"/d/new")


async def rmdir(tree: Tree) -> None:
    """Run rmdir."""
    await tree.rmdir(b"/d/sub")


def changed(**files: bytes | None) -> State:
    """Return the directory with these names put into it."""
    return BEFORE | {name.encode(): data for name, data in files.items()}


def without(name: bytes, **files: bytes | None) -> State:
    """Return the directory without a name, and with others put into it."""
    return {key: data for key, data in changed(**files).items() if key != name}


OPERATIONS: dict[Call, State] = {
    list_names: BEFORE,
    read: BEFORE,
    create: changed(new=NEW),
    touch: changed(new=b""),
    replace: changed(file=NEW),
    change: changed(file=OLD[:200] + NEW[:100] + OLD[300:]),
    append: changed(file=OLD + NEW),
    fail_to_create: BEFORE,
    fail_to_replace: BEFORE,
    truncate: changed(file=OLD[:300]),
    rename: without(b"file", new=OLD),
    rename_over: without(b"file", other=OLD),
    rename_over_open: without(b"file", other=OLD),
    unlink: without(b"file"),
    mkdir: changed(new=None),
    rmdir: without(b"sub"),
}
"""What the directory holds after each."""

FAILING = (fail_to_create, fail_to_replace)
RENAMES = (rename, rename_over, rename_over_open)
IN_PLACE = (create, replace, change, append, truncate, fail_to_create)
"""What is done byte by byte where nothing can be renamed."""


def allowed(operation: Call) -> tuple[State, ...]:
    """Return what may be there while the outcome is open: all, nothing, or the empty file cp begins with."""
    begun = (changed(new=b""),) if operation is create else ()
    return BEFORE, OPERATIONS[operation], *begun


# --- events


@dataclass
class Scene:
    """What an event may touch."""

    here: Rig
    tree: Tree
    operation: Call
    caller: trio.CancelScope

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something after some virtual seconds."""

        async def wait() -> None:
            await trio.sleep(seconds)
            action()

        self.here.nursery.start_soon(wait)

    def list_at_once(self) -> None:
        """Have another program list the directory."""

        async def ask() -> None:
            with suppress(MavftpfsError):
                self.tree.forget_caches()
                await self.tree.list(D)

        self.here.nursery.start_soon(ask)

    def whole(self) -> None:
        """Each file is there, old or new."""
        if self.operation not in IN_PLACE or not in_place(self.here.profile):
            found = on_card(self.here)
            shown = {name: data for name, data in found.items() if not is_reserved(name)}
            assert shown in allowed(self.operation)


Event = Callable[[Scene, int], None]


def lose_answer(scene: Scene, count: int) -> None:
    """Lose the answer to a request."""
    scene.here.faults.after(
        count, lambda: scene.here.faults.lose_reply_to(Opcode(scene.here.faults.requests[-1]))
    )


def lose_for_good(scene: Scene, count: int) -> None:
    """Lose the answer, and have something else asked, after which no server says the same once more."""

    def action() -> None:
        scene.here.faults.lose_reply_to(Opcode(scene.here.faults.requests[-1]))
        scene.list_at_once()

    scene.here.faults.after(count, action)


def arrive_twice(scene: Scene, count: int) -> None:
    """Have a request arrive twice."""
    scene.here.faults.repeat(count)


def answer_the_second(scene: Scene, count: int) -> None:
    """Have a request arrive twice, and lose the first answer: the other may be a refusal.

    Of a link that was not seen to do so before that is expected for a rename only."""
    if scene.operation in (unlink, mkdir, rmdir):
        scene.here.connection.scheduler.doubt.raise_it("an answer that came twice")
    scene.here.faults.repeat(count)
    lose_answer(scene, count)


def cut(scene: Scene, count: int) -> None:
    """Cut the link for 4 s."""

    def action() -> None:
        scene.here.link.cut()
        scene.later(4.0, scene.here.link.restore)

    scene.here.faults.after(count, action)


def silence(scene: Scene, count: int) -> None:
    """Lose everything for 40 s: no request can be repeated in time."""

    def action() -> None:
        scene.here.faults.cut_after(0)
        scene.later(40.0, lambda: scene.here.faults.cut_after(None))

    scene.here.faults.after(count, action)


def reboot(scene: Scene, count: int) -> None:
    """Restart the vehicle."""
    scene.here.faults.after(count, lambda: scene.here.vehicle.reboot(trio.current_time(), 2.0))


def arm(scene: Scene, count: int) -> None:
    """Take off, and land 20 s later."""

    def action() -> None:
        scene.here.vehicle.arm()
        scene.later(5.0, scene.whole)
        scene.later(20.0, scene.here.vehicle.disarm)

    scene.here.faults.after(count, action)


def fly_away(scene: Scene, count: int) -> None:
    """Cut the link, and take off before it is back: what lost its name gets it in flight."""

    def action() -> None:
        scene.here.link.cut()
        scene.later(30.0, scene.here.vehicle.arm)
        scene.later(40.0, scene.here.link.restore)
        scene.later(50.0, scene.whole)
        scene.later(55.0, scene.here.vehicle.disarm)

    scene.here.faults.after(count, action)


def rival(scene: Scene, count: int) -> None:
    """Have another ground station reset the sessions, as QGroundControl does."""

    reset = partial(scene.here.another_asks, Opcode.RESET_SESSIONS)
    scene.here.faults.after(count, lambda: scene.later(0.0, reset))


def give_up(scene: Scene, count: int) -> None:
    """Cancel the call, as a handler's deadline does."""
    scene.here.faults.after(count, scene.caller.cancel)


def give_up_in_silence(scene: Scene, count: int) -> None:
    """Cancel the call 5 s after the last answer: no error is left that would tell."""

    def action() -> None:
        scene.here.faults.cut_after(0)
        scene.later(5.0, scene.caller.cancel)
        scene.later(40.0, lambda: scene.here.faults.cut_after(None))

    scene.here.faults.after(count, action)


def power_off(scene: Scene, count: int) -> None:
    """Take the power from the vehicle and from us."""
    scene.here.faults.after(count, scene.here.link.cut)


def nothing(scene: Scene, count: int) -> None:
    """Let it be."""


EVENTS: tuple[Event, ...] = (
    lose_answer, lose_for_good, arrive_twice, answer_the_second, cut, silence, reboot, arm, fly_away, rival,
    give_up, give_up_in_silence, power_off,
)  # fmt: skip

OVER: dict[Event, float] = {arm: 25.0, silence: 45.0, give_up_in_silence: 45.0, fly_away: 60.0}
"""Seconds after which an event that lasts is over, from its beginning."""

UNNOTICED = (nothing, lose_answer, lose_for_good, arrive_twice, answer_the_second)
"""Whatever is lost or doubled once, the call succeeds."""


# --- judging


def on_card(here: Rig) -> State:
    """Return what is in the directory on the card, litter included."""
    found: State = {path[len(D) + 1 :]: data for path, data in here.files().items()}
    return found | {path[len(D) + 1 :]: None for path in here.directories() if path != D}


@contextmanager
def in_time() -> Iterator[None]:
    """Hold a call to its bound."""
    began = trio.current_time()
    yield
    assert trio.current_time() - began <= IN_TIME


def in_place(profile: str) -> bool:
    """Return whether files are changed where they are: nothing can be renamed."""
    return PROFILES[profile].storage is Storage.LITTLEFS


@asynccontextmanager
async def mounted(here: Rig, place: Path, seed: int) -> AsyncIterator[Tree]:
    """Give what a mount has. place: where it keeps what is held back."""
    spool = SpoolDirectory(place, Random(seed))
    async with here.connected(QUICK, seed=seed):
        inplace = in_place(here.profile)
        yield here.mount(seed=seed, spool=spool, inplace=inplace, op_deadline=8.0)
    spool.close()


async def meet(
    profile: str, operation: Call, event: Event, count: int, place: Path, link: LinkSettings = GOOD_LINK
) -> list[int]:
    """Have the event come at request `count` of an operation; return the opcodes of its requests."""
    here = Rig(profile, {D + b"/" + name: data for name, data in BEFORE.items() if data is not None}, link)
    here.put_directory(D + b"/sub")
    async with mounted(here, place, 3) as tree:
        await tree.list(D)
        await trio.sleep(3.0)
        began, done = len(here.faults.requests), False
        with trio.CancelScope() as caller:
            event(Scene(here, tree, operation, caller), count)
            done = await attempt(operation, tree)
        here.faults.call_off()
        assert done or event not in UNNOTICED
        if done:
            assert_done(here, OPERATIONS[operation])
        requests = here.faults.requests[began:]
        if event is power_off:
            here.link.cut()  # or leaving would tidy up
        else:
            await trio.sleep(OVER.get(event, 10.0))
            done = done or tree.undelivered() != []
            assert await tree.drain(300.0) == []
            await settle(tree, here, (OPERATIONS[operation],) if done else allowed(operation)[:2])
    if event is power_off:
        here.vehicle.reboot(trio.current_time())
        here.link.restore()
        async with mounted(here, place, 9) as tree:
            await settle(tree, here, (OPERATIONS[operation],) if done else allowed(operation))
    assert here.server.open_sessions == 0
    return requests


async def attempt(operation: Call, tree: Tree) -> bool:
    """Make the call; return whether it succeeded."""
    with in_time():
        try:
            await operation(tree)
        except MavftpfsError:
            return False
    return True


def assert_done(here: Rig, after: State) -> None:
    """A call that succeeded did all of it: under each name lies what shall be there."""
    found = on_card(here)
    assert {name: found.get(name, b"absent") for name in after} == after
    assert [name for name in BEFORE if name not in after and name in found] == []


async def settle(tree: Tree, here: Rig, ends: tuple[State, ...]) -> None:
    """Wait until all is tidied up: the card has one of these, and the tree shows the same."""
    for _ in range(3):  # listings, and time to clean up what they show
        tree.forget_caches()
        await tree.list(D)
        await trio.sleep(15.0)
        card = on_card(here)
        if card in ends:
            break
    assert card in ends
    shown = {name: stat.size for name, stat in await tree.list(D)}
    assert set(shown) == set(card)
    assert all(shown[name] == len(data) for name, data in card.items() if data is not None)


REQUESTS: dict[tuple[str, Call], list[int]] = {}
"""Which each operation makes where nothing happens, once it is known."""


async def sampled(profile: str, operation: Call, event: Event, place: Path) -> int:
    """Return which request the daily run takes of a cell. It is one that changes a name, if there is one,
    where a message is lost or doubled, and else on half of the servers; on the others it is any one."""
    if (profile, operation) not in REQUESTS:
        REQUESTS[profile, operation] = await meet(profile, operation, nothing, 0, place)
    every = range(1, len(REQUESTS[profile, operation]) + 1)
    changing = [number for number in every if REQUESTS[profile, operation][number - 1] in CHANGING]
    turn = crc32(f"{operation.__name__} {event.__name__}".encode()) + DAILY.index(profile)
    numbers = changing if changing and (turn % 2 or event in UNNOTICED) else every
    return numbers[crc32(f"{profile} {operation.__name__} {event.__name__}".encode()) % len(numbers)]


def can(profile: str, operation: Call, event: Event) -> bool:
    """Return whether a server can do it at all, and in one step."""
    if operation in FAILING and event in (give_up, give_up_in_silence):
        return False  # the program is told nothing, so its part becomes the file
    if operation is fail_to_replace and in_place(profile):
        return False  # the old file is emptied as soon as the new one is sent
    return not in_place(profile) or operation not in (*RENAMES, *(IN_PLACE if event is power_off else ()))


DAILY = [profile for profile in sorted(PROFILES) if profile not in ALIKE]


def cells(profiles: Iterable[str]) -> list[Any]:
    """Return what can be done on each server, with each event."""
    return [
        pytest.param(profile, operation, event, id=f"{profile}-{operation.__name__}-{event.__name__}")
        for profile in profiles
        for operation in OPERATIONS
        for event in EVENTS
        if can(profile, operation, event)
    ]


@pytest.mark.holds("promise 3", "promise 4", "promise 9", "fault power", "fault refused retry")
@pytest.mark.parametrize(("profile", "operation", "event"), cells(DAILY))
async def test_all_or_nothing_and_no_lie(profile: str, operation: Call, event: Event, tmp_path: Path) -> None:
    count = await sampled(profile, operation, event, tmp_path)
    await meet(profile, operation, event, count, tmp_path / str(count))


@pytest.mark.soak
@pytest.mark.parametrize(("profile", "operation", "event"), cells(sorted(PROFILES)))
async def test_at_every_request(profile: str, operation: Call, event: Event, tmp_path: Path) -> None:
    for count in counted(1):
        if len(await meet(profile, operation, event, count, tmp_path / str(count))) < count:
            return


@pytest.mark.soak
@pytest.mark.parametrize(("profile", "operation", "event"), cells(DAILY))
async def test_where_frames_come_twice(profile: str, operation: Call, event: Event, tmp_path: Path) -> None:
    count = await sampled(profile, operation, event, tmp_path)
    await meet(profile, operation, event, count, tmp_path / str(count), DOUBLING)
