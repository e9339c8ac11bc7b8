"""The calls of every open file. Layer: cache."""

from __future__ import annotations

from mavftpfs.shared.errors import LocalProtocolError


class OpenFile:
    """One open() of a file. Methods that are not overridden are those of a handle for reading."""

    @property
    def size(self) -> int:
        """Bytes. Follows the writes of all programs; the vehicle is asked when a program opens the file."""
        raise NotImplementedError

    @property
    def direct_io(self) -> bool:
        """Whether the kernel must not cache its pages."""
        return False

    @property
    def keep_cache(self) -> bool:
        """Whether pages that the kernel holds from the last open are still right."""
        return False

    @property
    def has_name(self) -> bool:
        """Whether the path that was opened is still the file's: others replaced it, it was removed, or a
        write of it failed, if not."""
        return True

    @property
    def writable(self) -> bool:
        """Whether write, truncate and flush do something. fsync may do something on any handle."""
        return False

    @property
    def verified(self) -> str:
        """The comparison of the vehicle's copy with the written bytes, in words; "" if nothing was sent."""
        return ""

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return `size` bytes at `offset`, fewer only at the end of the handle's size.

        Raises:
            FileChanged, DataUnproven, RequestTimeout, VehicleLost, FtpNak.
        """
        raise NotImplementedError

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """Take all of `data` and return its length; waits while too much is not on the vehicle yet.

        If the handle changed the file before, an error breaks the file: nothing of it reaches the card, and
        it loses its name.

        Raises:
            NoSpace, Armed, FileTooLarge, RequestTimeout: nothing was taken. WriteFailed: the file is broken.
        """
        raise LocalProtocolError("write to a handle opened for reading")

    async def truncate(self, size: int) -> None:
        """Cut or extend the file, locally; delivered like written bytes. An error breaks the file as that of
        a write does.

        Raises:
            NoSpace, Armed, RequestTimeout, WriteFailed.
        """
        raise LocalProtocolError("truncate of a handle opened for reading")

    async def flush(self) -> None:
        """Deliver what was written, because one descriptor was closed. A file that was only emptied waits.

        Raises:
            The reason why bytes are undelivered; as long as they are, at every call.
        """

    async def fsync(self, *, ends_write: bool = False) -> None:
        """Return when everything written is on the card, checked (promise 2). ends_write: a write waits for
        this (O_SYNC), so an error is one of the write.

        Raises:
            As flush.
        """

    async def release(self) -> None:
        """Deliver, and close in any case: the last descriptor was closed. A second call is harmless.

        Raises:
            As flush; changes that could not be delivered stay pending.
        """
        self.close()

    async def take_back(self) -> bool | None:
        """Close, and take back bytes that are not on the vehicle: none of them is sent from now on.

        Returns whether the vehicle has the file as it was written. None: that is not known, or another handle
        writes the same file, and delivers these bytes with its own.
        """
        self.close()
        return True

    def close(self) -> None:
        """Close without delivering; pending changes stay pending. Closing twice is harmless."""
        raise NotImplementedError
