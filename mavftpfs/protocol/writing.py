"""Writing an open file by a window of WriteFile requests. Layer: protocol; pure.

The source gives chunks in ascending order, and is told what became of each: ACKed, or not sent after all.
A lost request goes out again with the same bytes at the same offset, so executing it twice changes nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.operations import BEYOND
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.protocol.requests import (
    MANNERS,
    WRITE_MANNER,
    Operation,
    Request,
    Run,
    nak_of,
)
from mavftpfs.shared.errors import (
    FtpNak,
    LocalProtocolError,
    MavftpfsError,
    RemoteProtocolError,
    SessionLost,
)
from mavftpfs.shared.extents import ExtentSet

__all__ = ["ChunkSource", "Pieces", "WriteTransfer"]

MAX_OFFSET = 1 << 32
"""Offsets are 32 bits on the wire; the end of a file must fit too (servers.md 14.27)."""

_WRITE = int(Opcode.WRITE_FILE)
_LIST = int(Opcode.LIST_DIRECTORY)
_NAK = int(Opcode.NAK)
_COUNT_SIZE = 4
_ROW = 64
"""Most chunks to take from the source at once."""

_BARREN_TOLERATED = 3
_NO_FILE_ERRNOS = frozenset((0, 9))
"""PX4 says errno 0, or EBADF, to a write in a session that another client reset."""

_SESSION_CODES = frozenset((NakCode.FAIL, NakCode.INVALID_SESSION, NakCode.FILE_NOT_FOUND))
"""Refusals of a write that mean "no file is open": MAVSDK says 1, PX4 4, ArduPilot 10 (servers.md 1). On
MAVSDK 1 may be a full card, too: then the session is lost again and again, without getting further."""


_MOST_LISTINGS = 3
"""After so many listings of the root in vain a refusal means what it says. A late copy of a request with a
path may come behind one of them."""

_PATH_CODES = frozenset((NakCode.FILE_PROTECTED, NakCode.FILE_EXISTS))


class ChunkSource(Protocol):
    """Where the bytes come from."""

    def next_chunk(self, limit: int) -> tuple[int, bytes] | None:
        """Return (offset, 1..limit bytes), now in flight, or None if there is nothing for now.

        Raises:
            MavftpfsError: the bytes could not be read. The transfer fails with that.
        """
        ...

    def on_acked(self, offset: int, count: int) -> None:
        """These bytes were written."""
        ...

    def on_unsent(self, offset: int, count: int) -> None:
        """These bytes will not be ACKed by this transfer."""
        ...


class Pieces:
    """A source that is sent once, in order. No request ends within a piece, unless the piece is longer than a
    request. progress: called with the bytes of each ACK.
    """

    def __init__(self, pieces: Sequence[bytes], progress: Callable[[int], None] | None = None) -> None:
        self._left = deque(pieces)
        self._offset = 0
        self._progress = progress

    def next_chunk(self, limit: int) -> tuple[int, bytes] | None:
        """See ChunkSource."""
        chunk = b""
        while self._left and len(chunk) + len(self._left[0]) <= limit:
            chunk += self._left.popleft()
        if not chunk and self._left:
            chunk, rest = self._left[0][:limit], self._left[0][limit:]
            self._left[0] = rest
        if not chunk:
            return None
        offset = self._offset
        self._offset += len(chunk)
        return offset, chunk

    def on_acked(self, offset: int, count: int) -> None:
        """See ChunkSource."""
        if self._progress is not None:
            self._progress(count)

    def on_unsent(self, offset: int, count: int) -> None:
        """See ChunkSource: nothing is sent twice."""


class WriteTransfer(Operation):
    """Writes what a source has for as long as its owner likes.

    Args:
        session: id of the file open for writing. chunks: the size of requests.
        root: a directory to list when other requests with a path may disturb the next write (see
            `pathgate`); None: a write that is refused for that fails.
        in_flight: the most requests unanswered at once, None as the engine's window allows; 1 = strict order.
        on_starved: called when the source has nothing more. After a full window that shows only when all of
            it was answered.

    Attributes:
        acked_bytes: written so far.
        paused: send nothing new; what is on its way is still waited for.

    Fails with SessionLost (from the FtpNak that showed it), FtpNak, RequestTimeout, or as the source. What
    was not ACKed was then given back by on_unsent, ascending.
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
        on_starved: Callable[[], None] = lambda: None,
    ) -> None:
        self.chunks = ChunkSize() if chunks is None else chunks
        self.session = session
        self.acked_bytes = 0
        self._source = source
        self._root = root
        self._needs_listing = False  # the root is to be listed before the next write
        self._listing: Request | None = None
        self._listings = 0  # of the root, since something was ACKed
        self._in_flight = in_flight
        self._on_starved = on_starved
        self._rest: deque[tuple[int, bytes]] = deque()
        self._unanswered: dict[Request, None] = {}
        self.paused = False
        self._starved = False
        self._barren = 0
        self._usual: bytes | None = None  # the data of an ACK to a full chunk

    # --- what the owner says and sees

    def wake(self) -> None:
        """The source has more."""
        self._starved = False

    @property
    def starved(self) -> bool:
        """Whether the source had nothing when it was last asked, and everything it gave was ACKed."""
        return self._starved and not self._rest and not self._unanswered

    @property
    def idle(self) -> bool:
        """Whether nothing is wanted of the server; while paused: whether nothing is on its way."""
        return not self._unanswered and (self.paused or (self._starved and not self._rest))

    # --- requests

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return WriteFile requests for bytes in a row."""
        if self._in_flight is not None:
            most = min(most, self._in_flight - len(self._unanswered))
        if self.paused or most <= 0:
            return []
        if self._needs_listing:
            return self._list_root()
        session = self.session
        chunk = self.chunks.next_size(now)
        most = 1 if self.chunks.trying else min(most, _ROW)
        limit = most * chunk
        if self._rest:
            offset, data = self._rest.popleft()
            if len(data) > limit:  # it went out in longer ones before
                self._rest.appendleft((offset + limit, data[limit:]))
                data = data[:limit]
        elif self._starved or self.done or (piece := self._new_piece(limit)) is None:
            return []
        else:
            offset, data = piece
        requests = []
        for at in range(0, len(data), chunk):
            part = data[at : at + chunk]
            request = Request(self, _WRITE, WRITE_MANNER, session, offset + at, len(part), part)
            requests.append(request)
            self._unanswered[request] = None
        return requests

    def _list_root(self) -> list[Request]:
        """Return a listing of the root, once all else is answered. It sets right what paths disturb, and
        clears a sticky errno. One request from beyond any end suffices; whatever it answers, the next write
        tells."""
        if self._unanswered or self._listing is not None or self._root is None:
            return []
        root = self._root
        self._listing = Request(self, _LIST, MANNERS[_LIST], 0, BEYOND, len(root), root, follows=True)
        return [self._listing]

    def on_paths(self) -> None:
        """See Operation."""
        self._needs_listing = self._root is not None

    def _new_piece(self, limit: int) -> tuple[int, bytes] | None:
        """Return at most `limit` bytes of the source; None if it has none, or fails."""
        try:
            piece = self._source.next_chunk(limit)
        except MavftpfsError as error:
            self.fail(error)
            return None
        if piece is None:
            self._starved = True
            self._on_starved()
            return None
        offset, data = piece
        if not 1 <= len(data) <= limit or not 0 <= offset <= MAX_OFFSET - len(data):
            self._rest.append(piece)
            self.fail(LocalProtocolError(f"{len(data)} bytes at {offset} do not fit WriteFile requests"))
            return None
        return piece

    # --- replies

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Tell the source what was written, or end with what a refusal means."""
        if request is self._listing:
            self._listing, self._needs_listing = None, False
            self._listings += 1
            return
        if reply.opcode == _NAK:
            nak = nak_of(request, reply)
            if is_path_refusal(nak) and self._root is not None and self._listings < _MOST_LISTINGS:
                del self._unanswered[request]
                self._rest.append((request.offset, request.data))
                self._needs_listing = self.port.traits.paths_block_writes = True
            else:
                self.fail(self._meaning(nak))
            return
        self.on_run([(request, reply.data)], now, placed=reply.offset == request.offset)

    def on_run(self, run: Run, now: float, *, placed: bool = True) -> None:
        """Tell the source what was written, in a row at once. placed: answers have the requests' offsets."""
        unanswered, usual, full = self._unanswered, self._usual, self.chunks.most
        first = run[0][0]
        start = stop = first.offset
        self.chunks.on_answered(first.size, len(run) if first.sends == 1 else 0, first.sent_at, now)
        if placed and run[-1][0].offset:
            self.port.traits.write_ack_offset = True
        for request, data in run:
            offset, count = request.offset, request.size
            del unanswered[request]
            if data != usual or count != full:
                count = self._written(request, data)
                usual = self._usual
            if offset != stop:
                self._tell(start, stop)
                start = offset
            stop = offset + count
            if count < request.size:
                self._tell(start, stop)
                start = stop
                self._on_short(request, count)
                if self.done:
                    return
        self._tell(start, stop)

    def _tell(self, start: int, stop: int) -> None:
        if start < stop:
            self._barren = self._listings = 0
            self.acked_bytes += stop - start
            self._source.on_acked(start, stop - start)

    def _written(self, request: Request, data: bytes) -> int:
        """Return how many bytes an ACK stands for (servers.md 8: only PX4 says, and may write less)."""
        if len(data) != _COUNT_SIZE:
            return request.size
        count = int.from_bytes(data, "little")
        if count == self.chunks.most == request.size:
            self._usual = data
        # More than was sent: an answer to something else. Nothing is proven, so it goes again.
        return count if count <= request.size else 0

    def _on_short(self, request: Request, count: int) -> None:
        self._rest.append((request.offset + count, request.data[count:]))
        if count == 0:
            self._barren += 1
        if self._barren > _BARREN_TOLERATED:
            self.fail(RemoteProtocolError(f"the vehicle ACKs writes at {request.offset} and writes nothing"))

    def _meaning(self, nak: FtpNak) -> MavftpfsError:
        if nak.code in _SESSION_CODES or nak.server_errno in _NO_FILE_ERRNOS:
            lost = SessionLost(str(nak), by_server=True)
            lost.__cause__ = nak
            return lost
        return nak

    def takes_back(self, request: Request, now: float) -> bool:
        """See Operation: the bytes of a chunk that was too long go out in shorter ones. None goes out again
        before the root was listed, where it is to be."""
        if request is self._listing:
            return False
        too_long = self.chunks.on_lost(request.size, request.sent_at, now)
        if not too_long and not self._needs_listing:
            return False
        del self._unanswered[request]
        offset, data = request.offset, request.data
        if self._rest and self._rest[-1][0] + len(self._rest[-1][1]) == offset:
            offset, before = self._rest.pop()
            data = before + data
        self._rest.append((offset, data))
        return True

    def finish(self) -> None:
        """End; what was not ACKed goes back to the source. A request that arrives late does no more than a
        repetition."""
        if self.done:
            return
        pieces = ExtentSet()
        for request in self._unanswered:
            pieces.add(request.offset, request.offset + request.size)
        for offset, data in self._rest:
            pieces.add(offset, offset + len(data))
        self._unanswered.clear()
        self._rest.clear()
        for start, stop in pieces:
            self._source.on_unsent(start, stop - start)
        super().finish()


def is_path_refusal(error: MavftpfsError | None) -> bool:
    """Return whether this is how PX4 refuses to write after it was asked for a path beyond its whitelist."""
    return isinstance(error, FtpNak) and error.opcode == Opcode.WRITE_FILE and error.code in _PATH_CODES
