"""What an upload sends, in memory, which fails where the session breaks the contract."""

from __future__ import annotations

from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.sending import SendBuffer


class MemorySource(SendBuffer):
    """Content that may grow (`add`)."""

    def __init__(self, content: bytes = b"") -> None:
        self.content = bytearray(content)
        super().__init__(self.read, len(content))
        self.checkpoints = 0
        self.rollbacks: list[bool] = []

    def read(self, start: int, stop: int) -> bytes:
        return bytes(self.content[start:stop])

    def add(self, data: bytes) -> None:
        """Append; the upload has to be woken."""
        self.content += data
        self.on_changed(self.size, len(self.content))

    @property
    def all_proven(self) -> bool:
        return self.proven.covers(0, len(self.content))

    @property
    def in_flight(self) -> ExtentSet:
        known = ExtentSet([*self.todo, *self.acked, *self.proven])
        return ExtentSet(known.missing(0, self.size))

    def on_acked(self, offset: int, count: int) -> None:
        assert count > 0
        self._require_in_flight(offset, count)
        super().on_acked(offset, count)

    def on_unsent(self, offset: int, count: int) -> None:
        self._require_in_flight(offset, count)
        super().on_unsent(offset, count)

    def check_point(self) -> None:
        assert self.in_flight.empty, "a checkpoint with bytes in flight"
        self.checkpoints += 1
        super().check_point()

    def roll_back(self, *, everything: bool) -> None:
        assert self.in_flight.empty, "a rollback with bytes in flight"
        if self.closed or not self.acked.empty:
            self.rollbacks.append(everything)
        super().roll_back(everything=everything)

    def _require_in_flight(self, offset: int, count: int) -> None:
        assert self.in_flight.covers(offset, offset + count), "news of bytes that are not in flight"
