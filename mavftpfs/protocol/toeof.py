"""Reading a file whose size is a lie. Layer: protocol; pure."""

from __future__ import annotations

from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload
from mavftpfs.protocol.requests import READ_MANNER, Operation, Priority, Request, nak_of
from mavftpfs.shared.errors import DataUnproven, LocalProtocolError, SessionLost

_AHEAD = 3


class ReadToEof(Operation):
    """Reads an `@` file from 0 to its end by one constant block size, never clamped (servers.md 14.13).

    The end is NAK EOF (or an ACK of size 0) on the block behind the last; only the last block may be short.

    Attributes:
        data: the whole content, once done without error.

    Fails with DataUnproven (longer than `limit`, or a short block in the middle), SessionLost, FtpNak.
    """

    rank = Priority.DEMAND

    def __init__(self, session: int, chunk: int, limit: int) -> None:
        super().__init__()
        if not 1 <= chunk <= MAX_DATA:
            raise LocalProtocolError(f"a chunk of {chunk} bytes is not within 1..{MAX_DATA}")
        self.data = b""
        self._session = session
        self._chunk = chunk
        self._limit = limit
        self._blocks: dict[int, bytes] = {}
        self._whole = 0  # blocks 0.._whole-1 are there
        self._next = 0
        self._end: int | None = None  # lowest index known to hold nothing
        self._last: int | None = None  # index of a short block

    def next_request(self, now: float) -> Request | None:
        """Return the request for the next block; at most a few ahead of what is known to exist."""
        if self._next > self._whole + _AHEAD or not self._plausible(self._next):
            return None
        offset = self._next * self._chunk
        self._next += 1
        return Request(self, int(Opcode.READ_FILE), READ_MANNER, self._session, offset, self._chunk)

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Keep a block, or learn where the end is."""
        index = request.offset // self._chunk
        if reply.opcode == Opcode.NAK:
            nak = nak_of(request, reply)
            ended = nak.code == NakCode.FILE_EXISTS and self._ends_short(index)
            if nak.code == NakCode.EOF or ended:
                self._on_end(index)
            elif nak.code in (NakCode.INVALID_SESSION, NakCode.FILE_NOT_FOUND, NakCode.FAIL):
                self.fail(SessionLost(str(nak), by_server=True))
            else:
                self.fail(nak)
        elif not reply.data:
            self._on_end(index)
        else:
            self._on_block(index, reply.data[: self._chunk])

    def _plausible(self, index: int) -> bool:
        """Whether a block may still be found there, or its absence is still to be proven."""
        if self._end is not None and index >= self._end:
            return False
        return self._last is None or index <= self._last + 1

    def _ends_short(self, index: int) -> bool:
        # PX4 may say 8 for EOF (sticky EEXIST): believed only behind a short block.
        return 0 < len(self._blocks.get(index - 1, b"")) < self._chunk

    def _on_block(self, index: int, block: bytes) -> None:
        self._blocks[index] = block
        if index * self._chunk + len(block) > self._limit:
            self.fail(DataUnproven(f"longer than the limit of {self._limit} bytes"))
            return
        if len(block) < self._chunk and (self._last is None or index < self._last):
            self._last = index
        while self._whole in self._blocks:
            self._whole += 1
        self._maybe_finish()

    def _on_end(self, index: int) -> None:
        if self._end is None or index < self._end:
            self._end = index
        self._maybe_finish()

    def _maybe_finish(self) -> None:
        end, last = self._end, self._last
        newest = max(self._blocks, default=-1)
        if (end is not None and newest >= end) or (last is not None and newest > last):
            self.fail(DataUnproven("blocks of different lengths of the file do not fit together"))
        elif end is not None and self._whole == end:
            self.data = b"".join(self._blocks[index] for index in range(end))
            self.finish()
