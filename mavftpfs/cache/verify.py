"""Compares what is on the card with what was written (promise 2). Layer: cache.

The size always; the CRC32 where the content is wholly known here and the file is not too large. Leading
zeros do not change this CRC32 (servers.md 10), so it never stands alone. Silence or a refusal of the CRC32
counts as verified by size, is logged once and counted, unless verify=crc.

Of a file that was changed in place only a part is known here. verify=crc has that part read back from the
card and compared byte by byte; the rest was not sent, and is taken to be as it was. (Its CRC32 could be
worked out only from one the vehicle computed before, which would prove the same and cost two of them.)
"""

from __future__ import annotations

import logging

from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Draft
from mavftpfs.cache.readback import agrees
from mavftpfs.cache.sure import Sure
from mavftpfs.shared.errors import Armed, FtpNak, MavftpfsError, RequestTimeout, VerificationFailed
from mavftpfs.shared.model import split

log = logging.getLogger("mavftpfs.cache")

SMALL_LISTING = 5
"""A directory of so few names is listed in one request, which tells more than opening the file."""


class Verifier:
    """Counts, too: files verified by CRC32, by reading back, by size alone, and CRC32s not answered."""

    def __init__(self, context: Context, sure: Sure) -> None:
        self._context = context
        self._sure = sure
        self.by_crc = 0
        self.by_reading = 0
        self.by_size = 0
        self.unanswered = 0

    def status(self) -> dict[str, int]:
        """Return the counters."""
        return {
            "verified_by_crc": self.by_crc,
            "verified_by_reading": self.by_reading,
            "verified_by_size": self.by_size,
            "checksums_unanswered": self.unanswered,
        }

    async def check(self, path: bytes, draft: Draft) -> None:
        """Compare a file on the vehicle with a draft.

        Raises:
            VerificationFailed: it is another file. Else as WriteStore.stat_size.
        """
        if self._context.options.verify != "none":
            await self._check(path, draft, self._context.options.verify)

    async def check_doubted(self, path: bytes, draft: Draft) -> None:
        """Do the same for a file that may not be ours at all: verify=size and verify=none do not count.

        Raises:
            As check.
        """
        demanded = self._context.options.verify == "crc"
        await self._check(path, draft, "crc" if demanded else "auto")

    async def _check(self, path: bytes, draft: Draft, verify: str) -> None:
        size = await self.size(path)
        if size != draft.size:
            raise VerificationFailed(f"{path!r} has {size} bytes on the vehicle, {draft.size} were written")
        if verify == "crc" and not draft.whole:
            await self._require_changes(path, draft)
            self.by_reading += 1
        elif await self._crc_agrees(path, draft, verify):
            self.by_crc += 1
        else:
            self.by_size += 1

    async def size(self, path: bytes) -> int:
        """Return the size of a file on the vehicle, asked just now, whichever way is cheaper.

        Raises:
            As WriteStore.stat_size.
        """
        known = self._context.dentries.known(split(path)[0])
        if known is not None and len(known.entries) <= SMALL_LISTING:
            entry = await self._sure.entry(path)
            if entry is not None and entry.size is not None:
                return entry.size
        return await self._context.writer.stat_size(path)

    async def _crc_agrees(self, path: bytes, draft: Draft, verify: str) -> bool:
        """Return whether the CRC32 was compared.

        Raises:
            VerificationFailed: it differs, or was not answered though verify=crc.
        """
        demanded = verify == "crc"
        if verify == "size" or not draft.whole or draft.size == 0:
            return False
        if draft.size > self._context.options.verify_max and not demanded:
            return False
        try:
            remote = await self._context.store.crc32(path, size=draft.size)
        except (FtpNak, RequestTimeout, Armed) as error:
            self._note_unanswered(path, error, demanded=demanded)
            return False
        if remote != draft.crc32():
            raise VerificationFailed(f"the vehicle's checksum of {path!r} is not that of what was written")
        return True

    async def _require_changes(self, path: bytes, draft: Draft) -> None:
        """Read back what was changed.

        Raises:
            VerificationFailed: the card has other bytes. Else as readback.agrees.
        """
        context = self._context
        patience = context.options.op_deadline
        if not await agrees(context.store, path, draft.changed, draft.local_bytes, patience=patience):
            raise VerificationFailed(f"what was changed of {path!r} is not what the vehicle has there")

    def _note_unanswered(self, path: bytes, error: MavftpfsError, *, demanded: bool) -> None:
        if demanded:
            raise VerificationFailed(f"no checksum of {path!r}: {error}") from error
        if not isinstance(error, Armed):
            self.unanswered += 1
            log.warning("%r is verified by its size alone: %s", path, error)
