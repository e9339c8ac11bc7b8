"""The server's one session: what is open there, and what to do when it is taken. Layer: session.

Two facts say what this connection opened: `opened` is the file that is open, and `maybe_open` holds the
files of which that is not known. One of them is always empty. The task that has the turn opens, uses and
closes a file. Between turns the scheduler's janitor closes it. At any time `distrust` may move the open file
to `maybe_open`, because another file may be open in its place.

Requests that carry a path and need no session (`ask`) run beside it, and carry its id (docs/servers.md 1).
"""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from math import inf, nextafter
from typing import TypeVar

import trio

from mavftpfs.protocol.operations import BEYOND, ListDirectory, OpenRequest, Simple
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.protocol.requests import Operation, Request
from mavftpfs.session.driver import Driver
from mavftpfs.session.others import (
    LEFT_OPEN,
    OPENING,
    STAYS_ITS_OWN,
    Heard,
    OtherClients,
)
from mavftpfs.session.quarantine import LASTS, Quarantine
from mavftpfs.session.remedies import (
    IF_OPEN,
    MAYBE_TAKEN,
    SILENCE_ARDUPILOT,
    SILENCE_PX4,
    TAKEN,
    Holder,
    Tried,
    holder,
)
from mavftpfs.shared.errors import (
    FtpNak,
    MavftpfsError,
    RequestTimeout,
    SessionBusy,
    SessionLost,
    SessionTaken,
)
from mavftpfs.shared.model import wire_path

TERMINATE_LIMIT = 5.0
"""Seconds to wait for the answer to a Terminate if no caller waits for its result."""

STALL = 2.0
"""Seconds without a reply, while a file is read or written, after which the file is opened anew, because the
server may have closed its session."""

_OFTEN = 0.25
"""Seconds between two looks at a running transfer at most."""

_SURELY_OPEN = 8.0
"""Seconds in which no server closes an idle session (PX4 does after 10)."""

_IN_USE = "the vehicle's only FTP session is in use by another client"

Asked = TypeVar("Asked", bound=Operation)


@dataclass(frozen=True, slots=True)
class OpenSession:
    """A file that the server has open for this connection.

    size: in bytes, as the open ACK said; None where it said nothing. opened_at: when that ACK came. writing:
    opened by OpenFileWO or CreateFile. ack_seq: of that ACK. resent: its request was sent more than once.
    """

    path: bytes
    id: int
    size: int | None
    opened_at: float
    writing: bool = False
    ack_seq: int = -1
    resent: bool = False


