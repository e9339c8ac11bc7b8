"""How the caches change the vehicle's files. Layer: session; implements cache.remote.WriteStore."""

from __future__ import annotations

import errno

from mavftpfs.cache.remote import FREE_FOR, UploadSource
from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.foresight import Foresight
from mavftpfs.session.probing import probe_writing
from mavftpfs.session.scheduler import Scheduler
from mavftpfs.session.sideeffects import Lister, Outcome, SideEffects
from mavftpfs.session.stale import StaleSessions
from mavftpfs.session.upload import QueuedUpload
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import AlreadyExists, FtpNak, MavftpfsError, RemoteProtocolError, RequestTimeout
from mavftpfs.shared.model import wire_path
from mavftpfs.shared.traits import WriteTraits

TRUNCATE_PATIENCE = 120.0
"""Seconds a vehicle may need to cut a file (design promise 2)."""

FIRST_TRUNCATE_PATIENCE = 20.0
"""Seconds, and what the slowest card needs, after which one that was not seen to cut files counts as not
answering: MAVSDK never does (servers.md 8), and until then nobody can read the file."""

COPY_RATE = 100_000.0
"""Bytes per second that the slowest card copies or checksums; a repetition waits for so long."""

_UNKNOWN_OPCODE = frozenset((NakCode.FAIL, NakCode.UNKNOWN_COMMAND))


class WriteStore:
    """Uploads and side effects."""

    def __init__(
        self, scheduler: Scheduler, list_directory: Lister, stale: StaleSessions, foresight: Foresight
    ) -> None:
        self._scheduler = scheduler
        self._foresight = foresight
        self._effects = SideEffects(scheduler, list_directory, stale, foresight)

    @property
    def traits(self) -> WriteTraits:
        """See cache.remote.WriteStore."""
        return self._scheduler.write_traits

    def in_doubt(self) -> bool:
        """See cache.remote.WriteStore."""
        return self._scheduler.doubt.active

    def doubted_since(self, at: float) -> bool:
        """See cache.remote.WriteStore."""
        return self._scheduler.doubt.arose_since(at)

    async def open_upload(
        self,
        path: bytes,
        source: UploadSource,
        *,
        create: bool = True,
        least: int = 0,
        free_at: float | None = None,
    ) -> QueuedUpload:
        """Queue an upload; nothing is sent before the source has something or finish is called."""
        wire_path(path)
        self._scheduler.check_may_write()
        await self._scheduler.echoes.let_pass(path)
        if create:
            self._foresight.made(path)
        upload = self._scheduler.open_upload(path, source, create=create)
        upload.least = least
        upload.free_at = free_at
        return upload

    async def create_empty(self, path: bytes, *, free_at: float | None = None) -> None:
        """Make a file, or empty it; done twice it is the same."""
        wire_path(path)
        self._scheduler.check_may_write()
        if free_at is not None and self._scheduler.seconds_since(free_at) > FREE_FOR:
            await self._require_free(path)
        await self._scheduler.echoes.let_pass(path)
        self._foresight.made(path)
        with self._scheduler.echoes.noted(path):
            await self._scheduler.use_session(path, Opcode.CREATE_FILE)

    async def remove(self, path: bytes) -> None:
        """See cache.remote.WriteStore."""
        await self._effects.remove(path)

    async def make_directory(self, path: bytes) -> None:
        """See cache.remote.WriteStore."""
        await self._effects.make_directory(path)

    async def remove_directory(self, path: bytes) -> None:
        """See cache.remote.WriteStore."""
        await self._effects.remove_directory(path)

    async def rename(self, old: bytes, new: bytes, *, completes: bool = False) -> None:
        """See cache.remote.WriteStore."""
        await self._effects.rename(old, new, completes=completes)
        self.traits.rename_works = True

    async def stat_size(self, path: bytes) -> int:
        """See cache.remote.WriteStore."""
        wire_path(path)
        session = await self._scheduler.use_session(path, Opcode.OPEN_FILE_RO)
        if session.size is None:
            raise RemoteProtocolError("the vehicle's open reply holds no size")
        return session.size

    async def truncate(self, path: bytes, size: int) -> None:
        """See cache.remote.WriteStore. A file whose size is the wanted one already counts as done."""
        wire = wire_path(path)
        traits = self.traits
        if traits.truncate_works is None and path.startswith(b"/fs/"):
            traits.truncate_works = False  # PX4 on NuttX: its copy-back can destroy the file
        if traits.truncate_works is False:
            raise FtpNak(Opcode.TRUNCATE_FILE, NakCode.UNKNOWN_COMMAND)

        work = 2 * size / COPY_RATE
        patience = TRUNCATE_PATIENCE
        if traits.truncate_works is None:
            patience = min(patience, FIRST_TRUNCATE_PATIENCE + work)

        def make() -> Simple:
            return Simple(Opcode.TRUNCATE_FILE, wire, offset=size, patience=patience, server_time=work)

        async def verify() -> Outcome:
            entry, _ = await self._effects.find(path)
            return Outcome.DONE if entry is not None and entry.size == size else Outcome.UNDONE

        try:
            await self._effects.perform(path, make, verify)
        except FtpNak as nak:
            if nak.code in _UNKNOWN_OPCODE and traits.truncate_works is None:
                traits.truncate_works = False
            raise
        except RequestTimeout:
            if traits.truncate_works is None and await self._is_listed(path):
                traits.truncate_works = False
            raise
        if traits.truncate_works is None:
            traits.truncate_works = True

    async def probe_open_for_write(self, first: bytes, second: bytes) -> None:
        """See cache.remote.WriteStore."""
        wire_path(first)
        wire_path(second)
        self._scheduler.check_may_write()
        self._foresight.lose(first, second)
        await probe_writing(self._scheduler, self._effects, first, second)

    def endangered(self, path: bytes) -> list[tuple[int, int]]:
        """See cache.remote.WriteStore."""
        return self._scheduler.written.feared(path)

    async def _require_free(self, path: bytes) -> None:
        """Raise AlreadyExists if CreateFile would empty something, perhaps of another spelling."""
        try:
            await self._scheduler.use_session(path, Opcode.OPEN_FILE_RO)
        except FtpNak as nak:
            if errno_for(nak) != errno.ENOENT:
                raise
        else:
            raise AlreadyExists(f"{path!r} was made by somebody else in the meantime")

    async def _is_listed(self, path: bytes) -> bool:
        """Whether the vehicle answers a listing, so that its silence was about the request."""
        try:
            await self._effects.find(path)
        except MavftpfsError:
            return False
        return True
