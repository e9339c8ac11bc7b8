"""Requests that the network delivers late, or once more: at an exact place among those that came after them,
or at an exact time.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

import trio

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode
from tests.support.rigs import Rig

_OPCODE = 3


class Latecomer:
    """Has a request of a kind executed once more, right after the server got the nth of another kind.

    Which request of a kind: the first, or the last that came before. Its answer travels like any other.

    Attributes:
        late: seconds after the first execution; None while it was not repeated.
    """

    def __init__(
        self,
        here: Rig,
        what: Opcode,
        *,
        after: Opcode,
        nth: int = 1,
        first: bool = False,
    ) -> None:
        self.late: float | None = None
        self._here = here
        self._what, self._after, self._left = what, after, nth
        self._first = first
        self._kept: tuple[bytes, float] | None = None
        here.faults.orphans = True
        self._handle = here.server.handle
        here.server.handle = self._on_request  # type: ignore[method-assign]

    def _on_request(self, wire: bytes, source: Address, now: float) -> None:
        self._handle(wire, source, now)
        if self.late is not None:
            return
        if wire[_OPCODE] == self._after and self._kept is not None:
            self._left -= 1
            if self._left == 0:
                self.late = now - self._kept[1]
                self._handle(self._kept[0], source, now)
                self._here.link.kick()
        if wire[_OPCODE] == self._what and not (self._first and self._kept is not None):
            self._kept = (wire, now)


def come_late(here: Rig, seconds: float, opcode: Opcode) -> trio.Event:
    """Have the next request of a kind executed only so long after it came; the event is set then."""
    numbers = count(1)

    def chosen(wire: bytes) -> bool:
        return wire[_OPCODE] == opcode and next(numbers) == 1

    return come_again(here, seconds, chosen, at_once=False)


def come_again(
    here: Rig, seconds: float, chosen: Callable[[bytes], bool], *, at_once: bool = True
) -> trio.Event:
    """Have requests executed so long after they came, where they are chosen; at_once: then, too."""
    handle, came = here.server.handle, trio.Event()
    here.faults.orphans = True

    async def later(wire: bytes, source: Address) -> None:
        await trio.sleep(seconds)
        handle(wire, source, trio.current_time())
        here.link.kick()
        came.set()

    def on_request(wire: bytes, source: Address, now: float) -> None:
        late = chosen(wire)
        if late:
            here.nursery.start_soon(later, wire, source)
        if at_once or not late:
            handle(wire, source, now)

    here.server.handle = on_request  # type: ignore[method-assign]
    return came
