"""The things that an event of the matrix may touch, and those who change the directory meanwhile."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field

import trio

from mavftpfs.cache.temporary import is_temporary
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import MavftpfsError
from tests.support.matrix.operations import IN_PLACE, Call, D, Model, State, allowed, in_place
from tests.support.rigs import Rig

IN_TIME = 60.0
"""Virtual seconds. A call makes a few requests, each of which may take the deadline and 4 s to find out."""


def on_card(here: Rig) -> State:
    """Return what is in the directory on the card, litter included."""
    found: State = {path[len(D) + 1 :]: data for path, data in here.files().items() if path.startswith(D)}
    return found | {path[len(D) + 1 :]: None for path in here.directories() if path != D}


def visible(here: Rig) -> State:
    """Return what is in the directory on the card under names that programs see."""
    return {name: data for name, data in on_card(here).items() if not is_temporary(name)}


class Gone(MavftpfsError):
    """The file was not there, so others did nothing."""


@dataclass
class Scene:
    """The things that an event may touch.

    Attributes:
        at_end: called when the operation ended.
        others: those who change the directory; None until they begin, and if they did nothing.
        succeeded: whether they did what they began. over: set when they end.
        effect: to be called when their change happened on the card.
        saw: what another program read.
        taken: whether all writes of the program were taken before its call failed.
    """

    here: Rig
    tree: Tree
    operation: Call
    caller: trio.CancelScope
    effect: Callable[[], None]
    at_end: list[Callable[[], None]] = field(default_factory=list)
    others: Others | None = None
    succeeded: bool = False
    over: trio.Event = field(default_factory=trio.Event)
    saw: bytes | None = None
    taken: bool = False

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
            assert visible(self.here) in allowed(self.operation)

    def begin(self, others: Others) -> None:
        """Have others begin."""

        async def act() -> None:
            began = trio.current_time()
            try:
                await others.act(self)
                self.succeeded = True
            except Gone:
                self.others = None
            except MavftpfsError:
                pass
            assert others.outside or trio.current_time() - began <= IN_TIME
            self.over.set()

        self.others = others
        self.here.nursery.start_soon(act)


Event = Callable[[Scene, int], None]
"""Has something happen when so many requests of the operation came."""


class Others:
    """An event: others change the directory.

    Attributes:
        model: what that does to the directory. act: does it; Gone says that nothing was done, another
            MavftpfsError that all or nothing was.
        outside: the change does not go through this mount.
    """

    def __init__(
        self, name: str, model: Model, act: Callable[[Scene], Awaitable[None]], *, outside: bool = False
    ) -> None:
        self.__name__ = name
        self.model = model
        self.act = act
        self.outside = outside

    def __call__(self, scene: Scene, count: int) -> None:
        """Have them begin at a request."""
        scene.here.faults.after(count, lambda: scene.begin(self))
