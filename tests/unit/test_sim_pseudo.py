"""Oddities of ArduPilot's virtual trees as simulated (servers.md 11); the recording has what they list."""

from __future__ import annotations

import errno

from mavftpfs.protocol.payload import NakCode, Opcode, crc32
from mavftpfs.sim.pseudo import VirtualTrees
from tests.support.sim_client import Client, ack, nak

PARAM = b"@PARAM/param.pck"


def test_sys_cannot_be_written() -> None:
    refused = Client("ardupilot").ask(Opcode.OPEN_FILE_WO, b"@SYS/tasks.txt")
    assert nak(refused) == bytes([NakCode.FAIL_ERRNO, errno.EROFS])


def test_a_changed_block_size_is_einval_also_for_the_last_block() -> None:
    c = Client("ardupilot")
    c.open(PARAM, session=1)
    ack(c.ask(Opcode.READ_FILE, session=1, size=239))
    refused = c.ask(Opcode.READ_FILE, session=1, size=100, offset=239)
    assert nak(refused) == bytes([NakCode.FAIL_ERRNO, errno.EINVAL])
    refused = c.ask_all(Opcode.BURST_READ_FILE, session=1, size=80, offset=239)[0]
    assert nak(refused) == bytes([NakCode.FAIL_ERRNO, errno.EINVAL])
    ack(c.ask(Opcode.READ_FILE, session=1, size=239, offset=239))


def test_the_checksum_of_the_parameters_is_that_of_no_download() -> None:
    virtual = VirtualTrees()
    told = ack(Client("ardupilot", virtual=virtual).ask(Opcode.CALC_FILE_CRC32, PARAM))
    checksum = int.from_bytes(told, "little")
    assert checksum == crc32(virtual.content(PARAM, 64)) != crc32(virtual.content(PARAM, 239))
