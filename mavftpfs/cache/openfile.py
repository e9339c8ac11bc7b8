"""What an open() of a file offers, whatever kind of file it is. Layer: cache."""

from __future__ import annotations

from typing import Protocol

from mavftpfs.shared.errors import LocalProtocolError


class OpenFile(Protocol):
    """One open() of a file.

    size: bytes; of a file being written it follows what was written, else it is fixed for the life of the
    handle. direct_io: the kernel must not cache its pages. keep_cache: pages the kernel holds from the last
    open are still right. writable: write, truncate and flush do something; fsync may, of any handle.
    """

    @property
    def size(self) -> int: ...

    @property
    def direct_io(self) -> bool: ...

    @property
    def keep_cache(self) -> bool: ...

    @property
    def writable(self) -> bool: ...

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return `size` bytes at `offset`, fewer only at the end of the handle's size.

        Raises:
            FileChanged, DataUnproven, RequestTimeout, VehicleLost, FtpNak.
        """
        ...

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """Take all of `data` and return its length; waits while too much is not on the vehicle yet.

        Raises:
            NoSpace, Armed, FileTooLarge, RequestTimeout: nothing was taken.
        """
        ...

    async def truncate(self, size: int) -> None:
        """Cut or extend the file, locally; delivered like written bytes.

        Raises:
            NoSpace, Armed, RequestTimeout.
        """
        ...

    async def flush(self) -> None:
        """One descriptor was closed: deliver what was written, unless that is nothing but an emptied file.

        Raises:
            The reason why bytes are still undelivered; as long as they are, at every call.
        """
        ...

    async def fsync(self) -> None:
        """Return when everything written is on the card, checked (promise 2).

        Raises:
            As flush.
        """
        ...

    async def release(self) -> None:
        """The last descriptor was closed: deliver, and close whatever came of it. Twice is harmless.

        Raises:
            As flush; what could not be delivered is kept.
        """
        ...

    def give_up(self) -> None:
        """Close; the call that opened it failed, so a file that was made by that is not wanted either."""
        ...

    def close(self) -> None:
        """Close without delivering (what was not delivered is kept and delivered later)."""
        ...


class ReadOnlyHandle:
    """The writing half of a handle that cannot write: there is nothing to deliver."""

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
