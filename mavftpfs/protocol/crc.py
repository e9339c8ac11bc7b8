"""CRC32 as CalcFileCRC32 defines it. Layer: protocol; pure."""

from __future__ import annotations

import zlib


def crc32(data: bytes | bytearray | memoryview, previous: int = 0) -> int:
    """Return the CRC32 of `data` continued from `previous` (0 at the start).

    Reflected polynomial 0xEDB88320, start value 0, no final xor, on every server (servers.md 10), so
    leading zero bytes do not change it: always compare sizes too.
    """
    return zlib.crc32(data, previous ^ 0xFFFFFFFF) ^ 0xFFFFFFFF
