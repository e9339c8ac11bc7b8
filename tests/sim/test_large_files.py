"""Files beyond 2 GiB through caches and session: right bytes or an error. Virtual time."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from struct import pack

import pytest

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.shared.errors import FtpNak
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.tree import DEFAULT_MTIME, Entry, Kind, MemoryTree, Stat, TreeFile
from tests.support.rigs import rig

GIB = 1 << 30
SIZE = 4 * GIB - 5
"""The largest sizes that fit the 32 bits of an open's reply."""

STAT = Stat(Kind.FILE, SIZE, DEFAULT_MTIME)
WIDTH = 8
READS = (
    (0, 1000),
    (2 * GIB - 3000, 1000),
    (2 * GIB - 300, 777),
    (2 * GIB, 1000),
    (3 * GIB + 1, 5),
    (SIZE - 1000, 1000),
    (SIZE - 3, 100),
)
"""(offset, count) in no order of use: far jumps, both sides of the sign bit and the end."""


def expected(offset: int, count: int) -> bytes:
    """Return what the huge file holds there: each eight bytes say where they are."""
    stop = min(offset + count, SIZE)
    first = offset // WIDTH
    words = b"".join(pack(">Q", word * 0x9E3779B1) for word in range(first, stop // WIDTH + 1))
    return words[offset - first * WIDTH : stop - first * WIDTH]


class HugeFile:
    """An open file that is computed, not stored; implements TreeFile for reading."""

    def read(self, offset: int, size: int) -> bytes:
        return expected(offset, size) if offset < SIZE else b""

    def write(self, offset: int, data: bytes) -> int:
        raise AssertionError("nobody writes here")

    def size(self) -> int:
        return SIZE

    def resize(self, size: int) -> None:
        raise AssertionError("nobody writes here")

    def close(self) -> None:
        pass


class HugeTree(MemoryTree):
    """Every file is of nearly 4 GiB."""

    def entries(self, path: bytes) -> list[Entry]:
        return [
            entry if entry.stat.kind is Kind.DIRECTORY else Entry(entry.name, STAT)
            for entry in super().entries(path)
        ]

    def stat(self, path: bytes) -> Stat:
        found = super().stat(path)
        return found if found.kind is Kind.DIRECTORY else STAT

    def open(
        self, path: bytes, *, write: bool = False, create: bool = False, truncate: bool = False
    ) -> TreeFile:
        return super().open(path, write=True, create=True) if write else HugeFile()


@asynccontextmanager
async def huge(profile: str) -> AsyncIterator[OpenFile]:
    """Open such a file."""
    path = b"/d/huge"
    async with rig(profile, {path: b""}, link=LinkSettings(delay=0.01), card=HugeTree()) as here:
        tree = here.mount(cache_size=1 << 20)
        assert (await tree.stat(path)).size == SIZE
        file = await tree.open(path)
        assert file.size == SIZE
        yield file
        await file.release()


@pytest.mark.holds("rule 14.27")
@pytest.mark.parametrize(
    ("profile", "reach"),
    [("px4", SIZE), ("px4-nuttx", SIZE), ("mavsdk", SIZE), ("ardupilot", 2 * GIB), ("ardupilot5", 2 * GIB)],
)
async def test_any_place_of_a_huge_file_can_be_read_or_is_an_error(profile: str, reach: int) -> None:
    """ArduPilot's offsets are signed 32 bits (AP_Filesystem::lseek)."""
    async with huge(profile) as file:
        for offset, count in READS:
            if reach == SIZE or offset + count <= reach:
                assert bytes(await file.read(offset, count)) == expected(offset, count)
            else:
                with pytest.raises(FtpNak):
                    await file.read(offset, count)
        assert bytes(await file.read(SIZE, 10)) == b""
        assert bytes(await file.read(4096, 1000)) == expected(4096, 1000)
