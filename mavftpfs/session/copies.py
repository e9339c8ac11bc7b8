"""Which file a WriteFile was meant for whose answer comes when nobody waits for it. Layer: session.

A WriteFile names a session and an offset, and no file (servers.md 1 and 8): one that the network brings late,
or once more, is written to what is open by then. Its answer tells: seqs are counted on, so its seq shows in
which of our sessions it was sent, and most servers echo the offset. What stays invisible is a
copy whose answer is lost, too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from mavftpfs.cache.remote import Overwrite
from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.protocol.stats import EngineStats
from mavftpfs.shared.traits import Traits

_REMEMBERED = 64
"""Sessions."""

_SEQS = 65535
_LEEWAY = 256
"""More requests than go out while an open is answered."""

_AGES = _SEQS - 4096
"""Requests after which a seq is no older one's any more."""

_FEARED = 10.0
"""Seconds for which bytes that a copy of what was tried out may overwrite are fetched before, and those that
one of an earlier change may are compared."""


@dataclass(slots=True)
class Span:
    """The bytes [start, stop) that a file was sent."""

    start: int = 1 << 32
    stop: int = 0

    def add(self, start: int, stop: int) -> None:
        """Extend it."""
        if start < self.start:
            self.start = start
        if stop > self.stop:
            self.stop = stop

    def overlaps(self, start: int, stop: int) -> bool:
        """Whether some of [start, stop) is in it."""
        return self.start < stop and start < self.stop


@dataclass(slots=True, eq=False)
class Written:
    """A session in which a file was written. path: empty once the file is gone. hits: what late requests of
    other files may have written to this one, None if nobody cares. seq: of the ACK that opened it, requests:
    how many had gone out by then. made: by CreateFile."""

    path: bytes
    span: Span
    hits: list[Overwrite] | None
    seq: int
    requests: int
    made: bool
    at: float = field(default=0.0)


class WriteLog:
    """The sessions in which files were written, oldest first. chunk: most bytes of a WriteFile."""

    def __init__(
        self, stats: EngineStats, traits: Callable[[], Traits], clock: Callable[[], float], chunk: int
    ) -> None:
        self._traits = traits
        self.sessions: deque[Written] = deque(maxlen=_REMEMBERED)
        self._stats = stats
        self._clock = clock
        self._chunk = chunk

    def begin(self, path: bytes, seq: int, span: Span, hits: list[Overwrite] | None, *, made: bool) -> None:
        """A file was opened to be written; made: by CreateFile. An upload gives the same hits each time."""
        if made:
            self.gone(path)
        self.sessions.append(Written(path, span, hits, seq, self._stats.requests, made))
        self.end()

    def end(self) -> None:
        """The newest session was written to until now."""
        if self.sessions:
            self.sessions[-1].at = self._clock()

    def gone(self, path: bytes) -> None:
        """What has this name from now on is another file."""
        for session in self.sessions:
            if session.path == path:
                session.path = b""

    def forget(self) -> None:
        """The server restarted."""
        self.sessions.clear()

    def feared(self, path: bytes) -> list[tuple[int, int]]:
        """Return where late copies of what was tried out may be written to a file that is opened now."""
        if not self._stats.strays:
            return []
        since = self._clock() - _FEARED
        tried = [s for s in self.sessions if s.hits is None and s.path != path and s.at >= since]
        return [(session.span.start, session.span.stop) for session in tried]

    def lately(self, path: bytes, hits: list[Overwrite]) -> list[tuple[int, int]]:
        """Return where others than who gives these hits wrote to a file so lately that copies are feared."""
        since = self._clock() - _FEARED
        others = [s for s in self.sessions if s.path == path and s.hits is not hits and s.at >= since]
        return [(session.span.start, session.span.stop) for session in others]

    def on_late(self, reply: Payload) -> None:
        """A WriteFile or a CreateFile was ACKed that nobody waits for: note what it may have changed."""
        if reply.req_opcode == Opcode.CREATE_FILE:
            self._on_emptied(reply.seq)
            return
        if not self.sessions or (hits := self.sessions[-1].hits) is None:
            return
        origin = self._origin(reply.seq)
        if origin is not None and origin.hits is hits:
            return
        start, stop = (0, 1 << 32) if origin is None else (origin.span.start, origin.span.stop)
        if reply.offset or self._traits().write_ack_offset:  # else it says nothing (MAVSDK)
            start, stop = reply.offset, min(reply.offset + self._chunk, max(stop, reply.offset + 1))
        same = origin is not None and self._is_still_there(origin, start, stop)
        hits.append(Overwrite(start, stop, same=same))

    def _on_emptied(self, seq: int) -> None:
        """The file that was made with this answer may have been emptied since, whatever its name is now."""
        for session in self.sessions:
            if session.made and session.seq == seq and session.hits is not None:
                session.hits.append(Overwrite(0, 1 << 32, same=False))

    def _origin(self, seq: int) -> Written | None:
        """Return the session in which a request was sent, the newest that may be; None: a forgotten one."""
        for session in reversed(self.sessions):
            since = self._stats.requests - session.requests
            if since > _AGES or (seq - session.seq) % _SEQS <= since + _LEEWAY:
                return session
        return None

    def _is_still_there(self, origin: Written, start: int, stop: int) -> bool:
        """Whether the newest file has these bytes anyway, but for those that are sent to it now."""
        newest = self.sessions[-1]
        if origin.path != newest.path:
            return False
        later = list(self.sessions)[self.sessions.index(origin) + 1 :]
        between = [s for s in later if s.path == newest.path and s.hits is not newest.hits]
        return not any(session.span.overlaps(start, stop) for session in between)
