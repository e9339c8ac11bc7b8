"""The bytes of a file that are still to be transferred, and those in flight. Layer: shared; pure.

Reading and writing have the same shape. A byte is in `todo` until a request for it is sent, then in `out`,
and then done: it arrived, or was ACKed. A lost request has one consequence: its bytes return to `todo`, and
the same code requests them again. A late reply still counts.
"""

from __future__ import annotations

from mavftpfs.shared.extents import ExtentSet


class Ranges:
    """The bytes of one transfer that are not done.

    Attributes:
        todo: bytes without a request in flight. out: bytes with a request in flight.
    """

    __slots__ = ("out", "todo")

    def __init__(self) -> None:
        self.todo, self.out = ExtentSet(), ExtentSet()

    @property
    def empty(self) -> bool:
        """Whether all bytes are done."""
        return self.todo.empty and self.out.empty

    def take(self, start: int, stop: int) -> None:
        """Note that a request for [start, stop) is sent; these bytes must be unfinished."""
        self.todo.discard(start, stop)
        self.out.add(start, stop)

    def on_done(self, start: int, stop: int) -> None:
        """Note that these bytes arrived, or were ACKed, whichever request that answered."""
        self.todo.discard(start, stop)
        self.out.discard(start, stop)

    def on_lost(self, start: int, stop: int) -> None:
        """Note that a request for these bytes is lost: the unfinished ones return to `todo`."""
        for part in self.out.intersection(start, stop):
            self.out.discard(*part)
            self.todo.add(*part)

    def give_back(self) -> None:
        """Lose all requests, because nobody accepts their replies."""
        for part in self.out:
            self.todo.add(*part)
        self.out = ExtentSet()
