"""What of a file is to be transferred, and what requests are out for. Layer: shared; pure.

Reading and writing have the same shape. A byte is in `todo` until a request for it goes out, then in `out`,
and then it is done: it arrived, or was ACKed. A lost request has one consequence: its bytes go back to
`todo`, and the code that asked for them the first time asks again. An answer that comes after that still
counts.
"""

from __future__ import annotations

from mavftpfs.shared.extents import ExtentSet


class Ranges:
    """The bytes of one transfer that are not done.

    Attributes:
        todo: bytes that no request is out for. out: bytes that a request is out for.
    """

    __slots__ = ("out", "todo")

    def __init__(self) -> None:
        self.todo, self.out = ExtentSet(), ExtentSet()

    @property
    def empty(self) -> bool:
        """Whether all is done."""
        return self.todo.empty and self.out.empty

    def take(self, start: int, stop: int) -> None:
        """Note that a request goes out for [start, stop), which is to be done."""
        self.todo.discard(start, stop)
        self.out.add(start, stop)

    def on_done(self, start: int, stop: int) -> None:
        """Note that these bytes arrived, or were ACKed, whatever request that answered."""
        self.todo.discard(start, stop)
        self.out.discard(start, stop)

    def on_lost(self, start: int, stop: int) -> None:
        """Note that a request for these bytes is lost: those that are not done are to be done again."""
        for part in self.out.intersection(start, stop):
            self.out.discard(*part)
            self.todo.add(*part)

    def give_back(self) -> None:
        """Lose all requests: nobody takes their answers."""
        for part in self.out:
            self.todo.add(*part)
        self.out = ExtentSet()
