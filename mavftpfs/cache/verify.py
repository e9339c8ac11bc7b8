"""Compares a file that was sent with what it should be (promise 2). Layer: cache.

Files up to verify_max are compared by the vehicle's CRC32; in doubt, files of any size.
A CRC32 covers the whole file, so the right one proves the size, too. Only zeros at the beginning of a file do
not change it (servers.md 10): a file of nothing but zeros has the CRC32 0. So if it is 0, or if the vehicle
told none, the file is opened to learn its size. A file without a CRC32 counts as verified by size; that is
logged and counted. In doubt it is an error, and the delivery that is tried again compares the file.
"""

from __future__ import annotations

import logging
from contextlib import suppress

from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Draft
from mavftpfs.cache.names import Names
from mavftpfs.shared.errors import Armed, FtpNak, NotVerified, RequestTimeout, VerificationFailed
from mavftpfs.shared.sameness import Known, Listed, Opened, Sameness, Summed, compare

log = logging.getLogger("mavftpfs.cache")


class Verifier:
    """Compares files. Counts for status: comparisons by CRC32 and by size alone, and requests for a CRC32
    that were not answered."""

    def __init__(self, context: Context, names: Names) -> None:
        self._context = context
        self._names = names
        self.counts = {
            "verified_by_crc": 0,
            "verified_by_size": 0,
            "checksums_unanswered": 0,
        }

    async def check(self, path: bytes, draft: Draft, *, doubted: bool) -> int | None:
        """Compare a file on the vehicle with a whole draft; return its CRC32 if that was compared.

        doubted: the file may have other bytes than the ACKs say, so the size alone proves nothing.

        Raises:
            VerificationFailed: the vehicle has another file or none.
            NotVerified: doubted, and the vehicle told no CRC32. Armed: none is asked for in flight, and it is
            doubted, or nothing may be changed now. Else as VehicleStore.stat_size.
        """
        crc32, why = None, None
        if draft.size and (doubted or draft.size <= self._context.options.verify_max):
            try:
                crc32 = await self._context.store.crc32(path, size=draft.size)
            except (FtpNak, RequestTimeout, Armed) as error:
                self._context.require_disarmed()  # it is asked for after the flight
                why = error
                if not isinstance(error, Armed):
                    self.counts["checksums_unanswered"] += 1
                    log.warning("%r: its checksum was not told: %s", path, error)
        if crc32 is not None and crc32 != draft.crc32():
            raise VerificationFailed(f"the vehicle's checksum of {path!r} is not that of what was written")
        if not crc32:
            size = await self._names.size(path)
            if size is None:
                raise VerificationFailed(f"{path!r} is not there any more")
            if size != draft.size:
                raise VerificationFailed(f"{path!r} has {size} bytes there, {draft.size} were written")
        draft.verified = "size" if crc32 is None else "size and CRC32"
        if crc32 is not None:
            self.counts["verified_by_crc"] += 1
        elif doubted and why is not None:
            if isinstance(why, FtpNak):
                raise NotVerified(f"{path!r} is in doubt, and the vehicle told no checksum: {why}") from why
            raise why
        else:
            self.counts["verified_by_size"] += 1
        return crc32

    async def is_same(self, path: bytes, base: Known) -> bool:
        """Return whether a file on the vehicle is still the base.

        Raises:
            As VehicleStore.stat_size and Directories.ask_entry.
        """
        context = self._context
        timed = context.directories.tells_times or base.mtime is not None
        if timed:
            entry = await context.directories.ask_entry(path)
            if compare(base, Listed(entry)) in (Sameness.OTHER, Sameness.GREW):
                return False
        if base.crc32 is not None and base.size <= context.options.verify_max:
            with suppress(FtpNak, RequestTimeout, Armed):
                told = Summed(await context.store.crc32(path, size=base.size))
                answer = compare(base, told)
                if answer is not Sameness.UNDECIDED:
                    return answer is Sameness.SAME
        if timed:
            return True
        size = await self._names.size(path)
        return size is not None and compare(base, Opened(size)) is Sameness.SAME
