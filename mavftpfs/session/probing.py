"""Finding out on a temporary of our own what a server does when it is written to. Layer: session.

Only at first need, never in flight. What is not answered, and what the paths are too long
for, stays unknown. The names are the mount's own and used once, so two mounts never meet in one, and what an
interruption leaves is removed at the next listing like any other leftover.
"""

from __future__ import annotations

from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.changes import RENAME_LIMIT, Changes
from mavftpfs.session.scheduler import Scheduler
from mavftpfs.session.serversession import OpenSession
from mavftpfs.shared.errors import FtpNak, RequestTimeout
from mavftpfs.shared.model import split, wire_path
from mavftpfs.shared.traits import WriteTraits

CONTENT = b"abc"

LOOKS = 3
"""How often at most it is looked what OpenFileWO does where requests are seen to come twice: until two looks
agree. A late WriteFile fills a file that was emptied, a late CreateFile empties one that was not."""

SILENCE = 6.0
"""Seconds after which TruncateFile of three bytes counts as not answered."""

_UNKNOWN = frozenset((NakCode.FAIL, NakCode.UNKNOWN_COMMAND))


async def probe_writing(scheduler: Scheduler, effects: Changes, first: bytes, second: bytes) -> None:
    """Fill the traits that are unknown, by files at two free paths, and leave nothing behind.

    Raises:
        FtpNak: the directory cannot be written. RequestTimeout, VehicleLost, SessionBusy, Armed.
    """
    await _Probe(scheduler, effects, first, second).run()


class _Probe:
    def __init__(self, scheduler: Scheduler, effects: Changes, first: bytes, second: bytes) -> None:
        self._scheduler = scheduler
        self._effects = effects
        self._path = first
        self._second = second

    @property
    def _traits(self) -> WriteTraits:
        return self._scheduler.write_traits

    async def run(self) -> None:
        """The steps, each with what the one before left."""
        try:
            if self._traits.wo_creates is None:
                await self._open_missing()
            await self._fill()
            size: int | None = len(CONTENT)
            if self._traits.wo_truncates is None:
                size = await self._open_existing()
            if self._traits.truncate_works is None:
                await self._truncate(size)
            left = [self._path]
            if (
                self._traits.rename_works is None
                and len(wire_path(self._path) + wire_path(self._second)) < RENAME_LIMIT
            ):
                left = await self._rename()
        except BaseException:
            await self._sweep_up()
            raise
        for path in left:
            await self._effects.remove(path)

    async def _sweep_up(self) -> None:
        """One listing tells of both names."""
        entries, _ = await self._effects._entries(split(self._path)[0])
        names = [entry.name for entry in entries]
        for path in (self._path, self._second):
            if split(path)[1] in names:
                await self._effects.remove(path)

    async def _open_missing(self) -> None:
        try:
            await self._scheduler.use_session(self._path, Opcode.OPEN_FILE_WO)
        except FtpNak as nak:
            if nak.code == NakCode.FILE_NOT_FOUND:
                self._traits.wo_creates = False
            return
        entry, _ = await self._effects._find(self._path)
        self._traits.wo_creates = entry is not None

    async def _fill(self) -> None:
        await self._scheduler.use_session(self._path, Opcode.CREATE_FILE, self._write)

    async def _write(self, session: OpenSession) -> None:
        operation = Simple(Opcode.WRITE_FILE, CONTENT, session=session.id)
        await self._scheduler.metadata(operation, disturbs=False)

    async def _open_existing(self) -> int | None:
        """Return the size afterwards."""
        seen: list[int | None] = []
        for _ in range(LOOKS):
            if seen and seen[-1] != len(CONTENT):
                await self._fill()
            try:
                await self._scheduler.use_session(self._path, Opcode.OPEN_FILE_WO)
            except FtpNak:
                return len(CONTENT)
            size = await self._size()
            sure = size in seen or not self._scheduler.doubt.active
            if sure and size in (0, len(CONTENT)):
                self._traits.wo_truncates = size == 0
            if sure:
                break
            seen.append(size)
        return size

    async def _truncate(self, size: int | None) -> None:
        """PX4 on NuttX truncates through a copy that can destroy the file: its storage lies below /fs."""
        if self._path.startswith(b"/fs/"):
            self._traits.truncate_works = False
            return
        if size == 0:  # emptied by OpenFileWO: fill it again
            await self._fill()
        wire = wire_path(self._path)
        operation = Simple(Opcode.TRUNCATE_FILE, wire, offset=1, patience=SILENCE, server_time=0.5)
        try:
            await self._scheduler.metadata(operation)
        except FtpNak as nak:
            if nak.code in _UNKNOWN:
                self._traits.truncate_works = False
            return
        except RequestTimeout:
            if await self._size() is not None:
                self._traits.truncate_works = False
            return
        self._traits.truncate_works = await self._size() == 1

    async def _rename(self) -> list[bytes]:
        """To a free name, and then onto a file; return what is there afterwards."""
        try:
            await self._effects.rename(self._path, self._second)
        except FtpNak:
            self._traits.rename_works = False
            return [self._path]
        self._traits.rename_works = True
        if self._traits.rename_replaces is not None:
            return [self._second]
        await self._scheduler.use_session(self._path, Opcode.CREATE_FILE)
        try:
            await self._effects.rename(self._path, self._second)
        except FtpNak:
            self._traits.rename_replaces = False
            return [self._path, self._second]
        self._traits.rename_replaces = True
        return [self._second]

    async def _size(self) -> int | None:
        """Return the size of our temporary, by two requests however many files lie beside it."""
        try:
            return (await self._scheduler.use_session(self._path, Opcode.OPEN_FILE_RO)).size
        except FtpNak:
            return None
