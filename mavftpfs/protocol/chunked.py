"""What moves a file in chunks. Layer: protocol; pure."""

from __future__ import annotations

from mavftpfs.protocol.chunks import Chunks
from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.protocol.requests import Operation, Request
from mavftpfs.shared.errors import LocalProtocolError


class Chunked(Operation):
    """Has requests of a size that may change.

    Args:
        chunk: most bytes of a request, 1..239.

    Attributes:
        chunk: most bytes of the next request, most: of any.
        chunks: chooses fewer where fewer bring more; None, as at first: nobody does.
    """

    def __init__(self, chunk: int) -> None:
        super().__init__()
        if not 1 <= chunk <= MAX_DATA:
            raise LocalProtocolError(f"a chunk of {chunk} bytes is not within 1..{MAX_DATA}")
        self.chunk = self.most = chunk
        self.chunks: Chunks | None = None
        self._now = 0.0

    def limit_chunk(self, size: int) -> None:
        """The server never has more: so much it is from now on."""
        self.chunks = None
        self.chunk = self.most = size

    def measure_row(self, most: int, now: float) -> int:
        """Set `chunk` for the next requests; return how many of that size may go out, at most `most`."""
        chunks = self.chunks
        if chunks is None:
            return most
        self.chunk = min(self.most, chunks.next_size(now))
        return 1 if chunks.trying else most

    def count_answered(self, request: Request, count: int, now: float) -> None:
        """`count` requests that went out with this one were answered by ACKs."""
        if self.chunks is not None:
            self.chunks.on_answered(request.size, count, now)

    def waits(self, now: float) -> bool:
        """See Operation; asked before anything goes out."""
        self._now = now
        return super().waits(now)

    def takes_back(self, request: Request) -> bool:
        """See Operation: a lost one that is too long goes out in pieces."""
        if self.chunks is None or request.opcode != self.bulk:
            return False
        split = self.chunks.on_lost(request.size, self._now)
        if split:
            self.take_back(request)
        return split

    def take_back(self, request: Request) -> None:
        """Have the bytes of a request asked for anew."""
        raise NotImplementedError
