"""The simulated MAVSDK server: silence, and a crash (servers.md 6, 7, 15)."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.sim.tree import MemoryTree
from tests.support.sim_client import DIR, FIVE, A, Client, ack, nak


@pytest.mark.parametrize("opcode", [Opcode.OPEN_FILE_RO, Opcode.OPEN_FILE_WO])
def test_opening_a_directory_gets_no_answer(opcode: int) -> None:
    assert Client("mavsdk").ask_all(opcode, DIR, wait=60.0) == []


def test_listing_a_file_kills_the_server() -> None:
    c = Client("mavsdk")
    c.open(A, Opcode.CREATE_FILE)
    ack(c.ask(Opcode.WRITE_FILE, b"abc"))
    assert c.ask_all(Opcode.LIST_DIRECTORY, FIVE, wait=60.0) == []
    assert c.server.firmware.crashed
    assert c.ask_all(Opcode.LIST_DIRECTORY, DIR, wait=60.0) == []
    assert isinstance(c.tree, MemoryTree)
    assert c.tree.data(A) == b"", "what was in the stream's buffer is gone"
    c.server.reboot(c.now)
    assert not c.server.firmware.crashed
    assert nak(c.ask(Opcode.LIST_DIRECTORY, DIR)) == bytes([NakCode.EOF])
