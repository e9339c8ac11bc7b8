"""The writing half of a handle that cannot write. Layer: cache."""

from __future__ import annotations

from mavftpfs.shared.errors import LocalProtocolError


class ReadOnlyHandle:
    """What cache.openfile.OpenFile asks of handles opened for reading: there is nothing to deliver."""

    writable = False

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """Raise LocalProtocolError: the kernel lets nobody write to a handle opened for reading."""
        raise LocalProtocolError("write to a handle opened for reading")

    async def truncate(self, size: int) -> None:
        """Raise LocalProtocolError."""
        raise LocalProtocolError("truncate of a handle opened for reading")

    async def flush(self) -> None:
        """Do nothing: what other handles failed to deliver is theirs to hear."""

    async def fsync(self) -> None:
        """Do nothing: of a file that others may write, this is not all (writefile)."""

    async def release(self) -> None:
        """Close the handle."""
        self.close()

    def give_up(self) -> None:
        """Close the handle: it made nothing."""
        self.close()

    def close(self) -> None:
        """Close the handle; closing twice is harmless."""
        raise NotImplementedError
