"""Random sequences of calls on a few files against a model: every kind of server, real requests, bad links.

Everything between the calls of a program and the card is the real thing: caches, session, engine, frames. The
vehicle and the link are simulated, time is virtual. What one call in one sequence is depends on the drawn
example alone, trio's order of tasks included (which hypothesis seeds), so what fails once fails again.
"""

from __future__ import annotations

from collections.abc import Mapping
from random import Random
from typing import Any, cast

import pytest
import trio
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from trio.testing import MockClock

from mavftpfs.cache.tree import Tree
from mavftpfs.compose import subscribe
from mavftpfs.session.connection import Connection
from mavftpfs.shared.errors import FtpNak, MavftpfsError, RequestTimeout
from mavftpfs.sim.linkmodel import Duplex, LinkSettings
from mavftpfs.sim.profiles import PROFILES, Storage
from mavftpfs.sim.tree import Kind, MemoryTree
from tests.support.filemodel import START, Model, calls, rewriting_calls
from tests.support.mounting import writable_tree
from tests.support.takingturns import taking_turns
from tests.support.worlds import ROOTS, World

LINKS = {
    "wifi": LinkSettings(delay=0.015, loss=0.05, duplicate=0.02, reorder=0.02),
    "far": LinkSettings(delay=0.25, jitter=0.1, loss=0.05, duplicate=0.02, reorder=0.02),
    "radio": LinkSettings(
        rate=5760.0, queue=2048, duplex=Duplex.HALF, delay=0.02, loss=0.05, duplicate=0.02, corrupt=0.01
    ),
}
"""What is held back arrives within a round trip (`hold`): a RENAME or REMOVE that arrives again after its
answer is carried out again by servers that replay no answers, on whatever has the name by then. `STRAYING` is
such a link, for calls that move no name."""

STRAYING = LinkSettings(delay=0.02, loss=0.05, duplicate=0.02, reorder=0.05, hold=0.2)
"""Held back for five round trips."""

FAILURES = 2
"""Calls of one sequence that may fail: too many answers in a row are lost. None is the rule."""

LEAKS = ("spec",)
"""Servers with several sessions that open another for an OpenFile or CreateFile that arrives twice; nobody
learns its id if the answer is lost."""

CALLS = 100
"""Of one sequence."""

ONCE = (Phase.generate,)
"""Nothing is made smaller: a hundred calls less one are another history, and minutes pass."""


def varied(sequence: list[tuple[Any, ...]]) -> bool:
    """Return whether there is something to it: hypothesis begins with a hundred times the same call."""
    return len({call[0] for call in sequence}) > 5


