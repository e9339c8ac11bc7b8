"""Opens the file of an upload once more, so that it keeps what it has. Layer: session.

That takes several requests, and whoever waits by then would wait for all of them: between two of them the
upload gives way.
"""

from __future__ import annotations

import errno
from typing import NoReturn

from mavftpfs.protocol.payload import Opcode
from mavftpfs.session.kit import Kit, Queue
from mavftpfs.session.occupants import is_same
from mavftpfs.session.opening import OpenSession
from mavftpfs.session.upload import QueuedUpload
from mavftpfs.session.writing import Writer
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import FileChanged, FtpNak, SessionLost


class Reopening:
    """OpenFileWO, with all that has to be known before and after it."""

    def __init__(self, kit: Kit, queue: Queue, writer: Writer) -> None:
        self._kit = kit
        self._queue = queue
        self._writer = writer
        self._holder = kit.holder
        self._wo_tells_size = False

    async def find_out(self, upload: QueuedUpload) -> None:
        """Find out on a file of our own making what OpenFileWO does (servers.md 8): the size tells, asked
        afterwards, since the reply to OpenFileWO may say what it was before.

        Where requests come twice that is looked at twice: a late WriteFile fills a file that was emptied.
        """
        traits, reached = self._queue.write_traits, upload.feed.reached
        upload.tried = True
        await upload.outlast_copies()  # a late CreateFile empties it, too
        for _ in range(2):
            try:
                await self._holder.open(upload.path, Opcode.OPEN_FILE_WO)
                size = await self._size(upload)
            except FtpNak:
                return  # it is refused, or somebody removed the file: what is not seen stays unknown
            if size is None or size < reached:
                traits.wo_truncates = True if size == 0 else traits.wo_truncates
                return
            if not self._kit.engine.stats.strays:
                break
        traits.wo_truncates = False

    async def reopen(self, upload: QueuedUpload, least: int) -> OpenSession | None:
        """Open a file that is to keep what it has, unless it has less than `least` bytes: then what was to
        stay is gone, and what is written behind it would leave a hole; or if it is another one.

        None: it gave way to somebody; what was found out is found out anew next time.
        """
        if not await is_same(self._kit, upload):
            await self._part_with(upload, f"{upload.path!r} became another file while it was changed here")
        if self._writer.gives_way(upload):
            return None
        try:
            size = None
            if upload.opened and not self._wo_tells_size:
                size = await self._size(upload)
                if await self._gave_way(upload):
                    return None
            with self._kit.echoes.noted(upload.path, opens=True):
                session = await self._holder.open(upload.path, Opcode.OPEN_FILE_WO)
        except FtpNak as nak:
            if not upload.create or errno_for(nak) != errno.ENOENT:
                raise
            size, session = 0, None
        if session is not None:
            upload.opened, self._wo_tells_size = True, session.size is not None
            size = session.size if size is None else size
            if size is None or size >= least:
                return session
        await self._part_with(upload, f"{upload.path!r} has {size} bytes now, not {least}")

    async def _gave_way(self, upload: QueuedUpload) -> bool:
        """Whether somebody waits now that its size is known, or did when it was closed after that."""
        if not self._writer.gives_way(upload):
            await self._holder.close_quietly()
        return self._writer.gives_way(upload)

    async def _size(self, upload: QueuedUpload) -> int | None:
        """Return the size of the file, asked before OpenFileWO, which makes missing ones (servers.md 8)."""
        return await self._holder.size_of(upload.path)

    async def _part_with(self, upload: QueuedUpload, problem: str) -> NoReturn:
        upload.feed.roll_back(everything=True)
        await self._holder.close()
        if upload.create:
            raise SessionLost(problem, by_server=True)
        raise FileChanged(problem)
