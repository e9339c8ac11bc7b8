"""Each operation meets each event at each of its requests, on each server; a model of a local disk judges.

What must hold, whatever happens and whenever:
- A call that succeeds did all of it: the card shows that at once.
- A call that fails did all or nothing. If its writes were taken, their bytes are delivered when the event is
  over, or kept here.
  Where others changed the file meanwhile it stays here, and is kept in the end.
- If others change the directory, too, the card has what a local disk has if each call is carried out as a
  whole, one after the other. A change of others is lost only if it came after the last look at the file.
- In flight, and after the power went, no file is half there, and no name lost its file.
- In the end the card holds what a local disk would hold, nothing of ours beside it, and no session is open.
- No name lacks its file for longer than 10 s while the vehicle is heard, or 70 s after the first listing of
  the next mount.
- Each call ends in time.

The parts are in `tests/support/matrix`. The daily run takes one request of each cell; the soak takes all of
them.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from itertools import count as counted
from itertools import product
from pathlib import Path
from typing import Any
from zlib import crc32

import pytest
import trio

from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.connection import ConnectOptions
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.profiles import PROFILES
from tests.support.matrix.events import (
    EARLY,
    EVENTS,
    IN_TURN,
    LOCAL,
    OVER,
    TWICE,
    UNHEARD,
    UNNOTICED,
    full_card,
    give_up,
    give_up_in_silence,
    nothing,
    power_off,
)
from tests.support.matrix.judging import (
    NAMELESS,
    Watch,
    expected,
    in_time,
    judge_next_mount,
    judge_views,
    names_that_stay,
    require,
    settle,
    wait_for_others,
)
from tests.support.matrix.operations import (
    BEFORE,
    FAILING,
    IN_PLACE,
    KEEPING_NEW,
    NAME,
    NEW,
    OPERATIONS,
    RENAMES,
    WRITING,
    Call,
    D,
    after,
    allowed,
    append_in_doubt,
    in_place,
    is_taken,
    keeping,
    take_back,
)
from tests.support.matrix.scene import Event, Others, Scene, visible
from tests.support.rigs import GOOD_LINK, Rig
from tests.support.takingturns import ALIKE

QUICK = ConnectOptions(op_deadline=8.0)
CHANGING = {
    Opcode.CREATE_DIRECTORY, Opcode.CREATE_FILE, Opcode.REMOVE_DIRECTORY, Opcode.REMOVE_FILE, Opcode.RENAME
}  # fmt: skip

DOUBLING = LinkSettings(delay=0.01, duplicate=0.01)
"""A link that delivers one frame in a hundred twice."""

FAR = LinkSettings(delay=0.02)
"""A link on which calls that run beside each other meet: an answer takes its time."""


# --- one meeting


@asynccontextmanager
async def mounted(here: Rig, place: Path, seed: int) -> AsyncIterator[Tree]:
    """Give what a mount has. place: where it keeps what is held back."""
    spool = SpoolDirectory(place)
    async with here.connected(QUICK, seed=seed):
        inplace = in_place(here.profile)
        yield here.mount(seed=seed, spool=spool, inplace=inplace, op_deadline=8.0)
    spool.close()


async def meet(
    profile: str, operation: Call, event: Event, count: int, place: Path, link: LinkSettings | None = None
) -> list[int]:
    """Have the event come at request `count` of an operation; return the opcodes of its requests."""
    if link is None:
        link = FAR if isinstance(event, Others) else GOOD_LINK
    here = Rig(profile, {D + b"/" + name: data for name, data in BEFORE.items() if data is not None}, link)
    here.put_directory(D + b"/sub")
    if isinstance(event, Others) and event.outside:
        here.faults.orphans = True  # what others have open, or take away, we cannot know in time
    watch = Watch(here, names_that_stay(operation, event.model if isinstance(event, Others) else None))
    async with mounted(here, place, 3) as tree:
        caller = trio.CancelScope()
        scene = Scene(here, tree, operation, caller, watch.on_effect, [watch.on_end])
        if event in EARLY:
            event(scene, count)
        await tree.list(D)
        await trio.sleep(10.0 if event in EARLY else 3.0)
        if operation is append_in_doubt:
            here.connection.scheduler.server.distrust(reads=True)
        began, done = len(here.faults.requests), False
        with caller:
            if event not in EARLY:
                event(scene, count)
            done = await attempt(scene)
        assert done or event not in UNNOTICED
        if scene.others is not None and not scene.others.outside:
            await scene.over.wait()
        if done and (scene.others is None or scene.over.is_set()):
            require(visible(here), expected(scene, watch, done=True))
        here.faults.call_off()
        requests = here.faults.requests[began:]
        if event is power_off:
            here.link.cut()  # or leaving would tidy up
        else:
            await wait_for_others(scene)
            await trio.sleep(OVER.get(event, 10.0))
            await deliver_and_settle(scene, watch, done, place)
            if not in_place(profile):
                assert watch.nameless <= UNHEARD.get(event, 0.0) + NAMELESS
    if event is power_off:
        here.vehicle.reboot(trio.current_time())
        here.link.restore()
        async with mounted(here, place, 9) as tree:
            await judge_next_mount(tree, here, (after(operation),) if done else allowed(operation))
    assert here.server.open_sessions == 0 or event in TWICE
    return requests


async def attempt(scene: Scene) -> bool:
    """Make the call, and end what lasts as long as it; return whether it succeeded."""
    try:
        with in_time():
            seen = await scene.operation(scene.tree)
    except BaseException as error:
        scene.taken = is_taken(error)
        if not isinstance(error, MavftpfsError):
            raise
        return False
    finally:
        for end in scene.at_end:
            end()
    judge_views(scene, seen)
    return True


async def deliver_and_settle(scene: Scene, watch: Watch, done: bool, place: Path) -> None:
    """Have everything delivered that can be, and judge what is there then, and what is kept here."""
    tree = scene.tree
    held = scene.taken or bool(tree.undelivered())
    left = await tree.drain(300.0)
    if left:
        assert scene.others is not None, f"{left} cannot be delivered"
        assert scene.others.outside, f"{left} cannot be delivered"
        assert not done, f"a close said that {left} was delivered"
    judge_views(scene, None)
    broken = scene.taken and bool(tree.broken())
    arrived = done or (held and not left and not broken)
    await settle(tree, scene.here, expected(scene, watch, arrived), left)
    if (left or broken) and scene.operation in KEEPING_NEW:
        kept = [path.read_bytes() for path in tree.recover_to(place / "kept")]
        assert any(NEW[:100] in data for data in kept), "what was accepted is lost"


# --- which cells there are, and which request of them is taken


REQUESTS: dict[tuple[str, Call], list[int]] = {}
"""Which each operation makes where nothing happens, once it is known."""

MANY = 16
"""Of a long run of WriteFiles each such one is taken."""


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


def can_others(profile: str, operation: Call, event: Others) -> bool:
    """Return whether others can do it. Where an open empties files, nobody appends, and another computer has
    to keep the only session for five minutes, which we take from it if we cannot hear it. Nobody can append
    in several requests to a name that goes meanwhile. What is taken back includes what another program
    emptied. A file that another program renames, empties or removes is delivered, or is to be nothing, before
    the write fails."""
    name = event.__name__
    if PROFILES[profile].write_only_truncates and name in ("lengthened_heard", "beside_unheard"):
        return False
    if name == "lengthened_heard" and NAME not in after(operation):
        return False
    if name == "empty_too" and operation is take_back:
        return False
    return event.outside or event.model is keeping or operation not in FAILING


def can(profile: str, operation: Call, event: Event) -> bool:
    """Return whether a server can do it at all, and in one step."""
    if operation in (*FAILING, take_back) and event in (give_up, give_up_in_silence):
        return False  # the program is told nothing, so its part becomes the file
    if event in (*LOCAL, full_card) and operation not in WRITING:
        return False
    if isinstance(event, Others) and not can_others(profile, operation, event):
        return False
    if not in_place(profile):
        return True
    in_steps = (*RENAMES, *IN_PLACE) if event is power_off else RENAMES
    # A part lies under the name until the vehicle is back: see sim/test_failed_writes.py.
    return event in EVENTS and operation not in (*in_steps, *FAILING, take_back)


DAILY = [profile for profile in sorted(PROFILES) if profile not in ALIKE]


def cells(profiles: Iterable[str], *, in_turn: bool = False) -> list[Any]:
    """Return what can be done on each server, with each event. in_turn: some events on one server only."""
    found = []
    for operation, event in product(OPERATIONS, (*EVENTS, *IN_TURN)):
        able = [profile for profile in profiles if can(profile, operation, event)]
        if in_turn and event in IN_TURN and able:
            able = [able[crc32(f"{operation.__name__} {event.__name__}".encode()) % len(able)]]
        for profile in able:
            key = (profile, operation.__name__, event.__name__)
            found.append(pytest.param(profile, operation, event, id="-".join(key)))
    return found


@pytest.mark.holds("promise 3", "promise 4", "promise 9", "fault power", "fault refused retry")
@pytest.mark.parametrize(("profile", "operation", "event"), cells(DAILY, in_turn=True))
async def test_all_or_nothing_and_no_lie(profile: str, operation: Call, event: Event, tmp_path: Path) -> None:
    count = await sampled(profile, operation, event, tmp_path)
    await meet(profile, operation, event, count, tmp_path / str(count))


@pytest.mark.soak
@pytest.mark.parametrize(("profile", "operation", "event"), cells(sorted(PROFILES)))
async def test_at_every_request(profile: str, operation: Call, event: Event, tmp_path: Path) -> None:
    requests: list[int] = []
    for count in counted(1):
        if requests[count - 2 : count] == 2 * [Opcode.WRITE_FILE] and count % MANY:
            continue
        requests = await meet(profile, operation, event, count, tmp_path / str(count))
        if len(requests) < count:
            return


@pytest.mark.soak
@pytest.mark.parametrize(("profile", "operation", "event"), cells(DAILY))
async def test_where_frames_come_twice(profile: str, operation: Call, event: Event, tmp_path: Path) -> None:
    count = await sampled(profile, operation, event, tmp_path)
    await meet(profile, operation, event, count, tmp_path / str(count), DOUBLING)
