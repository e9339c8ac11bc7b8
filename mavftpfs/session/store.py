"""The vehicle's files, as the caches see them. Layer: session; implements cache.remote.RemoteStore."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import trio

from mavftpfs.cache.remote import ReadSink
from mavftpfs.protocol.operations import ListDirectory, Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.foresight import Foresight
from mavftpfs.session.scheduler import Scheduler
from mavftpfs.session.sideeffects import DOT
from mavftpfs.session.stale import StaleSessions
from mavftpfs.session.stream import FileStream
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.session.writestore import COPY_RATE, WriteStore
from mavftpfs.shared.errors import Armed, FtpNak, RemoteProtocolError, RequestTimeout
from mavftpfs.shared.model import ROOT, DirEntry, Listing, wire_path

TIME_PROBE_LIMIT = 2.5
"""Seconds of silence after which ListDirectory is tried in place of ListDirectoryWithTime."""

TIME_SILENCES = 2
"""How often that must happen, with ListDirectory answering, before opcode 16 counts as unknown: loss may
look the same once."""

SWEEPS = 3
"""How often a directory is swept at most because names were taken away from it meanwhile."""

CRC_PATIENCE = 120.0
"""Seconds a vehicle may need for a checksum (design promise 2)."""

CRC_TIME = 5.0
"""Seconds before a checksum is asked for again where the file's size is not known."""


class Store(WriteStore):
    """Reads, lists and checks remote files; WriteStore changes them."""

    def __init__(
        self,
        scheduler: Scheduler,
        vehicle: Vehicle,
        *,
        clock: Callable[[], float],
        op_deadline: float = 30.0,
    ) -> None:
        self._stale = StaleSessions(scheduler, clock, op_deadline)
        self._foresight = Foresight()
        super().__init__(scheduler, self._list_steady, self._stale, self._foresight)
        self._op_deadline = op_deadline
        self._vehicle = vehicle
        self._clock = clock
        self._lists_times: bool | None = None
        self._time_silences = 0

    @property
    def lists_times(self) -> bool | None:
        """Whether this server answers opcode 16; None until it was asked."""
        return self._lists_times

    @property
    def kept_out(self) -> bool:
        """Whether the last listing was refused because of a session that is not ours."""
        return self._stale.in_the_way

    def forget_traits(self) -> None:
        """The vehicle rebooted, perhaps with other firmware."""
        self._lists_times = None
        self._time_silences = 0
        self._foresight.forget()

    async def list_directory(self, path: bytes) -> Listing:
        """Sweep a directory (see RemoteStore)."""
        wire = wire_path(path)
        started = self._clock()
        operation = await self._stale.outlast(partial(self._sweep_as_known, wire))
        self._foresight.learn(wire, operation.strings)
        entries: tuple[DirEntry, ...] = tuple(operation.entries)
        return Listing(entries, self._clock() - started, operation.complete, operation.hidden)

    async def _list_steady(self, path: bytes) -> Listing:
        """As list_directory, again if we took names away meanwhile (the caches see to that themselves).

        If they never stood still: what any of the sweeps saw, for each missed others.
        """
        wire = wire_path(ROOT if path == DOT else path)
        seen: dict[bytes, DirEntry] = {}
        for _ in range(SWEEPS):
            before = self._foresight.moves(wire)
            listing = await self.list_directory(path)
            seen |= {entry.name: entry for entry in listing.entries}
            if before is not None and before == self._foresight.moves(wire):
                return listing
        return replace(listing, entries=tuple(seen.values()))

    async def open_reader(
        self, path: bytes, sink: ReadSink, *, expected_size: int | None = None
    ) -> FileStream:
        """Open a regular file for reading (see RemoteStore)."""
        wire_path(path)
        if expected_size is None:
            self._scheduler.require_link()
        stream = self._scheduler.open_stream(path, sink, expected_size)
        try:
            await stream.wait_opened()
        except BaseException:
            stream.close()
            raise
        return stream

    async def read_whole(self, path: bytes, limit: int) -> bytes:
        """Read an `@` file to its end (see RemoteStore)."""
        wire_path(path)
        return await self._scheduler.read_whole(path, limit)

    async def crc32(self, path: bytes, *, size: int | None = None) -> int:
        """Ask for a checksum (see RemoteStore); size: of the file, if known: the question is not repeated
        before so much can have been read."""
        if self._vehicle.armed:
            raise Armed("checksums are not asked for in flight")
        server_time = CRC_TIME if size is None else size / COPY_RATE
        wire = wire_path(path)

        async def ask() -> bytes:
            operation = Simple(Opcode.CALC_FILE_CRC32, wire, patience=CRC_PATIENCE, server_time=server_time)
            await self._scheduler.metadata(operation, disturbs=False)
            return operation.reply.data

        data = await self._stale.outlast(ask)
        if len(data) < 4:
            raise RemoteProtocolError("the vehicle's checksum reply holds no checksum")
        return int.from_bytes(data[:4], "little")

    def _on_times(self, scope: trio.CancelScope) -> None:
        """Opcode 16 was answered: the rest of the listing may take as long as it takes."""
        self._lists_times = True
        scope.deadline = float("inf")

    async def _sweep_as_known(self, wire: bytes) -> ListDirectory:
        if self._lists_times is False:
            return await self._sweep(wire)
        return await self._sweep_asking_times(wire)

    async def _sweep(self, wire: bytes, *, patience: float | None = None) -> ListDirectory:
        operation = ListDirectory(wire, foreseen=self._foresight.strings(wire))
        operation.patience = patience
        await self._scheduler.metadata(operation)
        return operation

    async def _sweep_asking_times(self, wire: bytes) -> ListDirectory:
        """Try opcode 16; a refusal or a silence counts only if opcode 3 then answers."""
        began = self._clock()
        refused = False
        limit = float("inf") if self._lists_times else TIME_PROBE_LIMIT
        foreseen = self._foresight.strings(wire) if self._lists_times else 0
        asking = ListDirectory(wire, with_time=True, foreseen=foreseen)
        try:
            with trio.move_on_after(limit) as scope:
                asking.on_page = partial(self._on_times, scope)
                await self._scheduler.metadata(asking)
                self._lists_times = True
                return asking
        except FtpNak as nak:
            if self._lists_times or nak.code not in (
                NakCode.FAIL,
                NakCode.UNKNOWN_COMMAND,
                NakCode.FILE_EXISTS,
            ):
                raise
            refused = True
        except RequestTimeout:
            if self._lists_times:
                raise
        left = max(1.0, self._op_deadline - (self._clock() - began))
        operation = await self._sweep(wire, patience=left)
        self._time_silences += asking.sent  # it may have had to wait for its turn all the time
        if refused or self._time_silences >= TIME_SILENCES:
            self._lists_times = False
        return operation
