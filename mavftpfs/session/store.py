"""The vehicle's files, as the caches see them. Layer: session; implements cache.remote.VehicleStore.

**Did that change happen?** A request whose answer was lost is sent again, and the server may execute it
twice. It refuses the second execution, or that hits the name's next file (docs/servers.md 14.4). So after
such a refusal, a refused rename, or a silence, `_perform` lists the directory to see whether the change
happened. While ACKs are suspect (`ServerSession.distrust`), the network may also have doubled a request that
was sent once. A changed name may be in quarantine (`session.quarantine`); only `wait_out` waits for its end.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import replace
from functools import partial
from math import inf

import trio

from mavftpfs.cache.remote import ReadSink
from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.operations import ListDirectory, Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.protocol.reading import ReadToEof
from mavftpfs.protocol.writing import Pieces, WriteTransfer
from mavftpfs.session.happened import After, Outcome, judge, together
from mavftpfs.session.quarantine import MOST
from mavftpfs.session.reader import FileStream
from mavftpfs.session.scheduler import Scheduler, SessionUser
from mavftpfs.session.serversession import OpenSession
from mavftpfs.session.upload import Upload
from mavftpfs.shared.errors import (
    Armed,
    DataUnproven,
    FtpNak,
    MavftpfsError,
    OutcomeUnknown,
    PathTooLong,
    RemoteProtocolError,
    RequestTimeout,
    SessionLost,
)
from mavftpfs.shared.model import (
    RENAME_ROOM,
    DirEntry,
    Listing,
    Traits,
    is_on_nuttx,
    split,
    wire_path,
)
from mavftpfs.shared.sending import SendBuffer

TIME_PROBE_LIMIT = 2.5
"""Seconds of silence, or four round trips, after which ListDirectory is tried in place of
ListDirectoryWithTime."""

TIME_SILENCES = 2
"""Silences, each followed by an answered ListDirectory, after which opcode 16 counts as unknown: a single one
may be loss."""

_NO_TIMES = frozenset((NakCode.FAIL, NakCode.UNKNOWN_COMMAND, NakCode.FILE_EXISTS))
"""Refusals by servers that do not know opcode 16; 8 may hide any other code on PX4."""

LONGEST_CRC = 120.0
"""Seconds a vehicle may need for a checksum (promise 2)."""

CRC_TIME = 5.0
"""Seconds before a checksum is asked for again where the file's size is not known."""

COPY_RATE = 100_000.0
"""Bytes per second that the slowest card checksums, so no request for a checksum is repeated sooner."""

HURRY = 3.0
"""Seconds for running changes to end after the process was told to end at once."""

VERIFY_LIMIT = 4.0
"""Seconds to look whether an unanswered change happened. The caller waits for them beyond `op_deadline`."""

SWEEPS = 3
"""Listings of a directory at most, because its names changed during the earlier ones."""


