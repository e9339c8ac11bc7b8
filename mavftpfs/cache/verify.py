"""Compares a file that was sent with what it should be (promise 2). Layer: cache.

The size always. The CRC32 up to verify_max, and in doubt whatever the size. Leading zeros do not change this
CRC32 (servers.md 10), so it never stands alone. Silence or a refusal counts as verified by size, is logged
once and counted; in doubt the file is read back instead, past every cache; verify=crc insists.
"""

from __future__ import annotations

import logging

import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Draft
from mavftpfs.cache.names import Names
from mavftpfs.cache.remote import Reader, ReadSink, RemoteStore
from mavftpfs.shared.errors import (
    Armed,
    FileChanged,
    FtpNak,
    RequestTimeout,
    SessionBusy,
    VerificationFailed,
)

log = logging.getLogger("mavftpfs.cache")

PIECE = 64 * 1024
"""Bytes that are read back at once."""

READ_TRIES = 3
"""How often a file is read back anew because another FTP client may have mixed up the bytes."""


class Verifier:
    """Counts, too: files verified by CRC32, by reading back, by size alone, and CRC32s not answered."""

    def __init__(self, context: Context, names: Names) -> None:
        self._context = context
        self._names = names
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

    async def check(self, path: bytes, draft: Draft, *, doubted: bool) -> int | None:
        """Compare a file on the vehicle with a whole draft; return its CRC32 if that was compared.

        doubted: what was sent may be elsewhere, or older: the size alone proves nothing.

        Raises:
            VerificationFailed: it is another file. SessionBusy: another client keeps it from being read
            back. Else as WriteStore.stat_size.
        """
        verify = self._context.options.verify
        if verify == "none" and not doubted:
            return None
        size = await self.size(path)
        if size != draft.size:
            raise VerificationFailed(f"{path!r} has {size} bytes on the vehicle, {draft.size} were written")
        if not size:
            return None
        if verify == "crc" or doubted or (verify == "auto" and size <= self._context.options.verify_max):
            crc32 = await self._check_crc32(path, draft, demanded=verify == "crc")
            if crc32 is not None:
                return crc32
        if doubted:
            await self._read_back(path, draft)
        else:
            self.by_size += 1
        return None

    async def size(self, path: bytes) -> int:
        """Return the size of a file on the vehicle, asked just now.

        Opening it needs the server's one session. That costs another upload all it sent where OpenFileWO
        empties files: there the directory is listed.

        Raises:
            As WriteStore.stat_size.
        """
        uploading = any(n.attempt is not None and n.attempt.path != path for n in self._context.nodes)
        if uploading and self._context.writer.traits.wo_truncates:
            entry = await self._names.ask(path)
            if entry is not None and entry.size is not None:
                return entry.size
        return await self._context.writer.stat_size(path)

    async def crc32(self, path: bytes, size: int) -> int | None:
        """Return the vehicle's CRC32 of a file of `size` bytes, None where it is not answered or too large.

        Raises:
            As RemoteStore.crc32, but FtpNak, RequestTimeout and Armed.
        """
        if size > self._context.options.verify_max or self._context.options.verify in ("size", "none"):
            return None
        try:
            return await self._context.store.crc32(path, size=size)
        except (FtpNak, RequestTimeout, Armed):
            return None

    # --- inside

    async def _check_crc32(self, path: bytes, draft: Draft, *, demanded: bool) -> int | None:
        """Return the CRC32 if it was compared.

        Raises:
            VerificationFailed: it differs, or was not answered though verify=crc. Armed: not asked for now.
        """
        try:
            remote = await self._context.store.crc32(path, size=draft.size)
        except (FtpNak, RequestTimeout, Armed) as error:
            self._note_unanswered(path, error, demanded=demanded)
            return None
        if remote != draft.crc32():
            raise VerificationFailed(f"the vehicle's checksum of {path!r} is not that of what was written")
        self.by_crc += 1
        return remote

    def _note_unanswered(self, path: bytes, error: Exception, *, demanded: bool) -> None:
        if demanded:
            self._context.require_disarmed()  # else it is asked for after the flight
            raise VerificationFailed(f"no checksum of {path!r}: {error}") from error
        if not isinstance(error, Armed):
            self.unanswered += 1
            log.warning("%r: its checksum was not told: %s", path, error)

    async def _read_back(self, path: bytes, draft: Draft) -> None:
        """Compare byte by byte.

        Raises:
            VerificationFailed: the card has other bytes. SessionBusy: another client was active each time.
            Else as RemoteStore.open_reader.
        """
        for _ in range(READ_TRIES):
            sink = _Piece(self._context.options.op_deadline)
            try:
                same = await _compare(self._context.store, path, sink, draft)
            except FileChanged:
                same = False
            if not sink.suspect:
                break
        else:
            raise SessionBusy(f"another FTP client was active whenever {path!r} was read back")
        if not same:
            raise VerificationFailed(f"{path!r} does not hold on the vehicle what was written")
        self.by_reading += 1


