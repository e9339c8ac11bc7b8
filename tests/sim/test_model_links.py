"""Random sequences of calls on a few files against a model: every kind of server, real requests, bad links.

Everything between the calls of a program and the card is the real thing: caches, session, engine, frames. The
vehicle and the link are simulated, time is virtual. The drawn example alone decides each call in a
sequence, trio's order of tasks included (which hypothesis seeds), so that a failure can be repeated.
"""

from __future__ import annotations

from functools import partial
from random import Random
from typing import Any, cast

import pytest
import trio
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from trio.testing import MockClock

from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import FtpNak, MavftpfsError, RequestTimeout
from mavftpfs.sim.linkmodel import Duplex, LinkSettings
from mavftpfs.sim.profiles import PROFILES, Storage
from tests.support.filemodel import START, Model, calls, rewriting_calls
from tests.support.rigs import Rig, rig
from tests.support.takingturns import taking_turns

LINKS = {
    "wifi": LinkSettings(delay=0.015, loss=0.05, duplicate=0.02, reorder=0.02),
    "far": LinkSettings(delay=0.25, jitter=0.1, loss=0.05, duplicate=0.02, reorder=0.02),
    "radio": LinkSettings(
        rate=5760.0, queue=2048, duplex=Duplex.HALF, delay=0.02, loss=0.05, duplicate=0.02, corrupt=0.01
    ),
}
"""The links hold frames back for a round trip at most (`hold`): if a RENAME or REMOVE arrives again after
its answer, a server that replays no answers executes it again, on whatever has the name by then. `STRAYING`
is such a link, for calls that move no name."""

STRAYING = LinkSettings(delay=0.02, loss=0.05, duplicate=0.02, reorder=0.05, hold=0.2)
"""Held back for five round trips."""

FAILURES = 2
"""Calls of one sequence that may fail: too many answers in a row are lost. None is the rule."""

CALLS = 100
"""Of one sequence."""

ONCE = (Phase.generate,)
"""hypothesis shrinks no example: a hundred calls less one are another history, and minutes pass."""


def varied(sequence: list[tuple[Any, ...]]) -> bool:
    """Return whether an example has variety: hypothesis begins with a hundred times the same call."""
    return len({call[0] for call in sequence}) > 5


