"""One upload: its callers, what it does next, and how it uses its turns. Layer: session.

A file is made by CreateFile. Where OpenFileWO was seen to keep a file's content an upload can be interrupted
at any time: Terminate right behind the window, and later OpenFileWO and what of that was not ACKed. Where it
was seen to empty files that would begin the file anew, so the upload keeps the session until its source has
nothing more. Where neither was seen yet, the upload is interrupted when another user waits, and reopening its
file tells. What was ACKed before an ACKed Terminate is written.

PX4 on NuttX checks each WriteFile against a scratch buffer that every path operation overwrites
(docs/servers.md 8). Once that was seen, path operations and writes take turns (`PathGate`).
"""

from __future__ import annotations

import errno
from contextlib import suppress
from enum import Enum
from math import inf

import trio

from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.protocol.writing import WriteTransfer
from mavftpfs.session.scheduler import LIGHT_USE, Future, Scheduler, SessionUser, Turn
from mavftpfs.session.serversession import REOPENS, TERMINATE_LIMIT, OpenSession
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    Armed,
    FtpNak,
    LocalProtocolError,
    MavftpfsError,
    ProtocolError,
    RequestTimeout,
    SessionLost,
)
from mavftpfs.shared.model import split, wire_path
from mavftpfs.shared.sending import SendBuffer

LONGEST_BACKOFF = 30.0
"""Most seconds between two attempts after a failure of the link."""

STARVE = 1.5
"""Seconds an upload keeps the session with nothing to send: below the 2 s after which PX4 frees buffers."""

BRIEF_STARVE = 0.05
"""The same where it can be interrupted and another user waits."""

PATIENCE = 10.0
"""Seconds after which an upload that cannot be interrupted gives the session to a user that waits when it
has nothing to send: else a log that trickles would keep it for ever."""

CHECKPOINT_EVERY = 60.0
"""Seconds after which an upload is terminated and resumed: what a lost session can cost."""

REFUSALS = (FtpNak, ProtocolError)
"""Errors that do not pass by themselves."""

_PATHS_TURN = 0.5
_OFTEN = 0.25
_BLOCKED = frozenset((NakCode.FILE_PROTECTED, NakCode.FILE_EXISTS))


class Stop(Enum):
    """Why an upload lets go of the session."""

    STARVED = "starved"
    YIELD = "yield"
    DOUBT = "doubt"
    ARMED = "armed"
    ABORTED = "aborted"


_LOOK_AGAIN = 1.0
_ABRUPT = frozenset((Stop.DOUBT, Stop.ARMED, Stop.ABORTED))


