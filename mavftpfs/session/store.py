"""The vehicle's files, as the caches see them. Layer: session; implements cache.remote.RemoteStore."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import inf

import trio

from mavftpfs.cache.remote import ReadSink, UploadSource
from mavftpfs.protocol.operations import ListDirectory, Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.changes import COPY_RATE, Changes
from mavftpfs.session.driver import Driver
from mavftpfs.session.reader import FileStream
from mavftpfs.session.scheduler import Scheduler
from mavftpfs.session.upload import Upload
from mavftpfs.session.vehicle import SILENCE_LIMIT
from mavftpfs.shared.errors import Armed, FtpNak, RemoteProtocolError, RequestTimeout
from mavftpfs.shared.model import DirEntry, Listing, wire_path

TIME_PROBE_LIMIT = 2.5
"""Seconds of silence after which ListDirectory is tried in place of ListDirectoryWithTime."""

TIME_SILENCES = 2
"""How often that must happen, with ListDirectory answering, before opcode 16 counts as unknown: loss may
look the same once."""

CRC_PATIENCE = 120.0
"""Seconds a vehicle may need for a checksum (promise 2)."""

CRC_TIME = 5.0
"""Seconds before a checksum is asked for again where the file's size is not known."""


class Store:
    """Reads, lists, checks and changes remote files.

    Attributes:
        lists_times: whether this server answers opcode 16; None until it was asked.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        driver: Driver,
        *,
        clock: Callable[[], float],
        op_deadline: float = 30.0,
    ) -> None:
        self.lists_times: bool | None = None
        self._scheduler = scheduler
        self._server = scheduler.server
        self._driver = driver
        self._op_deadline = op_deadline
        self._vehicle = driver.vehicle
        self._clock = clock
        self._time_silences = 0
        self._changes = Changes(scheduler, driver.vehicle, self.list_directory, clock)
        # See cache.remote.VehicleStore.
        self.traits = scheduler.traits
        self.in_doubt = scheduler.doubt.is_active
        self.doubted_since = scheduler.doubt.arose_since
        self.remove = self._changes.remove
        self.make_directory = self._changes.make_directory
        self.remove_directory = self._changes.remove_directory
        self.rename = self._changes.rename
        self.create_empty = self._changes.create_empty

    def forget_server(self) -> None:
        """The vehicle rebooted, perhaps with other firmware."""
        self.lists_times = None
        self._time_silences = 0

    def is_silent(self) -> bool:
        """Return whether the vehicle is silent (see RemoteStore)."""
        return self._vehicle.silence(self._clock()) > SILENCE_LIMIT

    async def list_directory(self, path: bytes) -> Listing:
        """Sweep a directory (see RemoteStore)."""
        wire = wire_path(path)
        started = self._clock()
        sweep = self._sweep if self.lists_times is False else self._sweep_asking_times
        operation = await self._server.retry_while_taken(partial(sweep, wire))
        entries: tuple[DirEntry, ...] = tuple(operation.entries)
        return Listing(entries, self._clock() - started, operation.complete, operation.hidden)

    async def open_reader(
        self, path: bytes, sink: ReadSink, *, expected_size: int | None = None
    ) -> FileStream:
        """Open a regular file for reading (see RemoteStore)."""
        wire_path(path)
        if expected_size is None:
            self._vehicle.require_there(self._clock())
        stream = self._scheduler.reading.open_stream(path, sink, expected_size)
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
        server_time, patience = CRC_TIME, CRC_PATIENCE
        if size is not None:
            server_time = size / COPY_RATE
            patience = min(CRC_PATIENCE, self._scheduler.op_deadline + 2 * server_time)
        wire = wire_path(path)

        async def ask() -> bytes:
            operation = Simple(Opcode.CALC_FILE_CRC32, wire, patience=patience, server_time=server_time)
            self._vehicle.require_there(self._clock())
            await self._driver.run(operation)
            return operation.reply.data

        data = await self._server.retry_while_taken(ask)
        if len(data) < 4:
            raise RemoteProtocolError("the vehicle's checksum reply holds no checksum")
        return int.from_bytes(data[:4], "little")

    def _on_times(self, scope: trio.CancelScope) -> None:
        """Opcode 16 was answered: the rest of the listing may take as long as it takes."""
        self.lists_times = True
        scope.deadline = inf

    async def _sweep(self, wire: bytes, *, patience: float = inf) -> ListDirectory:
        operation = ListDirectory(wire)
        operation.patience = patience
        await self._scheduler.metadata(operation)
        return operation

    async def _sweep_asking_times(self, wire: bytes) -> ListDirectory:
        """Try opcode 16; a refusal or a silence counts only if opcode 3 then answers."""
        began = self._clock()
        refused = False
        limit = inf if self.lists_times else TIME_PROBE_LIMIT
        asking = ListDirectory(wire, with_time=True)
        try:
            with trio.move_on_after(limit) as scope:
                asking.on_page = partial(self._on_times, scope)
                await self._scheduler.metadata(asking)
                self.lists_times = True
                return asking
        except FtpNak as nak:
            if self.lists_times or nak.code not in (
                NakCode.FAIL,
                NakCode.UNKNOWN_COMMAND,
                NakCode.FILE_EXISTS,
            ):
                raise
            refused = True
        except RequestTimeout:
            if self.lists_times:
                raise
        left = max(1.0, self._op_deadline - (self._clock() - began))
        operation = await self._sweep(wire, patience=left)
        self._time_silences += asking.sent  # it may have had to wait for its turn all the time
        if refused or self._time_silences >= TIME_SILENCES:
            self.lists_times = False
        return operation

    # --- changing files

    async def open_upload(self, path: bytes, source: UploadSource) -> Upload:
        """Queue an upload; nothing is sent before the source has something or finish is called."""
        wire_path(path)
        self._vehicle.require_writable(self._clock())
        await self._changes.rest(path)
        return self._scheduler.uploading.open_upload(path, source)

    async def stat_size(self, path: bytes) -> int:
        """See cache.remote.VehicleStore."""
        wire_path(path)
        session = await self._scheduler.use_session(path, Opcode.OPEN_FILE_RO)
        if session.size is None:
            raise RemoteProtocolError("the vehicle's open reply holds no size")
        return session.size
