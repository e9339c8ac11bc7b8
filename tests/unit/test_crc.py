"""CRC32 as MAVLink FTP defines it."""

from __future__ import annotations

from mavftpfs.protocol.crc import crc32


def test_check_value() -> None:
    assert crc32(b"123456789") == 0x2DFD2D88


def test_in_pieces_as_in_one() -> None:
    assert crc32(b"6789", crc32(b"12345")) == crc32(b"123456789")


def test_leading_zeros_do_not_show() -> None:
    assert crc32(bytes(1000)) == 0
    assert crc32(bytes(7) + b"abc") == crc32(b"abc")
