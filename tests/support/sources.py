"""What an upload sends, in memory, with books kept so strictly that a breach of the contract shows."""

from __future__ import annotations

from collections.abc import Iterable

from mavftpfs.shared.extents import ExtentSet


class MemorySource:
    """Implements cache.remote.UploadSource over content that may grow (`add`)."""

    def __init__(self, content: bytes = b"") -> None:
        self.content = bytearray(content)
        self.dirty = ExtentSet([(0, len(content))])
        self.in_flight = ExtentSet()
        self.acked = ExtentSet()
        self.proven = ExtentSet()
        self.checkpoints = 0
        self.rollbacks: list[bool] = []

    def add(self, data: bytes) -> None:
        """Append; the upload has to be woken."""
        start = len(self.content)
        self.content += data
        self.dirty.add(start, len(self.content))

    @property
    def all_proven(self) -> bool:
        return self.proven.covers(0, len(self.content)) and self.dirty.empty and self.in_flight.empty

    def next_chunk(self, limit: int) -> tuple[int, bytes] | None:
        piece = self.dirty.take_first(limit)
        if piece is None:
            return None
        self.in_flight.add(*piece)
        return piece[0], bytes(self.content[piece[0] : piece[1]])

    def on_acked(self, offset: int, count: int) -> None:
        assert count > 0
        self._take(offset, count)
        self.acked.add(offset, offset + count)

    def on_unsent(self, offset: int, count: int) -> None:
        self._take(offset, count)
        self.dirty.add(offset, offset + count)

    def on_checkpoint(self) -> None:
        assert self.in_flight.empty, "a checkpoint with bytes in flight"
        self.checkpoints += 1
        _move(self.acked, self.proven)

    def on_rollback(self, everything: bool) -> None:
        assert self.in_flight.empty, "a rollback with bytes in flight"
        self.rollbacks.append(everything)
        _move(self.acked, self.dirty)
        if everything:
            _move(self.proven, self.dirty)

    def _take(self, offset: int, count: int) -> None:
        assert self.in_flight.covers(offset, offset + count), "news of bytes that are not in flight"
        self.in_flight.discard(offset, offset + count)


def _move(source: ExtentSet, target: ExtentSet) -> None:
    moved: Iterable[tuple[int, int]] = list(source)
    for start, stop in moved:
        target.add(start, stop)
    source.clear()
