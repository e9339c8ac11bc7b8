"""One upload as its owner sees it, and what is known of its progress. Layer: session."""

from __future__ import annotations

from typing import Protocol

import trio

from mavftpfs.cache.remote import UploadSource
from mavftpfs.session.fairness import Share
from mavftpfs.shared.errors import LocalProtocolError, MavftpfsError

LONGEST_BACKOFF = 30.0
"""Most seconds between two attempts after a failure of the link."""


class Feed:
    """Hands a source's chunks to the engine and remembers what is proven of them.

    A source can fail: the local disk has its bytes. The engine, which serves everybody, is then told that
    there is nothing for now. Whoever waits for the upload hears why: `has_more` is asked before its end.

    chunk: most bytes of one.

    Attributes:
        proven: a Terminate was ACKed: the remote file holds all that was ACKed before it.
        unproven: bytes ACKed since then.
        reached: end of the highest ACKed byte; after a lost session, of the highest proven one.
    """

    def __init__(self, source: UploadSource, chunk: int) -> None:
        self.proven = False
        self.unproven = 0
        self.reached = 0
        self._proven_to = 0
        self._source = source
        self._chunk = chunk
        self._held: tuple[int, bytes] | None = None
        self._furthest = 0
        self._furthest_before = 0

    def has_more(self) -> bool:
        """Whether the source has something to send now.

        Raises:
            MavftpfsError: it fails.
        """
        if self._held is None:
            self._held = self._source.next_chunk(self._chunk)
        return self._held is not None

    def next_chunk(self, limit: int) -> tuple[int, bytes] | None:
        """See protocol.writing.ChunkSource."""
        if self._held is not None and len(self._held[1]) > limit:
            self.put_back()
        found, self._held = self._held, None
        if found is None:
            try:
                found = self._source.next_chunk(limit)
            except MavftpfsError:
                return None
        return found

    def on_acked(self, offset: int, count: int) -> None:
        """See protocol.writing.ChunkSource."""
        stop = offset + count
        self.unproven += count
        if stop > self.reached:
            self.reached = stop
            if stop > self._furthest:
                self._furthest = stop
        self._source.on_acked(offset, count)

    def on_unsent(self, offset: int, count: int) -> None:
        """See protocol.writing.ChunkSource."""
        self._source.on_unsent(offset, count)

    def put_back(self) -> None:
        """Give back what was only looked at."""
        held, self._held = self._held, None
        if held is not None:
            self._source.on_unsent(held[0], len(held[1]))

    def check_point(self) -> None:
        """Terminate was ACKed."""
        self.proven = True
        self.unproven = 0
        self._proven_to = self.reached
        self._source.on_checkpoint()

    def roll_back(self, *, everything: bool) -> None:
        """What was ACKed since the last checkpoint, or everything, has to be sent again."""
        self.put_back()
        if everything:
            self.proven = False
            self._proven_to = 0
        self.reached = self._proven_to
        self.unproven = 0
        self._source.on_rollback(everything)

    def got_further(self) -> bool:
        """Whether more of the file was reached than when this was asked before."""
        before, self._furthest_before = self._furthest_before, self._furthest
        return self._furthest > before


class UploadHost(Protocol):
    """What an upload may ask of the session."""

    def check_may_write(self) -> None:
        """Raise Armed or VehicleLost."""
        ...

    def now(self) -> float:
        """Return the time."""
        ...

    def on_news(self, upload: QueuedUpload) -> None:
        """Something about the upload changed."""
        ...

    def forget(self, upload: QueuedUpload) -> None:
        """The upload is over."""
        ...


