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

from mavftpfs.cache.card import Card
from mavftpfs.cache.file import File
from mavftpfs.shared.errors import Armed, FtpNak, NotVerified, RequestTimeout, VerificationFailed
from mavftpfs.shared.sameness import Known, Listed, Opened, Sameness, Summed, compare

log = logging.getLogger("mavftpfs.cache")


async def check(card: Card, path: bytes, file: File, *, doubted: bool) -> int | None:
    """Compare what the vehicle has at a path with a whole file; return its CRC32 if that was compared.

    doubted: the vehicle may have other bytes than the ACKs say, so the size alone proves nothing.

    Raises:
        VerificationFailed: the vehicle has another file or none.
        NotVerified: doubted, and the vehicle told no CRC32. Armed: none is asked for in flight, and it is
        doubted, or nothing may be changed now. Otherwise as VehicleStore.stat_size.
    """
    crc32, why = None, None
    if file.size and (doubted or file.size <= card.options.verify_max):
        try:
            crc32 = await card.store.crc32(path, size=file.size)
        except (FtpNak, RequestTimeout, Armed) as error:
            card.require_disarmed()  # it is asked for after the flight
            why = error
            if not isinstance(error, Armed):
                card.counts["checksums_unanswered"] += 1
                log.warning("%r: its checksum was not told: %s", path, error)
    if crc32 is not None and crc32 != file.crc32():
        raise VerificationFailed(f"the vehicle's checksum of {path!r} is not that of what was written")
    if not crc32:
        size = await card.names.size(path)
        if size is None:
            raise VerificationFailed(f"{path!r} is gone from the vehicle")
        if size != file.size:
            raise VerificationFailed(f"{path!r} has {size} bytes there, {file.size} were written")
    file.verified = "size" if crc32 is None else "size and CRC32"
    if crc32 is not None:
        card.counts["verified_by_crc"] += 1
    elif doubted and why is not None:
        if isinstance(why, FtpNak):
            raise NotVerified(f"{path!r} is in doubt, and the vehicle told no checksum: {why}") from why
        raise why
    else:
        card.counts["verified_by_size"] += 1
    return crc32


async def is_same(card: Card, path: bytes, base: Known) -> bool:
    """Return whether a file on the vehicle is still the base.

    Raises:
        As VehicleStore.stat_size and Directories.ask_entry.
    """
    timed = card.directories.tells_times or base.mtime is not None
    if timed:
        entry = await card.directories.ask_entry(path)
        if compare(base, Listed(entry)) in (Sameness.OTHER, Sameness.GREW):
            return False
    if base.crc32 is not None and base.size <= card.options.verify_max:
        with suppress(FtpNak, RequestTimeout, Armed):
            told = Summed(await card.store.crc32(path, size=base.size))
            answer = compare(base, told)
            if answer is not Sameness.UNDECIDED:
                return answer is Sameness.SAME
    if timed:
        return True
    size = await card.names.size(path)
    return size is not None and compare(base, Opened(size)) is Sameness.SAME
