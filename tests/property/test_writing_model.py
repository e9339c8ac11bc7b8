"""Random sequences of calls on a few files against a model, on every kind of server, with faults and kills.

The model and what must agree with it are `tests.support.filemodel`; beyond that, what a close or fsync
confirmed must still be there after the power went. `sim/test_model_links.py` makes the calls over bad links.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import trio
import trio.testing
from hypothesis import given, settings
from hypothesis import strategies as st

from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import FtpNak, MavftpfsError, RequestTimeout, VehicleLost
from tests.support.fake_writer import KINDS, FakeWriter, litter, make_writable
from tests.support.filemodel import START, Model, calls

EXAMPLES = 100

operations = calls()
faults = st.dictionaries(
    st.integers(1, 60), st.sampled_from(["lost", "silence", "refused", "unreachable"]), max_size=4
)


@dataclass
class FakeCard:
    """The store's files."""

    store: FakeWriter

    def contents(self) -> Mapping[bytes, bytes]:
        return {path: bytes(file.data) for path, file in self.store.files.items()}


def modelled(store: FakeWriter, tree: Tree, *, excused: bool) -> Model:
    """Put the model's first files into a store, and a tree beside the model."""
    for path, data in START.items():
        store.add(path, data)
    store.add_directory(b"/d/sub")
    return Model(tree, FakeCard(store), MavftpfsError if excused else ())


def put_faults(store: FakeWriter, faults: dict[int, str]) -> None:
    errors: dict[str, Callable[[], MavftpfsError]] = {
        "silence": lambda: RequestTimeout("silence"),
        "refused": lambda: FtpNak(Opcode.WRITE_FILE, NakCode.FAIL_ERRNO, 5),
        "unreachable": lambda: VehicleLost("lost"),
    }
    for number, fault in faults.items():
        if fault == "lost":
            store.lose_reply_at.add(number)
        else:
            store.fail_at[number] = errors[fault]()


def virtually(scenario: Callable[..., Any], *args: Any) -> None:
    trio.run(scenario, *args, clock=trio.testing.MockClock(autojump_threshold=0))


async def deliver_all(kind: str, sequence: list[Any], faults: dict[int, str], seed: int) -> None:
    async with trio.open_nursery() as nursery:
        store = FakeWriter(KINDS[kind], nursery)
        tree = make_writable(store, seed=seed, inplace=True, dir_timeout=seed % 3 * 10.0)
        world = modelled(store, tree, excused=bool(faults))
        put_faults(store, faults)
        for call in sequence:
            await world.do(*call)
            if not faults:
                await world.check()
        store.revive()
        await world.end()
        assert store.crimes == []
        nursery.cancel_scope.cancel()


async def cut_power(kind: str, sequence: list[Any], moment: int, directory: Path) -> None:
    async with trio.open_nursery() as nursery:
        store = FakeWriter(KINDS[kind], nursery)
        spool = SpoolDirectory(directory / "spool", Random(1))
        tree = make_writable(store, spool=spool, inplace=kind == "littlefs")
        world = modelled(store, tree, excused=True)
        store.freeze_at = moment
        settled = True
        for call in sequence:
            confirmed = {path: file.confirmed for path, file in world.names.items()}
            try:
                with trio.fail_after(1000):
                    await world.do(*call)
            except (AssertionError, trio.TooSlowError):
                if store.requests < moment:
                    raise
                settled = False  # the call was cut in the middle, and nobody answers any more
                break
            if store.requests >= moment:
                settled = False
                break
        nursery.cancel_scope.cancel()
    if settled:
        confirmed = {path: file.confirmed for path, file in world.names.items()}
    last = sequence[-1] if settled or not sequence else call
    spool.close()
    store.revive()
    await check_after_power_cut(
        store,
        directory,
        confirmed,
        {arg for arg in last if isinstance(arg, bytes)} if sequence and not settled else set(),
        world,
    )


async def check_after_power_cut(
    store: FakeWriter,
    directory: Path,
    confirmed: dict[bytes, bytes | None],
    touched: set[bytes],
    world: Model,
) -> None:
    """The next mount finds no litter, and all that was confirmed and not being changed at that moment."""
    async with trio.open_nursery() as nursery:
        store.nursery = nursery
        spool = SpoolDirectory(directory / "spool", Random(2))
        tree = make_writable(store, spool=spool, seed=9)
        for path in (b"/d", b"/d/sub", b"/d"):
            await tree.list(path)
        assert litter(store) == []
        for path, data in confirmed.items():
            file = world.names.get(path)
            if data is not None and path not in touched and file is not None and file.confirmed == data:
                assert store.files[path].data == data
        spool.close()
        nursery.cancel_scope.cancel()


@settings(max_examples=EXAMPLES)
@given(st.sampled_from(sorted(KINDS)), st.lists(operations, max_size=25), st.integers(0, 99))
def test_the_card_becomes_the_model(kind: str, sequence: list[Any], seed: int) -> None:
    virtually(deliver_all, kind, sequence, {}, seed)


@settings(max_examples=EXAMPLES)
@given(st.sampled_from(sorted(KINDS)), st.lists(operations, max_size=20), faults, st.integers(0, 99))
def test_faults_cost_errors_but_no_bytes(
    kind: str, sequence: list[Any], faults: dict[int, str], seed: int
) -> None:
    virtually(deliver_all, kind, sequence, faults, seed)


@settings(max_examples=EXAMPLES)
@given(st.sampled_from(sorted(KINDS)), st.lists(operations, min_size=1, max_size=15), st.integers(0, 60))
def test_a_power_cut_costs_nothing_that_was_confirmed(kind: str, sequence: list[Any], moment: int) -> None:
    with TemporaryDirectory() as directory:
        virtually(cut_power, kind, sequence, moment, Path(directory))