class Store:
    """Reads, lists, checks and changes remote files; see cache.remote for what each call does.

    If a change of the card fails with FtpNak, RequestTimeout, VehicleLost, SessionBusy, PathTooLong or Armed,
    the change had not happened when the store looked. After OutcomeUnknown it may have. Only create_empty
    does not look: after its RequestTimeout an empty file may exist.
    """

    def __init__(self, scheduler: Scheduler) -> None:
        self.traits = scheduler.server.engine.traits
        self.in_doubt = scheduler.server.in_doubt
        self._scheduler = scheduler
        self._server = scheduler.server
        self._vehicle = scheduler.server.vehicle
        self._clock = scheduler.clock
        self._op_deadline = scheduler.server.op_deadline
        self._longest_change = inf if scheduler.server.patient else self._op_deadline + MOST + VERIFY_LIMIT
        self._under_way = self._ended = 0  # requests to change a name: waiting for an answer; over
        self._quarantine = scheduler.server.quarantine
        self._finishing: set[trio.CancelScope] = set()
        self._hurry_until = inf

    @property
    def epoch(self) -> float:
        """Return when reads were last distrusted (see VehicleStore)."""
        return self._server.epoch

    def on_distrust(self, told: Callable[[], None]) -> None:
        """See VehicleStore."""
        self._server.on_reads_distrusted = told

    def why_lost(self) -> str | None:
        """Return why the vehicle counts as lost (see RemoteStore)."""
        return self._vehicle.why_lost(self._clock())

    # --- reading

    async def list_directory(self, path: bytes, *, known_end: int | None = None) -> Listing:
        """Sweep a directory (see RemoteStore). Opcode 16 is tried first. If the server refuses it, or does
        not answer, and then answers opcode 3, the server does not know opcode 16."""
        wire, started, traits = wire_path(path), self._clock(), self.traits
        operation: ListDirectory | None = None
        tried: list[ListDirectory] = []
        refused = False
        if traits.lists_times is not False:
            probe = max(TIME_PROBE_LIMIT, 4.0 * (self._server.engine.rtt or 0.0))
            with trio.move_on_after(inf if traits.lists_times else probe) as scope:
                try:
                    operation = await self._server.ask(
                        partial(_asking_times, wire, known_end, traits, scope, tried)
                    )
                    traits.lists_times = True
                except FtpNak as nak:
                    if traits.lists_times or nak.code not in _NO_TIMES:
                        raise
                    refused = True
                except RequestTimeout:
                    if traits.lists_times:
                        raise
        if operation is None:
            left = max(1.0, self._op_deadline - (self._clock() - started)) if tried else inf
            try:
                operation = await self._server.ask(
                    partial(ListDirectory, wire, patience=left, known_end=known_end)
                )
            except RequestTimeout as exc:  # `left` is only the rest of what users know as op_deadline
                raise RequestTimeout(f"no answer within {self._op_deadline:g} s") from exc
            if tried and tried[-1].error is None:
                traits.time_silences += tried[-1].sent > 0  # it may never have had its turn
            if refused or traits.time_silences >= TIME_SILENCES:
                traits.lists_times = False
        entries = tuple(operation.entries)
        took = self._clock() - started
        return Listing(entries, took, operation.complete, operation.end)

    async def open_reader(
        self, path: bytes, sink: ReadSink, *, expected_size: int | None = None
    ) -> FileStream:
        """Open a regular file for reading (see RemoteStore)."""
        wire_path(path)
        if expected_size is None:
            self._vehicle.require(self._clock())
        stream = FileStream(path, sink, expected_size, self._scheduler)
        self._scheduler.add(stream, stream.run)
        try:
            await stream.first_open.wait()
        except BaseException:
            stream.close()
            raise
        return stream

    async def stat_size(self, path: bytes) -> int:
        """Open a file to know its size (see RemoteStore)."""
        wire_path(path)
        async with self._opened(path) as session:
            size = session.size
        if size is None:
            raise RemoteProtocolError("the vehicle's open reply holds no size")
        return size

    async def read_whole(self, path: bytes, limit: int) -> bytes:
        """Read an `@` file to its end (see RemoteStore); once more if the session was lost or suspect."""
        try:
            return await self._read_whole(path, limit)
        except (SessionLost, DataUnproven):
            return await self._read_whole(path, limit)

    async def _read_whole(self, path: bytes, limit: int) -> bytes:
        """Read the file; read it anew in shorter blocks if the server sends no longer ones."""
        block: int | None = self._scheduler.read_chunks.size
        while block is not None:
            async with self._opened(path) as session:
                epoch = self._server.epoch
                operation = ReadToEof(session.id, block, limit)
                with suppress(DataUnproven), self._server.running(operation):
                    while not operation.done:
                        self._server.require_open(session)
                        await self._server.look_again()
                self._server.require_open(session)
            if self._server.epoch != epoch:
                raise DataUnproven(f"another FTP client was active while {path!r} was read")
            block = operation.shorter
        if operation.error is not None:
            raise operation.error
        return operation.data

    @asynccontextmanager
    async def _opened(self, path: bytes, opcode: Opcode = Opcode.OPEN_FILE_RO) -> AsyncIterator[OpenSession]:
        """Keep a file open for the length of the body, in a turn of the caller's task; then terminate.

        Raises:
            MavftpfsError: the turn, the open or the Terminate failed.
        """
        user = SessionUser(path, writing=opcode != Opcode.OPEN_FILE_RO)
        self._vehicle.require(self._clock(), writing=user.writing)
        async with self._scheduler.turn(user) as turn:
            yield await turn.open(opcode)
            await self._server.close()

    async def crc32(self, path: bytes, *, size: int | None = None) -> int:
        """Ask for a checksum (see RemoteStore). size: of the file, if known. The request is not repeated
        before the slowest card can have read so much."""
        self._scheduler.assert_no_turn()
        if self._vehicle.armed:
            raise Armed("checksums are not asked for in flight")
        server_time, patience = CRC_TIME, LONGEST_CRC
        if size is not None:
            server_time = size / COPY_RATE
            patience = min(LONGEST_CRC, self._op_deadline + 2 * server_time)
        operation = await self._server.ask(
            partial(
                Simple,
                Opcode.CALC_FILE_CRC32,
                wire_path(path),
                patience=patience,
                server_time=server_time,
            )
        )
        data = operation.reply.data
        if len(data) < 4:
            raise RemoteProtocolError("the vehicle's checksum reply holds no checksum")
        return int.from_bytes(data[:4], "little")

    # --- changing

    def another_client_heard(self) -> bool:
        """Return whether another FTP client was heard in the last ten seconds."""
        return self._server.others.are_heard(self._clock())

    def address(self) -> tuple[int, int]:
        """Return system and component id; (1, 1), an autopilot's, before the first heartbeat."""
        address = self._vehicle.address
        return (1, 1) if address is None else (address.system, address.component)

    def board(self) -> str | None:
        """Return the unique id of the vehicle's board (see VehicleStore)."""
        return None if self._vehicle.version is None else self._vehicle.version.board

    async def write_whole(
        self, path: bytes, pieces: Sequence[bytes], progress: Callable[[int], None] | None = None
    ) -> None:
        """Write an `@` file (see VehicleStore)."""
        wire_path(path)
        self._vehicle.require(self._clock(), writing=True)
        await self.wait_out(path)
        try:
            async with self._opened(path, Opcode.CREATE_FILE) as session:
                await self._write_in_order(session, Pieces(pieces, progress))
        finally:
            self._quarantine.on_changed(path, self._clock())

    async def _write_in_order(self, session: OpenSession, pieces: Pieces) -> None:
        server = self._server
        chunks = ChunkSize(min(self._scheduler.read_chunks.size, self._scheduler.write_chunks.size))
        transfer = WriteTransfer(session.id, pieces, chunks, in_flight=1)
        with server.running(transfer):
            while not transfer.done and not transfer.drained:
                server.require_open(session)
                self._vehicle.require(self._clock(), writing=True)
                await server.look_again()

    def open_upload(self, path: bytes, source: SendBuffer) -> Upload:
        """Queue an upload. The upload sends nothing before its source has something or `finish` is called."""
        wire_path(path)
        self._vehicle.require(self._clock(), writing=True)
        upload = Upload(path, source, self._scheduler)
        self._scheduler.add(upload, upload.run)
        return upload

    async def create_empty(self, path: bytes) -> None:
        """Create an empty file, or empty an existing one. A second execution changes nothing."""
        wire_path(path)
        self._vehicle.require(self._clock(), writing=True)
        await self.wait_out(path)
        async with self._opened(path, Opcode.CREATE_FILE):
            pass

    async def wait_out(self, path: bytes) -> None:
        """See VehicleStore."""
        await trio.sleep(self._quarantine.left(path, self._clock()))

    async def remove(self, path: bytes, *, at_once: bool = False) -> None:
        """Remove what is known to be a file."""
        request = partial(Simple, Opcode.REMOVE_FILE, wire_path(path))
        async with self._changing(path, at_once=at_once):
            await self._perform(request, {path: After.ABSENT})
            self._scheduler.on_removed(path)

    async def remove_directory(self, path: bytes) -> None:
        """Remove what is known to be an empty directory."""
        request = partial(Simple, Opcode.REMOVE_DIRECTORY, wire_path(path))
        async with self._changing(path, below=True):
            await self._perform(request, {path: After.ABSENT})

    async def make_directory(self, path: bytes) -> None:
        """Make a directory."""
        request = partial(Simple, Opcode.CREATE_DIRECTORY, wire_path(path))
        async with self._changing(path):
            await self._perform(request, {path: After.DIRECTORY})

    async def rename(self, old: bytes, new: bytes, *, completes: bool = False) -> None:
        """Rename; readers of the old path go on under the new one. completes: in flight, too."""
        data = wire_path(old) + b"\0" + wire_path(new)
        if len(data) > RENAME_ROOM:
            raise PathTooLong(f"both paths of a rename have {len(data)} bytes, more than {RENAME_ROOM}")
        async with self._changing(old, new, below=True, in_flight=completes):
            # NuttX before October 2022 removes the file under the new name also when there is none under the
            # old one: done twice, nothing is left (servers.md 9).
            request = partial(Simple, Opcode.RENAME, data, exclusive=is_on_nuttx(new))
            await self._perform(request, {old: After.ABSENT, new: After.PRESENT})
            self._scheduler.on_renamed(old, new)

    @contextmanager
    def finishing(self, *, until: float = inf) -> Iterator[None]:
        """See VehicleStore; until: when the body ends at the latest, by trio's clock."""
        with trio.CancelScope(shield=True, deadline=min(until, self._hurry_until)) as scope:
            self._finishing.add(scope)
            try:
                yield
            finally:
                self._finishing.discard(scope)
        if scope.cancelled_caught:
            raise OutcomeUnknown("the vehicle did not get round to it in time")

    def hurry(self) -> None:
        """See VehicleStore."""
        self._hurry_until = trio.current_time() + HURRY
        for scope in self._finishing:
            scope.deadline = min(scope.deadline, self._hurry_until)

    @asynccontextmanager
    async def _changing(
        self, *paths: bytes, below: bool = False, in_flight: bool = False, at_once: bool = False
    ) -> AsyncIterator[None]:
        """Check that writing is allowed now, and keep files with these paths closed. The body sends the
        request; a cancellation does not interrupt it.

        below: all paths below the first, too. in_flight: also while the vehicle is armed. at_once: do not
        wait for a quarantine.

        Raises:
            RequestTimeout: the body did not begin in time.
        """
        self._vehicle.require(self._clock(), writing=not in_flight)
        until = trio.current_time() + self._longest_change
        with trio.CancelScope(deadline=until) as scope:
            async with self._scheduler.excluded(*paths, below=below):
                for path in () if at_once else paths:
                    await self.wait_out(path)
                # the waits may have taken a while
                self._vehicle.require(self._clock(), writing=not in_flight)
                with self.finishing(until=until):
                    yield
                    return
        if scope.cancelled_caught:
            raise RequestTimeout("the vehicle did not get round to it in time")

    # --- did that change happen?

    async def _perform(self, make: Callable[[], Simple], after: Mapping[bytes, After]) -> None:
        """Run a request; if it failed and may have been executed all the same, return or raise by what
        listings show. A refused request of which they show that it was not executed is sent once more.

        A refused rename is looked at in any case, because its caller would take the refusal for proof that
        nothing is renamed. If the old name is gone then, the network doubled the request, or another client
        removed the file, and the new name has the one that it had before. Both are a reason for doubt.

        after: the state of each name once the change happened.
        """
        error: FtpNak | RequestTimeout
        renames = After.PRESENT in after.values()
        for last in (False, True):
            self._under_way += 1
            began, repeated = self._clock(), True  # as long as no answer came
            try:
                repeated = (await self._server.ask(make, changes=True)).retransmitted
                return
            except FtpNak as nak:
                error, repeated = nak, nak.retransmitted
            except RequestTimeout as timeout:
                error = timeout
            finally:
                self._under_way -= 1
                self._ended += 1
                now = self._clock()
                for path, then in after.items():
                    # a late RENAME finds nothing that it could give the new name
                    counts = repeated and then is not After.PRESENT
                    self._quarantine.on_changed(path, now, now - began if counts else 0.0)
            silent = isinstance(error, RequestTimeout)
            # A refusal may answer the second execution.
            twice = (
                last or isinstance(error, RequestTimeout) or error.retransmitted or self._server.in_doubt()
            )
            # PX4 says 8 to everything after one "file exists", until a listing comes to its end.
            if isinstance(error, FtpNak) and not (twice or renames or error.code == NakCode.FILE_EXISTS):
                raise error
            outcome = await self._look(after, silent=silent)
            if outcome is Outcome.HAPPENED and (twice or renames):
                if not twice:
                    self._server.distrust(reads=True)
                return
            if outcome is Outcome.UNKNOWN or (silent and outcome is Outcome.CONFLICT):
                raise OutcomeUnknown(f"{error}; whether it was done is not known") from error
            if outcome is not Outcome.DID_NOT or last or silent:
                raise error

    async def _look(self, after: Mapping[bytes, After], *, silent: bool) -> Outcome:
        """List the directories of these names; return the verdict on a change that was refused, or not
        answered (silent)."""
        listed: dict[bytes, Listing] = {}
        evidence: list[Outcome] = []
        with trio.move_on_after(VERIFY_LIMIT if silent else inf):
            try:
                for path, then in after.items():
                    parent, name = split(path)
                    if parent not in listed:
                        listed[parent] = await self._names(parent)
                    found = judge(listed[parent], name, then)
                    made = then is After.DIRECTORY and found is Outcome.HAPPENED
                    if made and (await self.list_directory(path)).entries:
                        found = Outcome.CONFLICT  # a directory with entries is somebody else's
                    evidence.append(found)
                return together(evidence)
            except FtpNak:  # there is not even a parent to list
                return Outcome.UNKNOWN if silent else Outcome.DID_NOT
            except MavftpfsError:
                pass
        return Outcome.UNKNOWN

    async def _names(self, directory: bytes) -> Listing:
        """Return a fresh listing.

        The directory is listed again if this store changed names meanwhile, because a sweep goes on by a
        count of names, and misses those that moved up in place of a removed one. After SWEEPS listings,
        return all names that any of them showed.
        """
        seen: dict[bytes, DirEntry] = {}
        for _ in range(SWEEPS):
            before = self._ended
            listing = await self.list_directory(directory)
            if self._ended == before and not self._under_way:
                return listing
            seen |= {entry.name: entry for entry in listing.entries}
        return replace(listing, entries=tuple(seen.values()))


def _asking_times(
    wire: bytes, known_end: int | None, traits: Traits, scope: trio.CancelScope, tried: list[ListDirectory]
) -> ListDirectory:
    """Make a listing that lifts the scope's deadline when a page arrives, and append it to `tried`."""

    def on_page() -> None:
        traits.lists_times = True
        scope.deadline = inf

    operation = ListDirectory(wire, with_time=True, known_end=known_end)
    operation.on_page = on_page
    tried.append(operation)
    return operation
