"""Faults at exact places: the link breaks after the Nth request, or one certain reply is lost."""

from __future__ import annotations

from collections.abc import Callable

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode
from tests.support.worlds import World

_OPCODE, _REQ_OPCODE = 3, 5
LOST = 400
"""Bytes that a card forgets: less than a sector."""


class Faults:
    """Stands between a world's vehicle and its FTP server.

    Attributes:
        requests: opcodes that reached the server so far. refused: opcodes of requests that were NAKed.
    """

    def __init__(self, world: World) -> None:
        self.requests: list[int] = []
        self.refused: list[int] = []
        self._world = world
        self._cut_after: int | None = None
        self._lose: list[int] = []
        self._deaf: set[int] = set()
        self._counted: dict[int, Callable[[], None]] = {}
        self._hooks: list[tuple[int, Callable[[], None]]] = []
        self._repeated: set[int] = set()
        server = world.vehicle.server
        self._handle, self._outgoing = server.handle, server.outgoing
        server.handle = self._on_request  # type: ignore[method-assign]
        server.outgoing = self._on_replies  # type: ignore[method-assign]

    def cut_after(self, count: int | None) -> None:
        """Let `count` requests through and nothing after them, either way; None ends that."""
        self._cut_after = None if count is None else len(self.requests) + count

    def lose_reply_to(self, opcode: Opcode) -> None:
        """Lose the next reply to a request of this kind."""
        self._lose.append(int(opcode))

    def ignore(self, opcode: Opcode) -> None:
        """Have requests of this kind neither executed nor answered."""
        self._deaf.add(int(opcode))

    def at(self, opcode: Opcode, action: Callable[[], None]) -> None:
        """Do something before the next request of this kind is executed."""
        self._hooks.append((int(opcode), action))

    def after(self, count: int, action: Callable[[], None]) -> None:
        """Do something when `count` more requests came to the server, before the last of them is executed."""
        self._counted[len(self.requests) + count] = action

    def repeat(self, count: int) -> None:
        """Have the request arrive twice that comes after `count` - 1 more ones."""
        self._repeated.add(len(self.requests) + count)

    def call_off(self) -> None:
        """Let what was to happen at a count of requests not happen any more."""
        self._counted.clear()
        self._repeated.clear()

    def _on_request(self, wire: bytes, source: Address, now: float) -> None:
        self._execute(wire, source, now)
        if len(self.requests) in self._repeated:
            self._repeated.remove(len(self.requests))
            self._execute(wire, source, now)

    def _execute(self, wire: bytes, source: Address, now: float) -> None:
        if self._is_cut() or wire[_OPCODE] in self._deaf:
            return
        self.requests.append(wire[_OPCODE])
        self._counted.pop(len(self.requests), lambda: None)()
        for hook in [hook for hook in self._hooks if hook[0] == wire[_OPCODE]]:
            self._hooks.remove(hook)
            hook[1]()
        self._handle(wire, source, now)

    def _on_replies(self, now: float) -> list[tuple[Address, bytes]]:
        replies = self._outgoing(now)
        self.refused += [wire[_REQ_OPCODE] for _, wire in replies if wire[3] == Opcode.NAK]
        return [reply for reply in replies if not self._is_lost(reply[1])]

    def _is_lost(self, wire: bytes) -> bool:
        if self._is_cut():
            return True
        if wire[_REQ_OPCODE] in self._lose:
            self._lose.remove(wire[_REQ_OPCODE])
            return True
        return False

    def _is_cut(self) -> bool:
        return self._cut_after is not None and len(self.requests) >= self._cut_after


def power_goes_at_close(world: World, *, downtime: float, beat_after: float) -> None:
    """Have the vehicle restart where the next TerminateSession comes; it forgets the end of the file."""
    server = world.vehicle.server
    handle = server.handle

    def power_cut(wire: bytes, source: Address, now: float) -> None:
        if wire[_OPCODE] != Opcode.TERMINATE_SESSION:
            handle(wire, source, now)
            return
        server.handle = handle  # type: ignore[method-assign]
        [path] = server.open_paths
        data = bytes(world.tree.data(path))
        world.vehicle.reboot(now, downtime, beat_after=beat_after)
        world.tree.add(path, data[:-LOST] + bytes(LOST))

    server.handle = power_cut  # type: ignore[method-assign]
