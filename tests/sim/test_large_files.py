"""Files beyond 2 GiB through caches and session: right bytes or an error. Virtual time."""

from __future__ import annotations

import errno
from collections.abc import Iterable
from struct import pack

import pytest

from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.shared.errors import FtpNak
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.replies import ack, nak
from tests.support.rigs import rig

GIB = 1 << 30
SIZE = 4 * GIB - 5
"""The largest sizes that fit the 32 bits of an open's reply."""

HUGE = b"/d/huge"
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


@pytest.mark.holds("rule 14.27")
@pytest.mark.parametrize(
    ("profile", "reach"), [("px4", SIZE), ("px4-nuttx", SIZE), ("mavsdk", SIZE), ("ardupilot5", 2 * GIB)]
)
async def test_any_place_of_a_huge_file_can_be_read_or_is_an_error(profile: str, reach: int) -> None:
    """reach: ArduPilot's offsets are signed 32 bits (AP_Filesystem::lseek)."""

    def change(request: Payload, reply: Payload) -> Iterable[Payload]:
        if request.opcode in (Opcode.LIST_DIRECTORY, Opcode.LIST_DIRECTORY_WITH_TIME):
            listed = reply.data.replace(b"Fhuge\t0", b"Fhuge\t%d" % SIZE)
            return [reply._replace(data=listed, size=len(listed))]
        if request.opcode == Opcode.OPEN_FILE_RO:
            return [reply._replace(data=SIZE.to_bytes(4, "little"))]
        if request.opcode != Opcode.READ_FILE:
            return [reply]
        if request.offset + request.size > reach < SIZE:
            return [nak(request, NakCode.FAIL_ERRNO, errno.EINVAL)]
        return [ack(request, expected(request.offset, request.size))]

    async with rig(profile, {HUGE: b""}, link=LinkSettings(delay=0.01)) as here:
        here.server.change = change
        tree = here.mount(cache_size=1 << 20)
        assert (await tree.stat(HUGE)).size == SIZE
        file = await tree.open(HUGE)
        assert file.size == SIZE
        for offset, count in READS:
            if reach == SIZE or offset + count <= reach:
                assert bytes(await file.read(offset, count)) == expected(offset, count)
            else:
                with pytest.raises(FtpNak):
                    await file.read(offset, count)
        assert bytes(await file.read(SIZE, 10)) == b""
        assert bytes(await file.read(4096, 1000)) == expected(4096, 1000)
        await file.release()