class QueuedUpload:
    """Implements cache.remote.Upload; the scheduler's task does the work.

    Attributes:
        error: why the last attempt failed; None while it goes well. After a failure of the link it is tried
            again in the background, after a refusal only when `finish` is called.
        running: it has the session. clean: everything given so far is ACKed, and Terminate, too.
        retry_at: not to be touched before. begun, resent: see cache.remote.Upload.
        tried: it was reopened to see what OpenFileWO does. waits_for_finish: what comes now costs the whole
            file again, so it waits until somebody waits for the end.
        restarted: the vehicle did; what was proven does not count. refused_behind: what was sent right before
            the Terminate was refused the last time.
    """

    def __init__(self, host: UploadHost, path: bytes, feed: Feed, now: float) -> None:
        self.path = path
        self.feed = feed
        self.begun = self.resent = False
        self.share = Share(now)
        self.error: MavftpfsError | None = None
        self.running = False
        self.clean = False
        self.aborted = False
        self.refused = False
        self.failures = 0
        self.tried = self.restarted = self.refused_behind = self.waits_for_finish = False
        self.refused_at: int | None = None
        self.retry_at = 0.0
        self._woken = True
        self._calls = 0
        self._marked = 0
        self._completed = 0
        self._pending: set[int] = set()
        self._host = host
        self._news = trio.Event()

    # --- the owner's side

    def wake(self) -> None:
        """The source has more."""
        self._note_waiting()
        self._woken = True
        self.clean = False
        self._host.on_news(self)

    async def finish(self) -> None:
        """See cache.remote.Upload."""
        if self.aborted:
            raise LocalProtocolError("the upload was aborted")
        if not self.clean or self.feed.has_more():
            await self._finish()

    async def _finish(self) -> None:
        self._host.check_may_write()
        self._note_waiting()
        self._begin_again()
        if not self.finishing:
            self.share.asked_at = self._host.now()
        self._calls += 1
        call = self._calls
        self._pending.add(call)
        self._host.on_news(self)
        try:
            while call > self._completed:
                if self.error is not None:
                    raise self.error
                await self._news.wait()
        finally:
            self._pending.discard(call)

    async def abort(self) -> None:
        """See cache.remote.Upload."""
        self.aborted = True
        self._host.on_news(self)
        try:
            while self.running:
                await self._news.wait()
        finally:
            self._host.forget(self)
        self.feed.put_back()

    def _begin_again(self) -> None:
        self.clean = False
        if self.error is not None:
            self.error = None
            self.refused = False
            self.failures = 0
            self.refused_at = None
        self.retry_at = 0.0

    def rest_until(self, at: float) -> None:
        """It is not to be touched before."""
        self.retry_at = self.share.asked_at = at

    def status(self) -> dict[str, object]:
        """Return facts for people and scripts; JSON-able."""
        return {
            "path": self.path.decode("utf-8", "replace"),
            "running": self.running,
            "reached": self.feed.reached,
            "unproven": self.feed.unproven,
            "clean": self.clean,
            "error": None if self.error is None else str(self.error),
        }

    # --- the session's side

    @property
    def finishing(self) -> bool:
        """Whether somebody waits for the end."""
        return any(call > self._completed for call in self._pending)

    def _note_waiting(self) -> None:
        """There is something to do; if there was before, it has waited since then."""
        now = self._host.now()
        if not self.is_due(now):
            self.share.asked_at = now

    def is_due(self, now: float) -> bool:
        """Whether there is something to do for it now."""
        return self.wanted and now >= self.retry_at

    @property
    def wanted(self) -> bool:
        """Whether there is something to do for it, now or later."""
        if self.aborted or self.refused:
            return False
        return self.finishing or (self._woken and not self.waits_for_finish)

    def mark(self) -> None:
        """The source has nothing more just now: what `complete` says is true for who called until now."""
        self._marked = self._calls

    def complete(self, *, more: bool) -> None:
        """Everything given until `mark` is ACKed and terminated; `more`: but there is more by now."""
        self._completed = self._marked
        self._woken = more
        self.clean = not more and self.feed.proven
        self.error = None
        self.failures = 0
        self.tell()

    def fail(self, error: MavftpfsError, now: float, *, refused: bool = False) -> None:
        """Tell whoever waits; refused: asking again by ourselves is of no use."""
        self.error = error
        self.refused = refused
        self.failures += 1
        self.rest_until(now + min(LONGEST_BACKOFF, 2.0 ** min(self.failures, 5)))
        self.tell()

    def tell(self) -> None:
        """Let whoever waits look."""
        self._news.set()
        self._news = trio.Event()
