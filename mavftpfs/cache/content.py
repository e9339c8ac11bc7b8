"""The one content of a file: which of its bytes are here, and where. Layer: cache.

Each byte below `size` is one of two:
- *held*: a program wrote it, or it was fetched beside written bytes, or it is a zero of a gap before a write
  beyond the old end; the local spool file has it;
- *base*: not held: it is the vehicle's, and in memory (`blocks`) if it was read.

A file that nobody changed holds nothing: all of it is base. A file that is sent to the vehicle is *whole*:
no byte of it is base. After the delivery the spool file serves reads until the last program closes the file.
"""

from __future__ import annotations

from mavftpfs.cache.blocks import Blocks
from mavftpfs.cache.spool import Spool, SpoolContent
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared.extents import ExtentSet

STEP = 64 * 1024
"""Bytes read from the spool at once for a checksum."""


class Content:
    """The bytes of one file.

    Attributes:
        blocks: what was read of the vehicle's file.
        size: bytes, as programs see it.
        keeps_base: whether the content starts from the vehicle's file, so that a delivery replaces only that.
            False for a file that a program made or emptied.
        spooled: the local file; None while nobody changed the file.
        summed: how many bytes of the base went into a checksum so far, from its beginning, and their CRC32.
    """

    def __init__(self, blocks: Blocks) -> None:
        self.blocks = blocks
        self.size = 0
        self.keeps_base = False
        self.spooled: SpoolContent | None = None
        self.summed = 0, 0

    # --- what it is

    @property
    def held(self) -> ExtentSet:
        """The extents that the spool has."""
        return ExtentSet() if self.spooled is None else self.spooled.held

    @property
    def whole(self) -> bool:
        """Whether no byte of it is the vehicle's."""
        return self.held.covers(0, self.size)

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the parts of [start, stop) of which only the vehicle has the bytes, ascending."""
        return self.held.missing(start, min(stop, self.size))

    def get(self, start: int, stop: int) -> bytes:
        """Return [start, stop), cut at the file's size, no byte of which may be the base's.

        Raises:
            SpoolFailed.
        """
        assert self.spooled is not None
        stop = min(stop, self.size)
        assert self.spooled.held.covers(start, stop)
        return self.spooled.get(start, stop) if start < stop else b""

    def crc32(self, stop: int | None = None) -> int:
        """Return the CRC32 of whole content, or of [0, stop), as the vehicle computes it (servers.md 10).

        Raises:
            SpoolFailed.
        """
        value, stop = 0, self.size if stop is None else stop
        for at in range(0, stop, STEP):
            value = crc32(self.get(at, min(at + STEP, stop)), value)
        return value

    # --- what the vehicle has

    def on_opened(self, size: int) -> None:
        """Note how large the vehicle's file is; bytes of a file with another size are forgotten."""
        if size != self.blocks.size:
            self.blocks.drop()
            self.blocks.size = size
        if self.spooled is None:
            self.size, self.keeps_base = size, size > 0

    # --- what programs do

    def spool(self, spool: Spool, name: bytes) -> SpoolContent:
        """Keep changes in a local file from now on; nothing is written yet."""
        if self.spooled is None:
            self.spooled = SpoolContent(spool, name)
        return self.spooled

    def write(self, offset: int, data: bytes | memoryview) -> None:
        """Replace bytes; a gap behind the present end becomes zeros.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        assert self.spooled is not None
        self.spooled.put(offset, data, zeros=max(0, offset - self.size))
        self.size = max(self.size, offset + len(data))

    def truncate(self, size: int) -> None:
        """Cut, or extend with zeros.

        Raises:
            NoSpace, SpoolFailed: nothing changed.
        """
        assert self.spooled is not None
        if size < self.size:
            self.spooled.cut(size)
        elif size > self.size:
            self.spooled.put(size, b"", zeros=size - self.size)
        self.size, self.keeps_base = size, self.keeps_base and size > 0

    def sum_up(self, data: bytes | memoryview) -> None:
        """Note the next bytes of the base for its checksum."""
        at, value = self.summed
        self.summed = at + len(data), crc32(data, value)

    def fill(self, offset: int, data: bytes | memoryview) -> None:
        """Hold bytes of the base, where nothing newer is held.

        Raises:
            NoSpace, SpoolFailed.
        """
        assert self.spooled is not None
        for start, stop in self.missing(offset, offset + len(data)):
            self.spooled.put(start, memoryview(data)[start - offset : stop - offset])

    # --- its end

    def on_committed(self, size: int) -> None:
        """Note that the vehicle has `size` bytes of this file: what changed since lies over them."""
        self.keeps_base, self.summed = min(size, self.size) > 0, (0, 0)

    def on_delivered(self) -> None:
        """Note that the vehicle has all of these bytes."""
        assert self.spooled is not None
        self.on_committed(self.size)
        self.spooled.mark_unneeded()

    def on_unneeded(self) -> None:
        """Note that no vehicle is to get these bytes: the file lost its name."""
        if self.spooled is not None:
            self.spooled.name = None
            self.spooled.mark_unneeded()

    def forget(self) -> None:
        """Forget every byte."""
        self.blocks.drop()
        if self.spooled is not None:
            self.spooled.close()
        self.spooled, self.summed = None, (0, 0)

    def check_invariants(self) -> None:
        """Raise AssertionError if the books are wrong (for tests)."""
        assert self.held.end <= self.size
        assert self.keeps_base or self.whole
        assert self.size or not self.keeps_base
