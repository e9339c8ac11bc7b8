"""The judge of the matrix: what the directory may hold, and how long a name may lack its file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import permutations, product
from zlib import crc32

import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import HEADER_SIZE, Opcode
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.sim.profiles import PROFILES, Storage
from mavftpfs.sim.tree import Kind
from tests.support.faults import STATION
from tests.support.matrix.operations import (
    BEFORE,
    FILE,
    IN_PLACE,
    NAME,
    NEW,
    OLD,
    ON_THE_WAY,
    OPERATIONS,
    VIEWS,
    Call,
    D,
    Model,
    State,
    after,
    append,
    append_in_doubt,
    rename_over,
    rename_over_open,
    replace,
    sync,
    take_back,
    unlink,
)
from tests.support.matrix.scene import IN_TIME, Scene, on_card, visible
from tests.support.rigs import Rig

NAMELESS = 11.5
"""Seconds for which a name may lack its file while the vehicle is heard. The first heartbeat comes after one
second at most."""

REPLACING = (replace, sync, append_in_doubt)
"""Once the file is open, nothing of it stays, so that a file of others under its name is replaced, too. In
doubt the file is compared after it got its name, and sent again if it is not there."""

SATISFIED = (unlink, rename_over, rename_over_open)
"""A refusal because the file is gone may be that of a copy of the request. So if others removed the file
between our look and our request, the call succeeds, as one does whose first answer was lost."""

NEXT_MOUNT, NOBODY_UPLOADS = 70.0, 700.0
"""Seconds after the first listing of the next mount: until each name has its file; until nothing of the last
mount is left."""

_OPCODE, _SIZE, _OFFSET = 3, 4, slice(8, 12)
_LISTINGS = (Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME)
_OF_A_FILE = (Opcode.OPEN_FILE_RO, Opcode.CALC_FILE_CRC32)


@contextmanager
def in_time() -> Iterator[None]:
    """Hold a call to its bound."""
    began = trio.current_time()
    yield
    assert trio.current_time() - began <= IN_TIME


class Watch:
    """Sees each request that reaches the vehicle, and looks at the card after each answer.

    names: files that are to stay there under these names.

    Attributes:
        raced: whether others changed the directory between our last look and a rename, or after that and
            before the call ended: the file is compared again then, and sent again if it is not there.
        nameless: the longest time in seconds for which one of the names had no file.
    """

    def __init__(self, here: Rig, names: Sequence[bytes]) -> None:
        self.raced: bool | None = None
        self.nameless = 0.0
        self._here = here
        self._paths = [here.root + D + b"/" + name for name in names]
        self._changed = False
        self._placing = False
        self._missing_since: float | None = None
        self._handle, self._outgoing = here.server.handle, here.server.outgoing
        here.server.handle = self._on_request  # type: ignore[method-assign]
        here.server.outgoing = self._on_outgoing  # type: ignore[method-assign]

    def on_effect(self) -> None:
        """Note that others changed the directory now."""
        self._changed = True
        if self._placing:
            self.raced = True

    def on_end(self) -> None:
        """Note that the operation ended."""
        self._placing = False

    def _on_request(self, wire: bytes, source: Address, now: float) -> None:
        if source != STATION and wire[_OPCODE] == Opcode.RENAME:
            self._placing = True
        if self._changed and self.raced is None and source != STATION:
            asked = wire[HEADER_SIZE : HEADER_SIZE + wire[_SIZE]].rstrip(b"\0")
            lists = wire[_OPCODE] in _LISTINGS and wire[_OFFSET] == bytes(
                4
            )  # another page is of an older look
            if lists or (wire[_OPCODE] in _OF_A_FILE and asked == self._here.root + FILE):
                self.raced = False
            elif wire[_OPCODE] == Opcode.RENAME:
                self.raced = True
        self._handle(wire, source, now)

    def _on_outgoing(self, now: float) -> list[tuple[Address, bytes]]:
        replies = self._outgoing(now)
        if all(self._is_file(path) for path in self._paths):
            if self._missing_since is not None:
                self.nameless = max(self.nameless, now - self._missing_since)
            self._missing_since = None
        elif self._missing_since is None:
            self._missing_since = now
        return replies

    def _is_file(self, path: bytes) -> bool:
        with suppress(OSError):
            return self._here.card.stat(path).kind is Kind.FILE
        return False


def names_that_stay(operation: Call, others: Model | None) -> list[bytes]:
    """Return which files keep their names whatever is done first."""
    ends = [after(operation), *([] if others is None else [others(BEFORE) or {}])]
    return [name for name, data in BEFORE.items() if data is not None and all(name in end for end in ends)]


def ends(*plays: tuple[Model, bool]) -> list[State]:
    """Return what a local disk may have after calls that ran beside each other: each one was carried out at
    one moment, as a whole. The flag tells whether a call succeeded; one that failed did all or nothing."""
    found = []
    for order in permutations(plays):
        for chosen in product(*((True,) if succeeded else (True, False) for _, succeeded in order)):
            state: State | None = BEFORE
            for (model, _), happened in zip(order, chosen, strict=True):
                if happened and state is not None:
                    state = model(state)
            if state is not None and state not in found:
                found.append(state)
    return found


def expected(scene: Scene, watch: Watch, done: bool) -> list[State]:
    """Return what the directory may have now. done: the operation succeeded."""
    others = scene.others
    plays = [
        (OPERATIONS[scene.operation], done and not (others is not None and scene.operation in SATISFIED))
    ]
    if others is not None:
        plays.append((others.model, scene.succeeded))
    found = ends(*plays)
    if others is not None and others.outside and (watch.raced or scene.operation in REPLACING):
        found.append(after(scene.operation))  # what others did is replaced
    removes = others is not None and others.outside and NAME not in (others.model(BEFORE) or {})
    if removes and scene.operation in IN_PLACE:
        found.append(after(scene.operation))  # when it was to be placed, the name was free
    if removes and scene.operation in IN_PLACE and PROFILES[scene.here.profile].storage is not Storage.POSIX:
        found.append(BEFORE)  # the old file got its name back when others removed the new one
    if scene.operation in (append, append_in_doubt) and others is not None and not others.outside:
        # It asks for the size, then writes. In a mount the kernel's lock keeps others out meanwhile.
        found.append(BEFORE | {NAME: bytes(len(OLD)) + NEW})
    return found


def judge_views(scene: Scene, seen: object) -> None:
    """Hold what programs read to one moment: never a mixture, and nothing that was not there."""
    moments = [BEFORE]
    if scene.others is not None:
        moments += [state for state in [scene.others.model(BEFORE)] if state is not None]
    if scene.operation is take_back:
        assert seen is not True or scene.others is not None
    elif seen is not None:
        assert seen in [VIEWS[scene.operation](state) for state in moments]
    if scene.saw is not None:
        ours = after(scene.operation).get(NAME)
        assert scene.saw in (BEFORE[NAME], ours, *ON_THE_WAY.get(scene.operation, ()))


def require(found: State, ends: Sequence[State]) -> None:
    """Assert that the directory is one of these, in words that a person can read."""
    assert found in ends, f"{summary(found)}, not one of {[summary(end) for end in ends]}"


def summary(state: State) -> dict[str, str]:
    """Name the contents of a directory by their length and checksum."""
    return {
        name.decode(): "directory" if data is None else f"{len(data)}:{crc32(data):x}"
        for name, data in sorted(state.items())
    }


async def settle(tree: Tree, here: Rig, ends: Sequence[State], held: Sequence[bytes] = ()) -> None:
    """Wait until all is tidied up: the card has one of these, and the tree shows the same, except for what is
    held here."""
    for _ in range(3):  # listings, and time to clean up what they show
        tree.forget_caches()
        await tree.list(D)
        await trio.sleep(15.0)
        card = on_card(here)
        if card in ends:
            break
    require(card, ends)
    ours = {path[len(D) + 1 :] for path in held}
    shown = {name: stat.size for name, stat in await tree.list(D) if name not in ours}
    there = {name: data for name, data in card.items() if name not in ours}
    assert set(shown) == set(there)
    assert all(shown[name] == len(data) for name, data in there.items() if data is not None)


async def judge_next_mount(tree: Tree, here: Rig, ends: Sequence[State]) -> None:
    """List once, and wait until that mount put right what the last one left."""
    await tree.list(D)
    await trio.sleep(NEXT_MOUNT)
    require(visible(here), ends)
    await trio.sleep(NOBODY_UPLOADS - NEXT_MOUNT)
    await settle(tree, here, ends)


async def wait_for_others(scene: Scene) -> None:
    """Wait until others did what they began, while a program lists the directory now and then."""
    while scene.others is not None and not scene.over.is_set():
        with trio.move_on_after(20.0):
            await scene.over.wait()
        with suppress(MavftpfsError):
            scene.tree.forget_caches()
            await scene.tree.list(D)
