"""ArduPilot's virtual trees as simulated: what they list, claim, refuse and contain (servers.md 11)."""

from __future__ import annotations

import errno
import struct

from mavftpfs.protocol.payload import NakCode, Opcode, crc32
from mavftpfs.sim.parameters import Selection
from mavftpfs.sim.pseudo import VirtualTrees
from tests.support.sim_client import Client, ack, nak

PARAM = b"@PARAM/param.pck"
NOT_FOUND = bytes([NakCode.FILE_NOT_FOUND])


def test_sys_claims_100000_bytes_and_most_files_cannot_be_opened() -> None:
    c = Client("ardupilot")
    page = c.listing(b"@SYS")
    assert page == c.listing(b"/@SYS/")
    assert page.startswith(b"Fthreads.txt\t100000\0\0Ftasks.txt\t100000\0\0")
    assert page.endswith(b"Fstorage.bin\t16384\0\0")
    assert struct.unpack("<I", ack(c.open(b"@SYS/tasks.txt"))) == (100_000,)
    assert ack(c.ask(Opcode.READ_FILE, size=239)) == b"TasksV2\n"
    ack(c.ask(Opcode.TERMINATE_SESSION))
    assert nak(c.ask(Opcode.OPEN_FILE_RO, b"@SYS/threads.txt")) == NOT_FOUND
    assert nak(c.ask(Opcode.OPEN_FILE_RO, b"@SYS/none")) == NOT_FOUND
    assert nak(c.ask(Opcode.OPEN_FILE_WO, b"@SYS/tasks.txt")) == bytes([NakCode.FAIL_ERRNO, errno.EROFS])


def test_a_changed_block_size_is_einval_also_for_the_last_block() -> None:
    c = Client("ardupilot")
    c.open(PARAM, session=1)
    ack(c.ask(Opcode.READ_FILE, session=1, size=239))
    refused = c.ask(Opcode.READ_FILE, session=1, size=100, offset=239)
    assert nak(refused) == bytes([NakCode.FAIL_ERRNO, errno.EINVAL])
    refused = c.ask_all(Opcode.BURST_READ_FILE, session=1, size=80, offset=239)[0]
    assert nak(refused) == bytes([NakCode.FAIL_ERRNO, errno.EINVAL])
    ack(c.ask(Opcode.READ_FILE, session=1, size=239, offset=239))


def test_the_claimed_parameter_size_and_the_checksum_match_no_download() -> None:
    virtual = VirtualTrees()
    c = Client("ardupilot", virtual=virtual)
    claimed = struct.unpack("<I", ack(c.open(PARAM)))[0]
    assert claimed == 12 * len(virtual.table.visible(0))
    ack(c.ask(Opcode.TERMINATE_SESSION))
    checksum = struct.unpack("<I", ack(c.ask(Opcode.CALC_FILE_CRC32, PARAM)))[0]
    assert checksum == crc32(virtual.table.download(Selection(), 64, 0))
    assert checksum != crc32(virtual.table.download(Selection(), 239, 0))