class ServerSession:
    """Opens and closes files, and knows what is open.

    op_deadline: seconds to wait for the answer to a Terminate if a caller waits for its result.
    patient: see ConnectOptions.

    Attributes:
        opened: the open file; None if none is open, or if it was moved to `maybe_open`. transfer: the
        operation that reads or writes it now.
        maybe_open: the path of each file that this connection may have open: its open or its Terminate is not
        answered (yet), or `distrust` moved it here. The path is b"" if that is not known.
        newest_open_at: the time of the newest open: when it went out, then when its ACK came. A request that
        went out earlier belongs to an earlier file.
        epoch: the time of the last `distrust` of reads, always later than the one before. Bytes that were
        read before it, and not long before, may be another file's.
        quarantine: of names that were changed.
        others: other clients of this server.
        held_up: the number of requests without a session that wait for other clients.
        on_reads_distrusted: called whenever the epoch was raised.
        changed: where tasks park until turns, open files or the wishes of users change.
    """

    def __init__(
        self,
        driver: Driver,
        clock: Callable[[], float],
        rng: random.Random,
        op_deadline: float = 30.0,
        *,
        patient: bool = False,
    ) -> None:
        self.driver = driver
        self.engine = driver.engine
        self.engine.on_unexplained, self.engine.on_unawaited = self.on_unexplained, self.on_unawaited
        self.vehicle = driver.vehicle
        self.clock = clock
        self.op_deadline = op_deadline
        self.patient = patient
        self.opened: OpenSession | None = None
        self.transfer: Operation | None = None
        self.maybe_open: list[bytes] = []
        self.newest_open_at = -inf
        self.epoch = self._distrusted_at = -inf
        self.quarantine = Quarantine()
        self.others = OtherClients(rng)
        self.held_up = 0
        self.on_reads_distrusted: Callable[[], None] = lambda: None
        self._asked_sessions_at = -inf
        self._terminating = trio.CancelScope()
        self.changed = trio.lowlevel.ParkingLot()

    # --- trust

    def distrust(self, *, reads: bool) -> None:
        """Make ACKs suspect: for ten minutes the caches compare each file that they write.

        Servers share session ids between clients, requests name a session and no file, and some links deliver
        a request twice, the second time late. reads: bytes that were read lately may be another file's, too,
        so the transfer is cancelled, its file moves to `maybe_open`, and the epoch is raised.
        """
        self._distrusted_at = self.clock()
        if reads:
            self.epoch = max(self._distrusted_at, nextafter(self.epoch, inf))
            self.leave()
            self.on_reads_distrusted()

    def in_doubt(self, since: float = inf) -> bool:
        """Return whether ACKs are suspect: there was a `distrust` in the last ten minutes, or after
        `since`."""
        return self.clock() - self._distrusted_at <= LASTS or self._distrusted_at > since

    def on_another_client(self, payload: bytes) -> None:
        """Note another FTP client's payload, and distrust reads if that client may have the shared session.

        If none was heard for a while, this client may have taken the session by earlier payloads that this
        connection missed. Exceptions: its request to open takes nothing before the server answers, and an
        upload goes on because its file is compared afterwards.
        """
        engine, session, now = self.engine, self.opened, self.clock()
        newcomer, heard = not self.others.are_heard(now), self.others.hear(payload, now)
        # Where servers echo ids, each client has one of its own.
        shared = not engine.traits.ack_carries_own_session or self.others.session == engine.home_session
        took = shared and heard in (Heard.OPENED, Heard.USED)
        if took:
            self._terminating.cancel()
        uploads = session is not None and session.writing
        missed = newcomer and heard is not Heard.ASKED and not uploads
        # If no file was opened since reads were last distrusted, no more bytes are suspect.
        suspect = session is not None or self.newest_open_at >= self.epoch
        self.distrust(reads=(took or missed) and suspect)
        self.wake()

    def on_unexplained(self, reply: Payload, lateness: float | None) -> None:
        """Take an answer beyond those that the requests of this connection account for: the network doubled
        the answer, or it doubled the request, and the server executed that twice.

        lateness: seconds since its request went out, None if that is not known. If the answer is the ACK of
        another open than the present file's, that file may be open now. Then reads are distrusted, because
        MAVSDK has that file open in place of the present one. A second ACK of the present file's open shows
        the same file; if MAVSDK emptied it by that, the comparison after the upload shows it.
        """
        self.quarantine.saw(lateness, self.clock())
        opens = reply.opcode == Opcode.ACK and reply.req_opcode in OPENING
        another = opens and (self.opened is None or self.opened.ack_seq != reply.seq)
        self.distrust(reads=another and self.opened is not None)
        if another:
            self.maybe_open.append(b"")
            self.wake()

    def on_unawaited(self, reply: Payload, request: Request) -> None:
        """Take an ACK that no operation waits for, because another transmission was answered or the operation
        was cancelled.

        A late open may have replaced the present file by an earlier one, or left that open. A late WriteFile
        may have put its bytes into a later file. A late RENAME or REMOVE may have taken a later file away if
        it came after the quarantine of its name.
        """
        late, newest = self.clock() - request.first_sent, request.first_sent >= self.newest_open_at
        if reply.req_opcode in (Opcode.RENAME, Opcode.REMOVE_FILE):
            name, _, _ = request.data.partition(b"\0")
            if not self.quarantine.left(name, self.clock()):
                self.on_unexplained(reply, late)
        elif reply.req_opcode in OPENING:
            cancelled = newest and self.maybe_open  # which has its file
            if not cancelled and (self.opened is None or self.opened.ack_seq != reply.seq):
                self.on_unexplained(reply, late)
        elif reply.req_opcode == Opcode.WRITE_FILE and not newest:
            self.distrust(reads=False)

    def leave(self) -> None:
        """Stop using the open file: cancel its transfer, and move it to `maybe_open`, so that it is closed
        before the next open."""
        if self.transfer is not None:
            self.driver.cancel(self.transfer)
        if self.opened is not None:
            self.maybe_open.append(self.opened.path)
            self.opened, self.engine.session = None, self.engine.home_session
        self.wake()

    def lose(self, lost: SessionLost) -> None:
        """Leave the session that its user found lost; distrust reads if the server said so, because then
        another client may have had the session."""
        if lost.by_server:
            self.distrust(reads=True)
        else:
            self.leave()

    def _forget(self, count: int) -> None:
        """Note that the first files in `maybe_open` are closed. The later ones stay, because a late open may
        have opened one behind the Terminate."""
        del self.maybe_open[:count]
        self.wake()

    # --- waiting

    def wake(self) -> None:
        """Wake all tasks that sleep here, because something changed."""
        self.changed.unpark_all()

    async def sleep(self, seconds: float) -> None:
        """Wait until something changes, at most `seconds`."""
        with trio.move_on_after(seconds):
            await self.changed.park()

    # --- using the open file

    @contextmanager
    def running(self, transfer: Operation, on_batch: Callable[[float], None] | None = None) -> Iterator[None]:
        """Run a transfer of the open file for the length of the body, unless `leave` cancels it. The body
        waits by `look_again` until the transfer is done or idle, or ends it before. on_batch: see
        `Driver.start`.

        Raises:
            MavftpfsError: the error of the transfer.
        """

        def after_batch(now: float) -> None:
            if on_batch is not None:
                on_batch(now)
            if transfer.idle:
                self.wake()

        self.transfer = transfer
        try:
            self.driver.start(transfer, self.wake, after_batch)
            yield
        finally:
            self.transfer = None
            transfer.finish()
            self.driver.cancel(transfer)
        if transfer.error is not None:
            raise transfer.error

    async def look_again(self) -> None:
        """Send what a running transfer was given to send, because with nothing in flight no answer causes
        that, and wait until something changes, or for a moment."""
        self.driver.kick()
        await self.sleep(_OFTEN)

    # --- opening

    async def open(self, path: bytes, opcode: Opcode = Opcode.OPEN_FILE_RO) -> OpenSession:
        """Close what is open and open another file, by OpenFileRO, OpenFileWO or CreateFile.

        Raises:
            FtpNak: the server refused. SessionTaken: another client has a file open. SessionBusy: the session
                stayed taken. SessionLost: the file was opened, and `distrust` left it at once.
                RequestTimeout: no answer, to this open or to the close of an earlier file.
        """
        await self.close_quietly()
        await self._close_maybe_open()
        tried = Tried(self.clock(), opens=True)
        try:
            while not await self._opens(path, opcode, tried):
                pass
        finally:
            if opcode == Opcode.CREATE_FILE:
                # If a server renames nothing, the caches compare the file only once, and a duplicate of this
                # request may empty it after that.
                repeated = self.opened is None or self.opened.resent
                counts = repeated and self.engine.traits.rename_works is False
                now = self.clock()
                self.quarantine.on_changed(path, now, now - tried.began if counts else 0.0)
        if self.opened is None:
            raise _lost()
        return self.opened

    async def _opens(self, path: bytes, opcode: Opcode, tried: Tried) -> bool:
        """Ask to open a file once; return False if that is to be tried again."""
        operation = OpenRequest(opcode, wire_path(path), session=self.engine.home_session)
        operation.on_opened = partial(self._on_opened, path, tried)
        self.maybe_open.append(path)  # where it stays after a time-out or a cancellation
        self.newest_open_at = self.clock()
        try:
            await self.driver.run(operation)
        except FtpNak as nak:
            tried.resent |= nak.retransmitted
            # If the open was sent twice, the first transmission may have opened the file. By NAK 1 an
            # ArduPilot, whose ACKs echo ids, says that a late open left a file open under our id.
            says_so = self.engine.traits.ack_carries_own_session and nak.code == NakCode.FAIL
            if not (says_so or (nak.retransmitted and nak.code in IF_OPEN)):
                self.maybe_open.remove(path)
            await self._remedy(nak, tried)
            return False
        return True

    def _on_opened(self, path: bytes, tried: Tried, operation: OpenRequest) -> None:
        """Note the ACK of an open at once, because an answer right behind it may show that another file is
        open, before the task that asked runs again."""
        self.maybe_open.clear()
        self.others.on_ours_opened()
        self.opened = OpenSession(
            path,
            operation.session,
            operation.size,
            self.clock(),
            writing=operation.opcode != Opcode.OPEN_FILE_RO,
            ack_seq=operation.reply.seq,
            resent=tried.resent or operation.retransmitted,
        )
        self.engine.session, self.newest_open_at = self.opened.id, self.opened.opened_at

    # --- when the session is taken

    async def _remedy(self, nak: FtpNak, tried: Tried) -> None:
        """Apply the next remedy for a refusal (the table in `remedies`), and return if the request may be
        sent again.

        Raises:
            FtpNak: the refusal has another reason. SessionTaken: another client has a file open.
            SessionBusy: nothing is left that could help. RequestTimeout: a remedy was not answered.
        """
        now = self.clock()
        ours = tried.opens and bool(self.maybe_open) and self._may_terminate
        who = holder(nak, tried, ours=ours, another=now < self.others_until)
        tries = tried.remedies[who]
        tried.remedies[who] += 1
        match who, tries:
            case Holder.NOBODY, _:
                raise nak
            case Holder.HIDDEN, _:
                await self._try(self.driver.run(ListDirectory(b"/", False)))
            case Holder.OURS, _:
                await self._close_maybe_open()
            case Holder.ANOTHER, _:
                raise SessionTaken(_IN_USE) from nak
            case Holder.GONE, 0:
                await self.driver.be_silent(SILENCE_ARDUPILOT)
            case Holder.GONE, 1:
                await self.driver.be_silent(SILENCE_PX4)
            case Holder.GONE, 2 if tried.opens and not self.others.are_heard(now):
                reset = Simple(Opcode.RESET_SESSIONS, session=self.engine.home_session)
                await self._try(self.driver.run(reset))
            case _:
                raise SessionBusy(_IN_USE) from nak

    def busy_at(self, since: float) -> float:
        """Return when a caller that waits for other clients since then gets SessionBusy: `op_deadline` after
        they last closed a file; never if the connection is patient."""
        return inf if self.patient else max(since, self.others.closed_at) + self.op_deadline

    @property
    def others_until(self) -> float:
        """The time until which this connection opens no file, because that might end another client's
        session."""
        return -inf if self.engine.traits.several_sessions else self.others.file_open_until

    async def wait_for_others(self, since: float) -> None:
        """Wait until no other client has a file open.

        Raises:
            SessionBusy: see `busy_at`.
        """
        self.held_up += 1
        try:
            while (now := self.clock()) < self.others_until:
                if now >= self.busy_at(since):
                    raise SessionBusy(_IN_USE)
                await self.sleep(min(self.others_until, self.busy_at(since)) - now)
        finally:
            self.held_up -= 1

    # --- closing

    async def close(self, limit: float = inf) -> bool:
        """Terminate the session; return False if the server had closed it by itself before.

        The result is also True if another client took the session before the answer came. That closed the
        file, and raises a distrust by which the caches compare it.

        If the server answers a repeated Terminate with "no such session", the first transmission closed it.
        Exception: after 8 s the server may have closed the session because it was idle. limit: seconds to
        wait for the answer, inf for op_deadline.

        Raises:
            FtpNak: the server could not close the file. RequestTimeout: no answer; the file is in
                `maybe_open`.
        """
        session = self.opened
        if session is None:
            return True
        self.leave()
        asked_at = self.clock()
        try:
            with trio.move_on_after(limit):
                await self._terminate(session.id)
                self._forget(1)
                return True
        except FtpNak as nak:
            self._forget(1)
            if nak.code not in MAYBE_TAKEN:
                raise
            # The file was in use when the first transmission went out.
            closed = nak.retransmitted and self.clock() - asked_at < _SURELY_OPEN
            if not closed:  # another client may have had the session
                self.distrust(reads=True)
            return closed
        raise RequestTimeout("no answer to TerminateSession")

    async def close_quietly(self) -> None:
        """Close the open file; a failure leaves it in `maybe_open`."""
        with suppress(MavftpfsError):
            await self.close(TERMINATE_LIMIT)

    async def close_maybe_open(self) -> None:
        """Close the files in `maybe_open`; a failure leaves them there."""
        with trio.move_on_after(TERMINATE_LIMIT), suppress(MavftpfsError):
            await self._close_maybe_open()

    async def _close_maybe_open(self) -> None:
        """Close the files in `maybe_open`, and forget those in whose place another client may have a file
        open.

        Raises:
            RequestTimeout: no answer; the files stay in `maybe_open`.
        """
        count, asked = len(self.maybe_open), self.engine.home_session
        # PX4 and MAVSDK answer with id 0, whatever was asked for; before the first ACK it may be either.
        ids = {True: (asked,), False: (0,), None: (asked, 0)}[self.engine.traits.ack_carries_own_session]
        for session in ids:
            if count and self._may_terminate:
                await self._try(self._terminate(session))
        self._forget(count)

    async def _terminate(self, session: int) -> None:
        """Send Terminate until it is answered, or another client has the session. Then ours is closed, and a
        repetition would close that client's file."""
        with trio.CancelScope() as self._terminating:
            await self.driver.run(Simple(Opcode.TERMINATE_SESSION, session=session))

    @property
    def _may_terminate(self) -> bool:
        """Whether a Terminate ends no other client's session. Where ids are shared, it ends the session of
        the client that has it."""
        return bool(self.engine.traits.ack_carries_own_session) or self.clock() >= self.others_until

    def require_open(self, session: OpenSession) -> None:
        """Raise SessionLost unless this session is still open."""
        if self.opened is not session:
            raise _lost()

    @property
    def longest_silence(self) -> float:
        """How many seconds a transfer waits for any answer: STALL, or four round trips. Where these are not
        known, they may be long."""
        return max(STALL, 4.0 * (self.engine.rtt or STALL))

    def is_stalled(self, transfer: Operation) -> bool:
        """Return whether a transfer waits for answers, and the server sent none of any kind for long."""
        # Requests of the transfer that wait for `bwlimit=` are no silence.
        heard_at = max(self.driver.last_reply_at, transfer.progress_at)
        return not transfer.idle and self.clock() - heard_at > self.longest_silence

    # --- requests beside the session

    async def ask(self, make: Callable[[], Asked], *, changes: bool = False) -> Asked:
        """Carry out a request that carries a path and needs no session of its own.

        ArduPilot refuses such a request while another client has a session. Then `make` makes a new one,
        which is sent when that client has closed its file, or after a silence. While this connection has a
        file open, the refusal is raised at once, because a silence would hold up its transfer.

        changes: the request changes the card. If it was sent twice, a refusal is raised at once, because it
            may answer the second execution.

        Raises:
            VehicleLost. SessionBusy: the other client kept its session. The errors of the request.
        """
        tried = Tried(self.clock(), opens=False)
        while True:
            operation = make()
            self.vehicle.require(self.clock())
            try:
                await self.driver.run(operation)
                return operation
            except FtpNak as nak:
                if self.opened is not None or (changes and nak.retransmitted):
                    raise
                try:
                    await self._remedy(nak, tried)
                except SessionTaken:
                    await self.wait_for_others(tried.began)

    async def learn_several_sessions(self) -> None:
        """Learn whether the server has several sessions (`Traits.several_sessions`) while another client has
        one: an ArduPilot with a single session refuses a listing then. Asks at most every LEFT_OPEN seconds.
        """
        now, traits = self.clock(), self.engine.traits
        same_id = self.others.session == self.engine.home_session
        if not traits.ack_carries_own_session or same_id or now - self._asked_sessions_at < LEFT_OPEN:
            return
        if not self.others.has_session(now, now):
            return
        self._asked_sessions_at, refused = now, True
        with trio.move_on_after(STAYS_ITS_OWN), suppress(MavftpfsError):
            try:
                await self.driver.run(Simple(Opcode.LIST_DIRECTORY, b"/", offset=BEYOND))
                refused = False
            except FtpNak as nak:
                refused = nak.code in TAKEN
        traits.several_sessions = not refused and self.others.has_session(now, self.clock())
        self.wake()

    async def _try(self, remedy: Awaitable[None]) -> None:
        """Carry out a remedy, and ignore its refusal.

        Raises:
            RequestTimeout: no answer.
        """
        try:
            await remedy
        except RequestTimeout:
            raise
        except MavftpfsError:
            pass


def _lost() -> SessionLost:
    return SessionLost("the vehicle restarted, or opened another file", by_server=False)