class Upload(SessionUser):
    """Implements cache.remote.Upload. Nothing is sent before the source has something.

    Attributes:
        begun, resent: see cache.remote.Upload.
    """

    def __init__(self, path: bytes, source: SendBuffer, scheduler: Scheduler) -> None:
        super().__init__(path, writing=True)
        self._source = source
        self.begun = self.resent = False
        self._scheduler = scheduler
        self._server = scheduler.server
        self._vehicle = scheduler.server.vehicle
        self._driver = scheduler.server.driver
        self._engine = scheduler.server.engine
        self._clock = scheduler.clock
        self._finishers: list[Future] = []  # of those that wait for the end
        self._parked = False  # nothing is sent before the next `finish`: refused, or all would go again
        self._ended = False  # given up by its owner
        self._over = trio.Event()  # and its task has seen that
        self._retry_at = 0.0  # not to be touched before
        self._changed = trio.lowlevel.ParkingLot()
        self._transfer: WriteTransfer | None = None  # what sends its bytes now
        self._reboots = scheduler.server.vehicle.reboots  # when its file was opened last
        self._refused_at: int | None = None  # where a write was refused last as if the session were lost
        self._failures = 0  # of the link, and losses of the session without progress
        self._furthest = 0  # in the file, when the session was lost the last time

    # --- the owner's side

    def wake(self) -> None:
        """The source has more."""
        self._changed.unpark_all()
        if self._transfer is not None:
            self._transfer.wake()
        self._server.wake()

    async def finish(self) -> None:
        """See cache.remote.Upload."""
        if self._ended:
            raise LocalProtocolError("the upload was ended")
        self._vehicle.require(self._clock(), writing=True)
        self._parked, self._refused_at, self._failures, self._retry_at = False, None, 0, 0.0
        first, finisher = not self.awaited, Future()
        self._finishers.append(finisher)
        if first:
            self._scheduler.renew(self)
        self.wake()
        try:
            await finisher.wait()
        finally:
            self._finishers.remove(finisher)

    async def end(self) -> None:
        """See cache.remote.Upload."""
        self._ended = True
        self._fail(LocalProtocolError("the upload was ended"))
        self._scheduler.remove(self)
        self._changed.unpark_all()
        await self._over.wait()

    def status(self) -> dict[str, object]:
        """Return facts for people and scripts; JSON-able."""
        return {
            "path": self.path.decode("utf-8", "replace"),
            "running": self._transfer is not None,
            "reached": self._source.reached,
            "unproven": self._source.acked.total,
        }

    @property
    def awaited(self) -> bool:
        """Whether a caller waits in `finish`."""
        return not all(finisher.done for finisher in self._finishers)

    def on_armed_changed(self) -> None:
        """If it waits for a turn, its callers get Armed at once; in a turn it sees that itself. After
        disarming it goes on."""
        if self._vehicle.may_write:
            self._retry_at = 0.0
        else:
            self._scheduler.refuse(self, Armed("the vehicle was armed"))
        self._changed.unpark_all()

    # --- its task

    async def run(self) -> None:
        """Take a turn whenever there is something to send, until `end`. After a failure it is tried again in
        the background."""
        try:
            while not self._ended:
                try:
                    if self.awaited:
                        self._vehicle.require(self._clock(), writing=True)
                    if (pause := self._due_in()) > 0.0:
                        with trio.move_on_after(pause):
                            await self._changed.park()
                    elif not self._has_work():
                        self._complete(list(self._finishers))
                    else:
                        self.asked_at = self.asked_at or self._clock()
                        async with self._scheduler.turn(self) as turn:
                            await self._use(turn)
                except MavftpfsError as error:
                    self._fail(error)
        finally:
            self._over.set()

    def _due_in(self) -> float:
        """Return in how many seconds it wants a turn, unless it is woken before. A vehicle that is lost is
        tried only while a caller waits."""
        now = self._clock()
        wanted = self.awaited or (not self._parked and self._has_work())
        if not wanted or not self._vehicle.may_write:
            return inf
        silent = not self.awaited and self._vehicle.lost(now)
        return max(self._retry_at - now, _LOOK_AGAIN if silent else 0.0)

    def _has_work(self) -> bool:
        """Whether there is something to send or to close. An empty file has to be made, too, once."""
        source = self._source
        return source.has_more() or not source.acked.empty or (self.awaited and not source.closed)

    def _fail(self, error: MavftpfsError) -> None:
        """Raise an error in all `finish`, and try again later; after a refusal only at the next `finish`."""
        for finisher in self._finishers:
            finisher.end(error)
        self._failures += 1
        self._parked = isinstance(error, REFUSALS)
        self._retry_at = self._clock() + min(LONGEST_BACKOFF, 2.0 ** min(self._failures, 5))

    async def _use(self, turn: Turn) -> None:
        """Have a turn."""
        began = self._clock()
        try:
            try:
                stop = await self._write(turn, await self._open(turn))
                # All that was given by now is in the file that is closed next; what comes later is not.
                finishers = list(self._finishers)
                await self._close(stop)
            finally:
                self._end_transfer()
            if stop is Stop.STARVED:
                self._complete(finishers)
        except SessionLost as lost:  # begin again from what is proven, a bounded number of times
            self._on_lost(lost)
        except MavftpfsError as error:
            await self._clean_up(error)
            raise
        finally:
            self.on_turn(began, self._clock())
            self.asked_at = None

    def _on_lost(self, lost: SessionLost) -> None:
        """Begin again from what is proven.

        Raises:
            MavftpfsError: it was lost again and again, without getting further.
        """
        self._server.lose(lost)
        if self._source.reached > self._furthest:
            self._furthest, self._failures = self._source.reached, 0
        self._roll_back()
        self._failures += 1
        if self._failures > REOPENS:
            raise lost.__cause__ if isinstance(lost.__cause__, MavftpfsError) else lost
        self._retry_at = self._clock() + (self._failures - 1) * 0.5

    def _resumable(self) -> bool:
        """Whether its file can be closed and written on later: it was seen to be so, or this is to tell."""
        truncates = self._engine.traits.wo_truncates
        return truncates is False or (truncates is None and self._source.reached > 0)

    def _complete(self, finishers: list[Future]) -> None:
        """Let these callers go: everything that the source had when they began to wait is ACKed, and the file
        was closed. Where it cannot be written on, more bytes cost the whole file once more, so they wait for
        the next `finish`.

        Raises:
            MavftpfsError: the source fails.
        """
        self._source.has_more()  # raises what the source failed with
        for finisher in finishers:
            finisher.end()
        self._failures = 0
        self._parked = self._source.closed and not self._resumable()

    # --- opening

    async def _open(self, turn: Turn) -> OpenSession:
        """Open the upload's file: to go on with it where that is possible, else to begin it."""
        source = self._source
        if self._reboots != self._vehicle.reboots:  # what was proven may not be there any more
            source.roll_back(everything=True)
        self._reboots = self._vehicle.reboots
        unknown = self._engine.traits.wo_truncates is None and source.reached
        if source.closed and (unknown or self._engine.traits.wo_truncates is False):
            session = await self._reopen(turn)
            if session is not None:
                return session
        source.roll_back(everything=True)
        if self._ended:  # its owner was told that nothing was begun
            raise LocalProtocolError("the upload was given up before its file was made")
        self.resent |= self.begun
        self.begun = True  # what is there from now on may be ours
        try:
            session = await turn.open(self.path, Opcode.CREATE_FILE)
        except FtpNak as nak:
            self.resent |= nak.retransmitted
            raise
        self.resent |= session.resent
        return session

    async def _reopen(self, turn: Turn) -> OpenSession | None:
        """Open an interrupted file to go on with it; None if it does not have what was proven.

        The first time in a mount that finds out what OpenFileWO does (docs/servers.md 8): the size tells,
        asked afterwards, since the reply to OpenFileWO may say what it was before. What is not seen to keep
        the file passes for emptying it.
        """
        traits, reached = self._engine.traits, self._source.reached
        try:
            session = await turn.open(self.path, Opcode.OPEN_FILE_WO)
            if traits.wo_truncates is None:
                size = (await turn.open(self.path)).size
                traits.wo_truncates = size is None or size < reached
                if traits.wo_truncates:
                    return None
                session = await turn.open(self.path, Opcode.OPEN_FILE_WO)
        except FtpNak as nak:
            if errno_for(nak) == errno.ENOENT:  # another client, or the vehicle, removed the file
                return None
            if traits.wo_truncates is not None:
                raise
            traits.wo_truncates = True
            return None
        if session.size is None or session.size >= reached:
            return session
        await self._server.close()
        return None

    # --- writing

    async def _write(self, turn: Turn, session: OpenSession) -> Stop:
        """Write until there is a reason to stop. The session is open then, and what is in flight waits for
        nothing but its answers: `_end_transfer` follows when the session is closed.

        Raises:
            SessionLost, FtpNak, RequestTimeout, RemoteProtocolError: what the transfer failed with.
        """
        server, traits, gate = self._server, self._engine.traits, self._server.path_gate
        unblocked = False
        gate.shut = traits.paths_block_writes
        try:
            while True:
                # If a light user waits already, a short queue is half filled: the Terminate finds a place in
                # it, and is not behind as many writes.
                rival = turn.rival
                queue = traits.queue_limit
                most = queue // 2 if queue and rival is not None and rival < LIGHT_USE else None
                chunks = self._scheduler.write_chunks
                transfer = WriteTransfer(
                    session.id, self._source, chunks, in_flight=most, on_starved=server.wake
                )
                self._transfer = server.transfer = transfer
                try:
                    await self._driver.start(transfer, server.wake, self._on_batch)
                    stop = await self._watch(turn, session, transfer)
                finally:
                    if not transfer.trailing:  # else its last answers come while `_close` waits for its own
                        self._end_transfer()
                if transfer.acked_bytes and unblocked:
                    traits.paths_block_writes, unblocked = True, False
                error = transfer.error
                if error is None:
                    assert stop is not None
                    return stop
                if unblocked or not is_blocked(error):
                    self._check_refusal(transfer, error)
                    raise error
                unblocked = True
                # From now on path operations take turns with this upload: first those under way end.
                await gate.let_in(0.0)
                await self._unblock()
        finally:
            gate.open()

    def _on_batch(self, now: float) -> None:
        """A batch of replies was processed."""
        transfer = self._transfer
        if transfer is not None and (transfer.idle or transfer.done):
            self._server.wake()

    async def _watch(self, turn: Turn, session: OpenSession, transfer: WriteTransfer) -> Stop | None:
        """Return the reason to let go; None if the transfer ended by itself."""
        server, driver, gate, clock = self._server, self._driver, self._server.path_gate, self._server.clock
        stop: Stop | None = None
        fed_at = clock()
        while not transfer.done:
            server.require_open(session)
            if not transfer.starved:
                fed_at = clock()
            rival = turn.rival
            stop = self._reason_to_stop(session, transfer, fed_at, rival) or stop
            if server.is_stalled(transfer):
                # Another client may have taken the session (servers.md 14.9). Where closing would cost the
                # whole file, only if another client was heard; else the server will tell.
                closes = self._engine.traits.wo_truncates is False or self._vehicle.foreign_client(clock())
                stop = Stop.DOUBT if closes else stop
            if stop is not None:
                transfer.paused = True
                if transfer.idle or stop in _ABRUPT or self._let_trail(stop, transfer):
                    return stop
            elif gate.shut and gate.waiting:
                transfer.paused = True
                if transfer.idle:
                    await gate.let_in(max(_PATHS_TURN, 4.0 * (self._engine.rtt or 0.0)))
                    await self._unblock()
                    transfer.paused = False
            else:
                transfer.paused = False
            driver.kick()
            pressed = transfer.starved and rival is not None
            await server.sleep(BRIEF_STARVE if pressed else _OFTEN)
        return None

    def _reason_to_stop(
        self, session: OpenSession, transfer: WriteTransfer, fed_at: float, rival: float | None
    ) -> Stop | None:
        """fed_at: when there was something to send the last time. rival: see Turn.rival."""
        if self._ended:
            return Stop.ABORTED
        if not self._vehicle.may_write:
            return Stop.ARMED
        if self._scheduler.is_excluded(self.path):
            return Stop.YIELD
        now, resumable = self._clock(), self._resumable()
        if transfer.starved:
            if self.awaited:
                return Stop.STARVED
            patience = STARVE
            if rival is not None and resumable:
                patience = BRIEF_STARVE
            elif rival is not None and now - session.opened_at >= PATIENCE:
                patience = 0.0
            return Stop.STARVED if now - fed_at >= patience else None
        if rival is None:
            over = self._engine.traits.wo_truncates is False and now - session.opened_at >= CHECKPOINT_EVERY
        else:
            over = resumable and self.gives_way(rival, session.opened_at, now, self._engine.rtt)
        return Stop.YIELD if over else None

    def _let_trail(self, stop: Stop, transfer: WriteTransfer) -> bool:
        """Have the Terminate go out right behind the last requests if that is right; return whether it does.

        That is a round trip less for the user that waits. Servers carry requests out in order, and what gets
        lost is sent when the file is open again. But where path operations cause refusals (NuttX) the answers
        are waited for, because only the running upload can put that right.
        """
        if stop is not Stop.YIELD or self._engine.traits.wo_truncates is not False:
            return False
        if self._engine.traits.paths_block_writes or self._scheduler.is_excluded(self.path):
            return False
        if transfer.all_out:
            transfer.repeat_nothing()
        return transfer.trailing

    def _end_transfer(self) -> MavftpfsError | None:
        """The session is closed, or lost: what was not ACKed goes back to the source. Return what failed of
        the last requests, which were on their way when it was closed."""
        transfer = self._transfer
        if transfer is None:
            return None
        self._transfer = self._server.transfer = None
        if transfer.trailing and not transfer.idle:
            self._engine.stats.retransmissions += 1  # it goes again, and the first may come later than that
        transfer.finish()
        self._driver.cancel(transfer)
        return transfer.error

    def _check_refusal(self, transfer: WriteTransfer, error: MavftpfsError) -> None:
        """A refusal that means a lost session may mean a full card, too: raise it where it is the second one
        at the same place.

        Raises:
            FtpNak.
        """
        nak = error.__cause__
        if isinstance(nak, FtpNak) and nak.code == NakCode.FAIL and transfer.failed_at is not None:
            if transfer.failed_at == self._refused_at:
                raise nak
            self._refused_at = transfer.failed_at

    async def _unblock(self) -> None:
        """List the storage's root, whose trailing slash fits PX4's whitelist; also clears a sticky errno.

        One request from beyond any end suffices; whatever it answers, the next write tells.
        """
        parts = self.path.split(b"/")
        on_nuttx = len(parts) > 3 and parts[1] == b"fs"  # then it is /fs/NAME, else the parent directory
        root = b"/".join(parts[:3]) if on_nuttx else split(self.path)[0]
        wire = wire_path(root).rstrip(b"/") + b"/"
        with suppress(FtpNak):
            await self._driver.run(Simple(Opcode.LIST_DIRECTORY, wire, offset=100_000))

    # --- letting go

    async def _close(self, stop: Stop) -> None:
        """Close the file, and judge by that what of it is written.

        A vehicle that restarted before may ACK it, too (ArduPilot ACKs the end of any session). That restart
        is news that takes the bytes back (`_open`) and has the file compared (`Doubt`).
        """
        transfer = self._transfer  # if any, its last requests are on their way
        if stop is Stop.ABORTED:
            await self._server.close_quietly()
            return
        try:
            ours = await self._server.close(TERMINATE_LIMIT if stop is Stop.ARMED else None)
        except RequestTimeout as error:
            raise SessionLost(str(error)) from error
        last = self._end_transfer()
        if last is not None and transfer is not None:
            self._engine.traits.paths_block_writes |= is_blocked(last)
            self._check_refusal(transfer, last)
        if not ours or isinstance(last, SessionLost):
            raise SessionLost("the vehicle had closed the session before", by_server=True) from last
        self._source.check_point()
        if isinstance(last, REFUSALS) and not is_blocked(last):
            raise last

    async def _clean_up(self, error: MavftpfsError) -> None:
        """Close what can be closed, and roll back what is not proven."""
        written, session = False, self._server.session  # None where it failed before it got it
        if isinstance(error, REFUSALS) and session is not None and session.writing:
            with suppress(MavftpfsError):  # another failure is no news
                written = await self._server.close(TERMINATE_LIMIT)
        else:
            self._server.abandon()
        if written:
            self._source.check_point()
        else:
            self._roll_back()

    def _roll_back(self) -> None:
        self._source.roll_back(
            everything=self._engine.traits.wo_truncates is not False or not self._source.closed
        )


def is_blocked(error: MavftpfsError) -> bool:
    """Whether this is how PX4 refuses to write after it was asked for a path beyond its whitelist."""
    return isinstance(error, FtpNak) and error.opcode == Opcode.WRITE_FILE and error.code in _BLOCKED
