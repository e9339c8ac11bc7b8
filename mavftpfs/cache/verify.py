"""Compares what is on the card with what was written (promise 2). Layer: cache.

The size always; the CRC32 where the content is wholly known here and the file is not too large. Leading
zeros do not change this CRC32 (servers.md 10), so it never stands alone. Silence or a refusal of the CRC32
counts as verified by size, is logged once and counted, unless verify=crc.

What is in doubt (`doubted`) is compared whatever verify= says: the size does not show it.

Of a file that was changed in place only a part is known here. verify=crc has that part read back from the
card and compared byte by byte; the rest was not sent, and is taken to be as it was. (Its CRC32 could be
worked out only from one the vehicle computed before, which would prove the same and cost two of them.)
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Draft
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.overwritten import overwritten
from mavftpfs.cache.readback import agrees
from mavftpfs.cache.remote import Upload
from mavftpfs.cache.sure import Sure
from mavftpfs.shared.errors import (
    Armed,
    DataUnproven,
    FtpNak,
    MavftpfsError,
    RequestTimeout,
    SessionBusy,
    VerificationFailed,
)
from mavftpfs.shared.model import split

log = logging.getLogger("mavftpfs.cache")

SMALL_LISTING = 5
"""A directory of so few names is listed in one request, which tells more than opening the file, if what lies
above it was listed lately: after a long upload it was not, and each part of its path is a round trip."""

LARGE_LISTING = 50
"""A directory of more names is not listed for each of many files that are written at once: that takes time by
the square of their number. Opening the first instead may interrupt an upload, and tells what that costs."""

QUICKLY_READ = 64 * 1024
"""Of so much every vehicle computes the CRC32 so fast that nothing waits long behind it."""

CHECKS = 8
"""How often a file is compared because answers to requests of others go on coming."""

FEW_BYTES = 64 * 1024
"""So much is read back rather than have the vehicle compute the CRC32 of the whole file."""


def doubted(upload: Upload, draft: Draft) -> list[tuple[int, int]]:
    """Return of what was sent the ranges that the vehicle may not have though they were ACKed.

    Raises:
        DataUnproven: of some of them nobody knows what they should be.
    """
    sending = draft.sending
    if sending is None:
        return []
    found = overwritten(upload, draft)
    if upload.shared:
        found += [(0, draft.size)] if sending.whole else draft.changed
    elif upload.repeats:
        found += sending.rewritten
        for start, stop in [] if sending.whole else upload.again:
            found += draft.changed.intersection(start, stop)
    return found


def _writes(node: Node, path: bytes) -> bool:
    """Return whether a path is that of a node's file, or of what is sent to become it."""
    return node.path == path or (node.attempt is not None and node.attempt.path == path)


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

    async def check(self, path: bytes, draft: Draft, doubted: Sequence[tuple[int, int]] = ()) -> None:
        """Compare a file on the vehicle with a draft, and what is doubted of it byte by byte.

        Raises:
            VerificationFailed: it is another file. SessionBusy: another client keeps it from being read
            back. Else as WriteStore.stat_size.
        """
        verify = self._context.options.verify
        compared = verify != "none" and await self._check(path, draft, verify)
        if doubted and verify == "none" and await self.size(path) != draft.size:
            raise VerificationFailed(f"{path!r} has not the {draft.size} bytes that were written")
        if doubted and not compared:
            await self._dispel(path, draft, doubted)

    async def check_sent(self, path: bytes, draft: Draft, upload: Upload, told: int = -1) -> int:
        """Do the same for what an upload sent; anew if answers tell meanwhile that more of it may be hit.

        told: how many of these were heeded before; returned is how many are by now.

        Raises:
            As check and doubted.
        """
        for _ in range(CHECKS):
            if told == len(upload.overwrites):
                return told
            told = len(upload.overwrites)
            await self.check(path, draft, doubted(upload, draft))
        raise VerificationFailed(f"requests of other files hit {path!r} again and again")

    async def check_replaced(self, path: bytes, draft: Draft, upload: Upload, told: int) -> None:
        """Do the same for a file that got its name after it was checked, if it may have been hit since.

        Raises:
            As check_sent.
        """
        try:
            await self.check_sent(path, draft, upload, told)
        except VerificationFailed:
            draft.remote_removed()  # the old file is gone, and nothing of what is there counts
            raise

    async def check_doubted(self, path: bytes, draft: Draft) -> None:
        """Do the same for a file that may not be ours at all: verify=size and verify=none do not count.

        Raises:
            As check.
        """
        demanded = self._context.options.verify == "crc"
        await self._check(path, draft, "crc" if demanded else "auto")

    async def _check(self, path: bytes, draft: Draft, verify: str) -> bool:
        """Return whether what was sent was compared, not only the size."""
        if verify == "crc" and not draft.whole:
            await self._require_size(path, draft)
            await self._require(path, draft, list(draft.changed))
            return True
        if draft.size <= QUICKLY_READ:
            agreed = await self._both(path, draft, verify)
        else:
            await self._require_size(path, draft)
            agreed = await self._crc_agrees(path, draft, verify)
        self.by_size += not agreed
        return agreed

    async def _require_size(self, path: bytes, draft: Draft) -> None:
        size = await self.size(path)
        if size != draft.size:
            raise VerificationFailed(f"{path!r} has {size} bytes on the vehicle, {draft.size} were written")

    async def _both(self, path: bytes, draft: Draft, verify: str) -> bool:
        """Ask for size and CRC32 of a small file at once, which saves a round trip; the size counts first."""
        errors: list[MavftpfsError | None] = [None, None]
        agreed = False

        async def ask_size() -> None:
            try:
                await self._require_size(path, draft)
            except MavftpfsError as error:
                errors[0] = error
                nursery.cancel_scope.cancel()

        async with trio.open_nursery() as nursery:
            nursery.start_soon(ask_size)
            try:
                agreed = await self._crc_agrees(path, draft, verify)
            except MavftpfsError as error:
                errors[1] = error
        for failure in errors:
            if failure is not None:
                raise failure
        return agreed

    async def _dispel(self, path: bytes, draft: Draft, doubted: Sequence[tuple[int, int]]) -> None:
        """Have the vehicle compute a CRC32 of more than is quickly read back."""
        much = sum(stop - start for start, stop in doubted) > FEW_BYTES
        if much and draft.whole and await self._crc_agrees(path, draft, "auto", limited=False):
            return
        try:
            await self._require(path, draft, doubted)
        except DataUnproven as error:
            raise SessionBusy(f"{path!r} cannot be verified: {error}") from error

    async def size(self, path: bytes) -> int:
        """Return the size of a file on the vehicle, asked just now, whichever way is cheaper.

        Raises:
            As WriteStore.stat_size.
        """
        if self._is_listed_sooner(path):
            entry = await self._sure.entry(path)
            if entry is not None and entry.size is not None:
                return entry.size
        return await self._context.writer.stat_size(path)

    def _is_listed_sooner(self, path: bytes) -> bool:
        """Return whether to list a directory rather than open a file in it, which needs the one session: who
        writes another file has to give it up for that, or keeps it to its end where he cannot."""
        context = self._context
        directory = split(path)[0]
        known = context.dentries.known(directory)
        names = len(known.entries) if known is not None else 0
        small = known is not None and names <= SMALL_LISTING
        if any(node.undelivered and not _writes(node, path) for node in context.nodes):
            truncates = context.writer.traits.wo_truncates
            return small or truncates is True or (truncates is None and names <= LARGE_LISTING)
        return small and context.directories.in_reach(directory)

    async def _crc_agrees(self, path: bytes, draft: Draft, verify: str, *, limited: bool = True) -> bool:
        """Return whether the CRC32 was compared.

        Raises:
            VerificationFailed: it differs, or was not answered though verify=crc. Armed: not asked for now.
        """
        demanded = verify == "crc"
        if verify == "size" or not draft.whole or draft.size == 0:
            return False
        if limited and draft.size > self._context.options.verify_max and not demanded:
            return False
        try:
            remote = await self._context.store.crc32(path, size=draft.size)
        except (FtpNak, RequestTimeout, Armed) as error:
            self._note_unanswered(path, error, demanded=demanded)
            return False
        if remote != draft.crc32():
            raise VerificationFailed(f"the vehicle's checksum of {path!r} is not that of what was written")
        self.by_crc += 1
        return True

    async def _require(self, path: bytes, draft: Draft, extents: Sequence[tuple[int, int]]) -> None:
        """Read back what was written.

        Raises:
            VerificationFailed: the card has other bytes. Else as readback.agrees.
        """
        context = self._context
        patience = context.options.op_deadline
        if not await agrees(context.store, path, extents, draft.local_bytes, patience=patience):
            raise VerificationFailed(f"what was changed of {path!r} is not what the vehicle has there")
        self.by_reading += 1

    def _note_unanswered(self, path: bytes, error: MavftpfsError, *, demanded: bool) -> None:
        if demanded:
            self._context.require_disarmed()  # else it is asked for after the flight
            raise VerificationFailed(f"no checksum of {path!r}: {error}") from error
        if not isinstance(error, Armed):
            self.unanswered += 1
            log.warning("%r is verified by its size alone: %s", path, error)