sequences = st.lists(calls(largest=20_000, chunk=6000), min_size=CALLS, max_size=CALLS).filter(varied)
short = st.lists(calls(largest=20_000, chunk=3000), min_size=CALLS // 4, max_size=CALLS // 4).filter(varied)
rewriting = st.lists(rewriting_calls(20_000, 3000), min_size=CALLS, max_size=CALLS).filter(varied)


def mount(here: Rig, seed: int) -> Tree:
    """Make the tree of a mount."""
    inplace = PROFILES[here.profile].storage is Storage.LITTLEFS
    return here.mount(seed=seed, inplace=inplace, dir_timeout=seed % 3 * 10.0)


async def deliver_all(profile: str, link: LinkSettings, sequence: list[tuple[Any, ...]], seed: int) -> None:
    """Make the calls on both; in the end the card equals the model and no session is open."""
    async with rig(profile, START, link=link, seed=seed) as here:
        here.put_directory(b"/d/sub")
        model = Model(mount(here, seed), here.files, (RequestTimeout, FtpNak))
        for call in sequence:
            await model.do(*call)
            await model.do("check")
        await model.end()
        assert model.failures <= FAILURES
    assert here.server.open_sessions == 0


def run(profile: str, link: LinkSettings, sequence: list[tuple[Any, ...]], seed: int) -> None:
    """Run on virtual time."""
    trio.run(deliver_all, profile, link, sequence, seed, clock=MockClock(autojump_threshold=0))


@pytest.mark.holds("promise 1", "rule 14.22")
@pytest.mark.parametrize("link", sorted(LINKS))
@pytest.mark.parametrize("profile", taking_turns(sorted(PROFILES)))
@settings(max_examples=1, phases=ONCE)
@given(sequence=sequences, seed=st.integers(0, 99))
def test_the_card_becomes_the_model(
    profile: str, link: str, sequence: list[tuple[Any, ...]], seed: int
) -> None:
    run(profile, LINKS[link], sequence, seed)


@pytest.mark.holds("fault duplicate")
@pytest.mark.parametrize("profile", taking_turns(sorted(PROFILES)))
@settings(max_examples=1, phases=ONCE)
@given(sequence=rewriting, seed=st.integers(0, 99))
def test_bytes_held_back_for_round_trips(profile: str, sequence: list[tuple[Any, ...]], seed: int) -> None:
    run(profile, STRAYING, sequence, seed)


@pytest.mark.soak
@pytest.mark.parametrize("link", sorted(LINKS))
@pytest.mark.parametrize("profile", sorted(PROFILES))
@settings(max_examples=60, phases=ONCE)
@given(sequence=sequences, seed=st.integers(0, 9999))
def test_hundred_thousands_of_calls(
    profile: str, link: str, sequence: list[tuple[Any, ...]], seed: int
) -> None:
    run(profile, LINKS[link], sequence, seed)


# --- programs side by side, and the day's trouble

TROUBLED = LinkSettings(rate=5760.0, queue=2048, duplex=Duplex.HALF, delay=0.02, burst_loss=0.05)


class Below:
    """A tree, seen from one of its directories: each program works in its own."""

    def __init__(self, tree: Tree, root: bytes) -> None:
        self.tree = tree
        self.root = root

    def __getattr__(self, name: str) -> Any:
        """Return a method of the tree that takes our paths."""

        def call(*args: Any, **options: Any) -> Any:
            given = [self.root + arg if isinstance(arg, bytes) else arg for arg in args]
            return getattr(self.tree, name)(*given, **options)

        return call


async def trouble(here: Rig, rng: Random) -> None:
    """Cut the link, restart the vehicle, fly."""
    link, vehicle = here.link, here.vehicle
    for number in range(10_000):
        await trio.sleep(rng.uniform(5, 20))
        if number % 7 == 3:
            vehicle.reboot(trio.current_time(), downtime=rng.choice((0.0, 8.0)))
        elif number % 3 == 1:
            vehicle.arm()
            await trio.sleep(rng.uniform(5, 40))
            vehicle.disarm()
        else:
            link.cut()
            await trio.sleep(rng.choice((0.5, 15.0, 50.0)))
            link.restore()


async def work(model: Model, sequence: list[tuple[Any, ...]], rng: Random) -> None:
    """Make the calls of one program, which pauses between them."""
    for call in sequence:
        await model.do(*call)
        await trio.sleep(rng.uniform(0.5, 8.0))


def files_below(here: Rig, folder: bytes) -> dict[bytes, bytes]:
    """Return the files on the card below a folder, by their paths there."""
    below = folder + b"/"
    return {path[len(folder) :]: data for path, data in here.files().items() if path.startswith(below)}


async def lose_nothing(profile: str, programs: list[list[tuple[Any, ...]]], seed: int) -> None:
    """Run the programs side by side in trouble; afterwards the card has what each of them wrote."""
    async with rig(profile, link=TROUBLED, seed=seed, telemetry=1200.0) as here:
        tree = mount(here, seed)
        models = []
        for number, _ in enumerate(programs):
            below = b"/%d" % number
            for path, data in START.items():
                here.put(below + path, data)
            here.put_directory(below + b"/d/sub")
            models.append(
                Model(cast(Tree, Below(tree, below)), partial(files_below, here, below), MavftpfsError)
            )
        async with trio.open_nursery() as troubles:
            troubles.start_soon(trouble, here, Random(seed))
            async with trio.open_nursery() as working:
                for number, (model, sequence) in enumerate(zip(models, programs, strict=True)):
                    working.start_soon(work, model, sequence, Random(number))
            troubles.cancel_scope.cancel()
        here.link.restore()
        here.vehicle.disarm()
        await trio.sleep(20.0)
        for model in models:
            while model.handles:
                await model.do("close", 0)
        for model in models:
            await model.end()


@pytest.mark.holds("promise 3")
@pytest.mark.parametrize("profile", taking_turns(sorted(PROFILES), soak=("px4", "ardupilot", "mavsdk")))
@settings(max_examples=1, phases=ONCE)
@given(programs=st.lists(short, min_size=3, max_size=3), seed=st.integers(0, 99))
def test_a_day_of_trouble_loses_no_byte(
    profile: str, programs: list[list[tuple[Any, ...]]], seed: int
) -> None:
    trio.run(lose_nothing, profile, programs, seed, clock=MockClock(autojump_threshold=0))
