"""What the caches need of the vehicle. Layer: cache; declared here, implemented by session.store.

All paths are normalised mount paths (shared.model). All calls raise only MavftpfsError.
"""

from __future__ import annotations

from typing import Protocol

from mavftpfs.shared.model import Listing


class ReadSink(Protocol):
    """Where a reader's bytes go. All methods are synchronous and must not block."""

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the parts of [start, stop) not yet held."""
        ...

    def on_data(self, offset: int, data: bytes) -> None:
        """Take proven-by-protocol bytes; what is already held must not be overwritten."""
        ...

    def on_batch(self) -> None:
        """A batch of on_data calls ended: wake whoever waits. Called once per batch, never per packet."""
        ...

    def on_suspect(self, reason: str) -> None:
        """A session anomaly or a foreign FTP client was noticed while this file was read: all bytes
        that came since the reader was opened are provisional (promise 1)."""
        ...

    def on_failed(self, error: Exception) -> None:
        """What is wanted cannot be had; waiters get the error. The reader stays usable for later wants."""
        ...


class Reader(Protocol):
    """A remote file open for reading, as seen by the cache; survives reopening of the server's session."""

    @property
    def size(self) -> int:
        """Size in bytes by the (first) open ACK."""
        ...

    def want(self, start: int, stop: int, *, demand: bool) -> None:
        """Ask for bytes; returns at once. Wants add up, demand goes before readahead."""
        ...

    def drop_readahead(self) -> None:
        """Forget wants that nobody waits for (a seek, a release)."""
        ...

    def close(self) -> None:
        """No further wants. The server session is closed lazily by the scheduler."""
        ...


class RemoteStore(Protocol):
    """The vehicle's files."""

    async def list_directory(self, path: bytes) -> Listing:
        """Sweep a directory that is known to be one.

        Raises:
            FtpNak, RequestTimeout, VehicleLost, PathTooLong.
        """
        ...

    async def open_reader(self, path: bytes, sink: ReadSink, *, expected_size: int | None = None) -> Reader:
        """Open a regular file that is known to be one; `expected_size` avoids the open where it is already
        the current one. The sink is called from the session's tasks until Reader.close.

        Raises:
            FtpNak, RequestTimeout, VehicleLost, SessionBusy, PathTooLong.
        """
        ...

    async def read_whole(self, path: bytes, limit: int) -> bytes:
        """Read an `@` file to its end with one constant block size, whatever size it claims.

        Raises:
            DataUnproven: longer than `limit`. Else as open_reader.
        """
        ...

    async def crc32(self, path: bytes) -> int:
        """Ask the vehicle for a file's CRC32 (init 0, no final xor).

        Raises:
            Armed: not asked in flight. FtpNak, RequestTimeout, VehicleLost.
        """
        ...