sequences = st.lists(calls(largest=20_000, chunk=6000), min_size=CALLS, max_size=CALLS).filter(varied)
short = st.lists(calls(largest=20_000, chunk=3000), min_size=CALLS // 4, max_size=CALLS // 4).filter(varied)
rewriting = st.lists(rewriting_calls(20_000, 3000), min_size=CALLS, max_size=CALLS).filter(varied)


class SimCard:
    """All files of a simulated card below a root."""

    def __init__(self, tree: MemoryTree, root: bytes) -> None:
        self.tree = tree
        self.root = root

    def contents(self) -> Mapping[bytes, bytes]:
        """Return every file by its path below the root."""
        return dict(self._below(b""))

    def _below(self, path: bytes) -> list[tuple[bytes, bytes]]:
        found = []
        for entry in self.tree.entries((self.root + path) or b"/"):
            below = path + b"/" + entry.name
            if entry.name in (b".", b".."):
                continue
            if entry.stat.kind is Kind.DIRECTORY:
                found += self._below(below)
            else:
                found.append((below, self.tree.data(self.root + below)))
        return found


def mount(connection: Connection, nursery: trio.Nursery, profile: str, seed: int) -> Tree:
    """Make the tree of a mount."""
    tree = writable_tree(
        connection,
        nursery,
        seed=seed,
        root=ROOTS.get(profile, b"/"),
        inplace=PROFILES[profile].storage is Storage.LITTLEFS,
        dir_timeout=seed % 3 * 10.0,
    )
    subscribe(connection, tree)
    return tree


async def deliver_all(profile: str, link: LinkSettings, sequence: list[tuple[Any, ...]], seed: int) -> World:
    """Make the calls on both; in the end the card is the model and no session is open."""
    here = World(profile, link, seed=seed)
    root = ROOTS.get(profile, b"")
    for path, data in START.items():
        here.tree.add(root + path, data)
    here.tree.add_directory(root + b"/d/sub")
    async with here.connection(seed=seed) as connection, trio.open_nursery() as nursery:
        model = Model(
            mount(connection, nursery, profile, seed), SimCard(here.tree, root), (RequestTimeout, FtpNak)
        )
        for call in sequence:
            await model.do(*call)
            await model.check()
        await model.end()
        assert model.failures <= FAILURES
        nursery.cancel_scope.cancel()
    assert profile in LEAKS or here.vehicle.server.open_sessions == 0
    return here


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


async def trouble(here: World, rng: Random) -> None:
    """Cut the link, restart the vehicle, fly."""
    for number in range(10_000):
        await trio.sleep(rng.uniform(5, 20))
        if number % 7 == 3:
            here.vehicle.reboot(trio.current_time(), downtime=rng.choice((0.0, 8.0)))
        elif number % 3 == 1:
            here.vehicle.arm()
            await trio.sleep(rng.uniform(5, 40))
            here.vehicle.disarm()
        else:
            here.link.cut()
            await trio.sleep(rng.choice((0.5, 15.0, 50.0)))
            here.link.restore()
        here.link.kick()


async def work(model: Model, sequence: list[tuple[Any, ...]], rng: Random) -> None:
    """Make the calls of one program, which pauses between them."""
    for call in sequence:
        await model.do(*call)
        await trio.sleep(rng.uniform(0.5, 8.0))


async def lose_nothing(profile: str, programs: list[list[tuple[Any, ...]]], seed: int) -> None:
    """Have them work side by side in trouble; when it is over the card is what each of them wrote."""
    here = World(profile, TROUBLED, seed=seed, telemetry=1200.0)
    root = ROOTS.get(profile, b"")
    async with here.connection(seed=seed) as connection, trio.open_nursery() as nursery:
        tree = mount(connection, nursery, profile, seed)
        models = []
        for number, _ in enumerate(programs):
            below = b"/%d" % number
            for path, data in START.items():
                here.tree.add(root + below + path, data)
            here.tree.add_directory(root + below + b"/d/sub")
            card = SimCard(here.tree, root + below)
            models.append(Model(cast(Tree, Below(tree, below)), card, MavftpfsError))
        async with trio.open_nursery() as troubles:
            troubles.start_soon(trouble, here, Random(seed))
            async with trio.open_nursery() as working:
                for number, (model, sequence) in enumerate(zip(models, programs, strict=True)):
                    working.start_soon(work, model, sequence, Random(number))
            troubles.cancel_scope.cancel()
        here.link.restore()
        here.vehicle.disarm()
        here.link.kick()
        await trio.sleep(20.0)
        for model in models:
            while model.handles:
                await model.on_close(0)
        for model in models:
            await model.end()
        nursery.cancel_scope.cancel()


@pytest.mark.holds("promise 3")
@pytest.mark.parametrize("profile", taking_turns(sorted(PROFILES)))
@settings(max_examples=1, phases=ONCE)
@given(programs=st.lists(short, min_size=3, max_size=3), seed=st.integers(0, 99))
def test_a_day_of_trouble_loses_no_byte(
    profile: str, programs: list[list[tuple[Any, ...]]], seed: int
) -> None:
    trio.run(lose_nothing, profile, programs, seed, clock=MockClock(autojump_threshold=0))
