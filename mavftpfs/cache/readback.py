"""Reads what was written back from the card, past every cache. Layer: cache."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import trio

from mavftpfs.cache.remote import Reader, ReadSink, RemoteStore
from mavftpfs.shared.errors import DataUnproven, FileChanged, RequestTimeout

PIECE = 64 * 1024
"""Bytes held at once."""

TRIES = 3
"""How often it is read anew because another FTP client may have mixed up the bytes."""


async def agrees(
    store: RemoteStore,
    path: bytes,
    extents: Iterable[tuple[int, int]],
    expected: Callable[[int, int], bytes],
    *,
    patience: float,
) -> bool:
    """Return whether a file's bytes in `extents` are the expected ones; a shorter file does not agree.

    patience: seconds without any byte after which it is given up.

    Raises:
        RequestTimeout. DataUnproven: another FTP client was active each time. Else as open_reader.
    """
    wanted = list(extents)
    for _ in range(TRIES):
        sink = _Piece(patience)
        reader = await store.open_reader(path, sink)
        try:
            same = await _compare(reader, sink, wanted, expected)
        except FileChanged:
            return False
        finally:
            reader.close()
        if not sink.suspect:
            return same
    raise DataUnproven(f"another FTP client was active whenever {path!r} was read back")


async def _compare(
    reader: Reader, sink: _Piece, extents: list[tuple[int, int]], expected: Callable[[int, int], bytes]
) -> bool:
    if any(stop > reader.size for _, stop in extents):
        return False
    for start, stop in extents:
        for at in range(start, stop, PIECE):
            end = min(at + PIECE, stop)
            if await sink.take(reader, at, end) != expected(at, end):
                return False
    return True


class _Piece(ReadSink):
    """Takes one range of a file after the other.

    Attributes:
        suspect: the bytes may be another file's.
    """

    def __init__(self, patience: float) -> None:
        self.suspect = False
        self._patience = patience
        self._start = 0
        self._data = bytearray()
        self._gaps: list[tuple[int, int]] = []
        self._error: Exception | None = None
        self._news = trio.Event()

    async def take(self, reader: Reader, start: int, stop: int) -> bytes:
        """Return the bytes [start, stop).

        Raises:
            RequestTimeout, or why they cannot be had.
        """
        self._start, self._data, self._gaps = start, bytearray(stop - start), [(start, stop)]
        reader.want(start, stop, demand=True)
        while self._gaps and self._error is None:
            self._news = trio.Event()
            with trio.move_on_after(self._patience) as scope:
                await self._news.wait()
            if scope.cancelled_caught:
                raise RequestTimeout("nothing of what was written could be read back")
        if self._error is not None:
            raise self._error
        return bytes(self._data)

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """See ReadSink: only the present range is wanted."""
        cut = [(max(start, a), min(stop, b)) for a, b in self._gaps]
        return [(a, b) for a, b in cut if a < b]

    def on_opened(self, at: float) -> None:
        """See ReadSink: another file would not compare."""

    def on_data(self, offset: int, data: bytes) -> None:
        """See ReadSink."""
        end = offset + len(data)
        for a, b in self.missing(offset, end):
            self._data[a - self._start : b - self._start] = data[a - offset : b - offset]
        left = [piece for a, b in self._gaps for piece in ((a, min(b, offset)), (max(a, end), b))]
        self._gaps = [(a, b) for a, b in left if a < b]

    def on_batch(self) -> None:
        """See ReadSink."""
        self._news.set()

    def on_queued(self) -> None:
        """See ReadSink."""
        self._news.set()

    def on_suspect(self, reason: str) -> None:
        """See ReadSink."""
        self.suspect = True

    def on_failed(self, error: Exception) -> None:
        """See ReadSink."""
        self._error = error
        self._news.set()
