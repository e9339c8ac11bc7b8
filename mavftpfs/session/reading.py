"""Serves a reader with the server session until it has what it wants, or should make room. Layer: session."""

from __future__ import annotations

import trio

from mavftpfs.protocol.burst import BurstTransfer
from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.reading import ReadTransfer
from mavftpfs.session.kit import Kit, Queue
from mavftpfs.session.policy import ReadMode, should_switch
from mavftpfs.session.stream import FileStream
from mavftpfs.shared.errors import FileChanged, MavftpfsError, RemoteProtocolError, SessionLost

STALL = 2.0
"""Seconds without any reply during a read after which the server's session is no longer believed in."""

FIRST_WANT = 0.05
"""Seconds an opened file is kept open for its first read although another file waits."""

BOOT_NEWS = 2.5
"""Seconds to wait after a reopen for the boot time of a vehicle that was away; less than the 3 s after which
ArduPilot gives an idle session away."""

REOPENS = 5
"""How often one want may lose its session without a byte of progress before it fails."""

_OFTEN = 0.25
_BOOT_POLL = 0.05


class Reading:
    """Runs read transfers. mode: by which requests. chunks: their size."""

    def __init__(self, kit: Kit, queue: Queue, mode: ReadMode, chunks: ChunkSize) -> None:
        self.active: FileStream | None = None
        self._holder = kit.holder
        self._driver = kit.driver
        self._engine = kit.engine
        self._gate = kit.gate
        self._clock = kit.clock
        self._vehicle = kit.vehicle
        self._doubt = kit.doubt
        self._queue = queue
        self._mode: ReadMode = mode
        self._chunks = chunks
        self._transfer: ReadTransfer | None = None
        self._seen_bytes = 0
        self._boot_unheard: float | None = None

    def on_batch(self, now: float) -> None:
        """A batch of replies was processed: pass data on, once."""
        transfer, stream = self._transfer, self.active
        if transfer is None or stream is None:
            return
        if transfer.received_bytes != self._seen_bytes:
            self._seen_bytes = transfer.received_bytes
            stream.last_data_at = now
            stream.clean_failures = 0
            stream.on_batch()
        if transfer.idle or transfer.done:
            self._holder.wake()

    def cut_off(self) -> None:
        """Whatever is under way gets no more answers, or none to be believed."""
        if self._transfer is not None:
            self._driver.cancel(self._transfer)

    async def serve(self, stream: FileStream) -> bool:
        """Read for a stream. Its errors are told to the stream. False: only another file was closed for it,
        and who came meanwhile may be next."""
        try:
            self._queue.require_link()
            if await self._holder.made_room(stream.path):
                return False
            if await self._ensure_open(stream):
                await self._await_first_want(stream)
            if stream.has_demand or stream.has_ahead:
                async with self._gate.passing():
                    await self._read(stream)
        except SessionLost as error:
            self._on_session_lost(stream, error)
        except MavftpfsError as error:
            stream.fail(error)
        return True

    async def _ensure_open(self, stream: FileStream) -> bool:
        """Have the stream's file open; return whether its opener was waiting for that."""
        session = self._holder.session
        awaited = stream.wants_open
        if session is None or session.path != stream.path or session.writing or awaited:
            session = await self._holder.open(stream.path)
            if not awaited:
                await self._await_boot_news()
        try:
            if session.size is None:
                raise RemoteProtocolError("the vehicle's open reply holds no size")
            stream.on_opened(session.size)
            stream.on_session(session.opened_at)
        except (FileChanged, RemoteProtocolError):
            await self._holder.close_quietly()
            raise
        return awaited

    async def _await_boot_news(self) -> None:
        """Let the caches hear of a restart before they get bytes of what may be another file by now.

        A vehicle that stopped telling its boot time is waited for once.
        """
        vehicle = self._vehicle
        heard_at = vehicle.boot_heard_at
        if heard_at == self._boot_unheard:
            return
        with trio.move_on_after(BOOT_NEWS):
            while vehicle.restart_possible(self._clock()):
                await self._holder.sleep(_BOOT_POLL)
        self._boot_unheard = heard_at if vehicle.boot_heard_at == heard_at else None

    async def _await_first_want(self, stream: FileStream) -> None:
        """Give whoever opened a file a moment to ask for its bytes, before another file takes its turn."""
        with trio.move_on_after(FIRST_WANT):
            while not (stream.has_demand or stream.has_ahead or stream.closed):
                await self._holder.sleep(FIRST_WANT)

    async def _read(self, stream: FileStream) -> None:
        session = self._holder.session
        if session is None:  # the vehicle restarted since it was opened
            return
        kind = BurstTransfer if self._mode == "burst" else ReadTransfer
        transfer = kind(session.id, stream.size, stream, self._chunks)
        started = self._clock()
        self.active, self._transfer, self._seen_bytes = stream, transfer, 0
        stream.attach(transfer)
        self._give_way(transfer)
        self._driver.start(transfer, self._holder.wake)
        try:
            while self._go_on(stream, transfer, started):
                others = self._queue.rival_use(stream) is not None
                self._give_way(transfer)
                # What woke us may be a new want, and with nothing in flight no answer would send for it.
                self._driver.kick()
                await self._holder.sleep(_OFTEN if others else STALL / 2)
                if self._stalled(transfer):
                    raise SessionLost("no answer for a while during a read", by_server=False)
        finally:
            self.active = self._transfer = None
            if transfer.idle:
                stream.on_idle()
            stream.detach()
            self._driver.cancel(transfer)
            stream.on_served(started, self._clock())
        if transfer.error is not None:
            raise transfer.error

    def _give_way(self, transfer: ReadTransfer) -> None:
        """Let no burst follow another while somebody else waits for an answer: PX4 fills with a burst what
        the link holds, and the answer finds no room there."""
        if isinstance(transfer, BurstTransfer):
            transfer.by_requests = self._engine.in_flight > transfer.in_flight

    def _go_on(self, stream: FileStream, transfer: ReadTransfer, started: float) -> bool:
        if transfer.done or transfer.idle or stream.closed or self._holder.session is None:
            return False
        if self._holder.claimed(stream.path):
            return False
        waiting_use = self._queue.rival_use(stream)
        if waiting_use is None:
            return True
        now = self._clock()
        return not should_switch(
            current_has_demand=stream.has_demand,
            current_slice=now - started,
            current_use=stream.used(now),
            waiting_use=waiting_use,
            rtt=self._engine.rtt,
            current_waited=started - stream.asked_at,
        )

    def _stalled(self, transfer: ReadTransfer) -> bool:
        limit = max(STALL, 4.0 * (self._engine.rtt or 0.0))
        quiet_since = max(self._driver.last_reply_at, transfer.started_at)
        return not transfer.idle and self._clock() - quiet_since > limit

    def _on_session_lost(self, stream: FileStream, error: SessionLost) -> None:
        """Reopen and go on at the same offset (promise 5); what the lost session read is provisional."""
        self._holder.abandon()
        if error.by_server:
            self._doubt.raise_it(str(error))
            stream.on_suspect(str(error))
        stream.clean_failures += 1
        if stream.clean_failures > REOPENS:
            stream.fail(error)