async def _compare(store: RemoteStore, path: bytes, sink: _Piece, draft: Draft) -> bool:
    reader = await store.open_reader(path, sink)
    try:
        if reader.size != draft.size:
            return False
        for at in range(0, draft.size, PIECE):
            stop = min(at + PIECE, draft.size)
            if await sink.take(reader, at, stop) != draft.local_bytes(at, stop):
                return False
    finally:
        reader.close()
    return True


async def read_small(store: RemoteStore, path: bytes, limit: int, *, patience: float) -> bytes:
    """Return the first bytes of a file, at most `limit`, past every cache.

    patience: seconds without any byte after which it is given up.

    Raises:
        RequestTimeout. Else as RemoteStore.open_reader.
    """
    sink = _Piece(patience)
    reader = await store.open_reader(path, sink)
    try:
        return await sink.take(reader, 0, min(reader.size, limit))
    finally:
        reader.close()


class _Piece(ReadSink):
    """Takes one range of a file after the other.

    Attributes:
        suspect: the bytes may be another file's.
    """

    def __init__(self, patience: float) -> None:
        self.suspect = False
        self._patience = patience
        self._start = 0
        self._data = bytearray()
        self._gaps: list[tuple[int, int]] = []
        self._error: Exception | None = None
        self._news = trio.Event()

    async def take(self, reader: Reader, start: int, stop: int) -> bytes:
        """Return the bytes [start, stop).

        Raises:
            RequestTimeout, or why they cannot be had.
        """
        self._start, self._data = start, bytearray(stop - start)
        self._gaps = [(start, stop)] if start < stop else []
        if self._gaps:
            reader.want(start, stop, demand=True)
        while self._gaps and self._error is None:
            self._news = trio.Event()
            with trio.move_on_after(self._patience) as scope:
                await self._news.wait()
            if scope.cancelled_caught:
                raise RequestTimeout("nothing of what was written could be read back")
        if self._error is not None:
            raise self._error
        return bytes(self._data)

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """See ReadSink: only the present range is wanted."""
        cut = [(max(start, a), min(stop, b)) for a, b in self._gaps]
        return [(a, b) for a, b in cut if a < b]

    def on_opened(self, at: float) -> None:
        """See ReadSink: another file would not compare."""

    def on_data(self, offset: int, data: bytes) -> None:
        """See ReadSink."""
        end = offset + len(data)
        for a, b in self.missing(offset, end):
            self._data[a - self._start : b - self._start] = data[a - offset : b - offset]
        left = [piece for a, b in self._gaps for piece in ((a, min(b, offset)), (max(a, end), b))]
        self._gaps = [(a, b) for a, b in left if a < b]

    def on_batch(self) -> None:
        """See ReadSink."""
        self._news.set()

    def on_queued(self) -> None:
        """See ReadSink."""
        self._news.set()

    def on_suspect(self, reason: str) -> None:
        """See ReadSink."""
        self.suspect = True

    def on_failed(self, error: Exception) -> None:
        """See ReadSink."""
        self._error = error
        self._news.set()
