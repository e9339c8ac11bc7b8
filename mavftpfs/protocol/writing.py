"""Writing an open file by a window of WriteFile requests. Layer: protocol; pure.

The source gives chunks in ascending order. The bytes of a lost request go back to its `todo`, and are sent
again at the same offset, so executing both requests changes nothing.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Protocol

from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.operations import BEYOND
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.protocol.requests import (
    NO_FILE_CODES,
    RETRY_POLICIES,
    WRITE_POLICY,
    Operation,
    Request,
    Run,
    nak_of,
)
from mavftpfs.shared.errors import FtpNak, LocalProtocolError, MavftpfsError, SessionLost
from mavftpfs.shared.ranges import Ranges

MAX_OFFSET = 1 << 32
"""Offsets are 32 bits on the wire; the end of a file must fit too (servers.md 14.27)."""

_WRITE = int(Opcode.WRITE_FILE)
_LIST = int(Opcode.LIST_DIRECTORY)
_NAK = int(Opcode.NAK)
_COUNT_SIZE = 4
_ROW = 64
"""Most chunks to take from the source at once."""

_NO_FILE_ERRNOS = frozenset((0, 9))
"""PX4 says errno 0, or EBADF, to a write in a session that another client reset."""

_MOST_LISTINGS = 3
"""After so many listings of the root, with nothing ACKed between them, a refusal means what it says. A late
copy of a request with a path may come behind one of them."""

_PATH_CODES = frozenset((NakCode.FILE_PROTECTED, NakCode.FILE_EXISTS))


class ChunkSource(Protocol):
    """Supplies the bytes. ranges: bytes to be sent, and bytes in flight."""

    ranges: Ranges

    def has_more(self) -> bool:
        """Return whether there are bytes to send now."""
        ...

    def next_chunk(self, limit: int) -> tuple[int, bytes] | None:
        """Return (offset, 1..limit bytes), moved to `ranges.out`, or None if there is nothing for now.

        Raises:
            MavftpfsError: the bytes could not be read. The transfer fails with that.
        """
        ...

    def on_acked(self, start: int, stop: int) -> None:
        """Note that these bytes were written: remove them from `ranges`. Some may have been ACKed before."""
        ...


class Pieces:
    """A source of pieces in a row. No request ends within a piece, unless the piece is longer than a request.
    progress: called with the bytes of each ACK.
    """

    def __init__(self, pieces: Sequence[bytes], progress: Callable[[int], None] | None = None) -> None:
        self._content = b"".join(pieces)
        self._ends = list(accumulate(map(len, pieces)))
        self._progress = progress
        self.ranges = Ranges()
        self.ranges.todo.add(0, len(self._content))

    def has_more(self) -> bool:
        """See ChunkSource."""
        return not self.ranges.todo.empty

    def next_chunk(self, limit: int) -> tuple[int, bytes] | None:
        """See ChunkSource."""
        first = self.ranges.todo.first()
        if first is None:
            return None
        start, stop = first[0], min(first[1], first[0] + limit)
        whole = bisect_right(self._ends, stop)
        if whole and self._ends[whole - 1] > start:
            stop = self._ends[whole - 1]
        self.ranges.take(start, stop)
        return start, self._content[start:stop]

    def on_acked(self, start: int, stop: int) -> None:
        """See ChunkSource."""
        self.ranges.on_done(start, stop)
        if self._progress is not None:
            self._progress(stop - start)


class WriteTransfer(Operation):
    """Writes what a source has for as long as its owner likes.

    Args:
        session: id of the file open for writing. chunks: the size of requests.
        root: a directory to list when other requests with a path may disturb the next write (see
            `pathgate`); None: a write that is refused for that fails.
        in_flight: the most requests unanswered at once, None as the engine's window allows; 1 = strict order.

    Attributes:
        paused: send nothing new, but still take the answers to requests in flight.

    Fails with SessionLost (from the FtpNak, if that may be a full card), FtpNak, RequestTimeout, or the
    source's error. At the end, `finish` included, bytes that were not ACKed return to `todo` of the source.
    """

    urgent = False
    paced = False  # what a slow card cannot take would be lost, and leave holes for a while

    bulk = _WRITE

    def __init__(
        self,
        session: int,
        source: ChunkSource,
        chunks: ChunkSize | None = None,
        *,
        root: bytes | None = None,
        in_flight: int | None = None,
    ) -> None:
        self.chunks = ChunkSize() if chunks is None else chunks
        self.session = session
        self._source = source
        self._root = root
        self._listing: Request | None = None  # of the root, to be answered before the next write
        self._listings = 0  # of the root, since something was ACKed
        self._in_flight = in_flight
        self._full_ack = self.chunks.most.to_bytes(_COUNT_SIZE, "little")
        self.paused = False

    # --- what the owner says and sees

    @property
    def drained(self) -> bool:
        """Whether the source has nothing, and all bytes that it gave were ACKed."""
        return self._source.ranges.out.empty and not self._source.has_more()

    @property
    def idle(self) -> bool:
        """Whether nothing is in flight, and nothing can be sent: the source is empty, or this is paused."""
        return self._source.ranges.out.empty and (self.paused or not self._source.has_more())

    # --- requests

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return WriteFile requests for bytes in a row."""
        chunk = self.chunks.next_size(now)
        if self._in_flight is not None:
            most = min(most, self._in_flight - -(-self._source.ranges.out.total // chunk))
        if self.paused or most <= 0:
            return []
        if self._listing is not None:
            waits = self._listing.outstanding or not self._source.ranges.out.empty
            return [] if waits else [self._listing]
        piece = self._new_piece((1 if self.chunks.trying else min(most, _ROW)) * chunk)
        if piece is None:
            return []
        session, (offset, data) = self.session, piece
        return [
            Request(self, _WRITE, WRITE_POLICY, session, offset + at, len(part), part)
            for at in range(0, len(data), chunk)
            for part in (data[at : at + chunk],)
        ]

    def on_lost(self, request: Request, now: float) -> None:
        """Send its bytes again, or list the root again."""
        if request is self._listing:
            self._listing = request.anew()
        elif request.opcode == _WRITE:
            self.chunks.on_lost(request.size, request.sent_at, now)
            self._source.ranges.on_lost(request.offset, request.stop)

    def on_paths(self) -> None:
        """Have the root listed before the next write. A listing sets right what paths disturb, and clears a
        sticky errno. One request from beyond any end suffices; whatever it answers, the next write tells."""
        root = self._root
        if self._listing is None and root is not None:
            policy = RETRY_POLICIES[_LIST]
            self._listing = Request(self, _LIST, policy, 0, BEYOND, len(root), root, follows=True)

    def _new_piece(self, limit: int) -> tuple[int, bytes] | None:
        """Return at most `limit` bytes of the source; None if it has none, or fails."""
        try:
            piece = self._source.next_chunk(limit)
        except MavftpfsError as error:
            self.fail(error)
            return None
        if piece is None:
            return None
        offset, data = piece
        if not 1 <= len(data) <= limit or not 0 <= offset <= MAX_OFFSET - len(data):
            self.fail(LocalProtocolError(f"{len(data)} bytes at {offset} do not fit WriteFile requests"))
            return None
        return piece

    # --- replies

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Take what was written, or end with what a refusal means."""
        if request.opcode == _LIST:
            if request is self._listing:
                self._listing = None
                self._listings += 1
        elif reply.opcode != _NAK:
            self.on_run([(request, reply.data)], now, placed=reply.offset == request.offset)
        else:
            nak = nak_of(request, reply)
            if is_path_refusal(nak) and self._root is not None and self._listings < _MOST_LISTINGS:
                self._source.ranges.on_lost(request.offset, request.stop)
                self.port.traits.paths_block_writes = True
                self.on_paths()
            else:
                self.fail(self._meaning(nak))

    def on_run(self, run: Run, now: float, *, placed: bool = True) -> None:
        """Take what was written, in a row at once. placed: answers have the requests' offsets."""
        usual, full = self._full_ack, self.chunks.most
        first = run[0][0]
        start = stop = first.offset
        self.chunks.on_answered(first.size, len(run), first.sent_at, now)
        if placed and run[-1][0].offset:
            self.port.traits.write_ack_offset = True
        for request, data in run:
            offset, count = request.offset, request.size
            if data != usual or count != full:
                count = self._written(request, data)
            if offset != stop:
                self._on_written(start, stop, now)
                start = offset
            stop = offset + count
            if count < request.size:
                self._source.ranges.on_lost(stop, request.stop)
        self._on_written(start, stop, now)

    def _on_written(self, start: int, stop: int, now: float) -> None:
        if start < stop:
            self.progress(now)
            self._listings = 0
            self._source.on_acked(start, stop)

    def _written(self, request: Request, data: bytes) -> int:
        """Return how many bytes an ACK stands for (servers.md 8: only PX4 says, and may write less)."""
        if len(data) != _COUNT_SIZE:
            return request.size
        count = int.from_bytes(data, "little")
        # More than was sent: an answer to something else. Nothing is proven, so it goes again.
        return count if count <= request.size else 0

    def _meaning(self, nak: FtpNak) -> MavftpfsError:
        # On MAVSDK 1 may be a full card, too: then the session is lost again and again without progress, and
        # the upload fails with the refusal, after which nobody tries it again.
        if nak.code in NO_FILE_CODES or nak.server_errno in _NO_FILE_ERRNOS:
            lost = SessionLost(str(nak), by_server=True)
            if nak.code == NakCode.FAIL:
                lost.__cause__ = nak
            return lost
        return nak

    def finish(self) -> None:
        """End, and return bytes that were not ACKed to the source. A request that arrives late does no more
        than a repetition, as long as its file is open."""
        if not self.done:
            self._source.ranges.give_back()
        super().finish()


def is_path_refusal(nak: FtpNak) -> bool:
    """Return whether this is how PX4 refuses to write after it was asked for a path beyond its whitelist."""
    return nak.opcode == Opcode.WRITE_FILE and nak.code in _PATH_CODES
