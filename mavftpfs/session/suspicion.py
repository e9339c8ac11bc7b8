"""Which bytes come under suspicion when the session turns out to have been somebody else's. Layer: session.

Another client is noticed late, and so is a request that came twice: what was read shortly before is
provisional, too, also of files that were closed since.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from mavftpfs.session.stream import FileStream

SUSPECT_WITHIN = 10.0
"""Seconds before another FTP client is heard in which it may have been at work already: servers answer it
on its own link, and a router may pass on only some of that."""


class Suspicion:
    """Remembers closed streams for as long as their bytes may yet come under suspicion."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._closed: deque[FileStream] = deque()

    def on_closed(self, stream: FileStream) -> None:
        """A stream was closed."""
        self._forget_closed()
        if self._is_recent(stream):
            self._closed.append(stream)

    def tell(self, streams: Iterable[FileStream], active: FileStream | None, reason: str) -> None:
        """Suspect what was read lately; streams: those that are open. active: the one being read."""
        self._forget_closed()
        for stream in [*streams, *self._closed]:
            if stream is active or self._is_recent(stream):
                stream.on_suspect(reason)

    def _is_recent(self, stream: FileStream) -> bool:
        return stream.last_data_at is not None and stream.last_data_at > self._clock() - SUSPECT_WITHIN

    def _forget_closed(self) -> None:
        """Forget the oldest of the closed streams, whose bytes are beyond suspicion."""
        while self._closed and not self._is_recent(self._closed[0]):
            self._closed.popleft()
