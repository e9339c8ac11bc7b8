"""The simulated MAVSDK server: two streams, bursts by a thread, silence, a crash (servers.md 1-10, 15)."""

from __future__ import annotations

import errno
import struct
from typing import Any

import pytest

from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.sim.tree import MemoryTree
from tests.support.sim_client import Client, ack, nak, small_tree

A = b"/fs/microsd/a.bin"
FIVE = b"/fs/microsd/five"
DIR = b"/fs/microsd/dir"
FAIL = bytes([NakCode.FAIL])
EOF = bytes([NakCode.EOF])
NOT_FOUND = bytes([NakCode.FILE_NOT_FOUND])


def content(size: int) -> bytes:
    return bytes(i % 251 for i in range(size))


def big(size: int, profile: str = "mavsdk", **changes: Any) -> Client:
    tree = small_tree()
    tree.add(A, content(size))
    made = Client(profile, tree, **changes)
    made.open(A)
    return made


# -- silence and the crash -----------------------------------------------------------------------


@pytest.mark.parametrize("opcode", [Opcode.NONE, Opcode.TRUNCATE_FILE, 77, 128])
def test_what_it_does_not_know_gets_no_answer(opcode: int) -> None:
    assert Client("mavsdk").ask_all(opcode, A, wait=60.0) == []


@pytest.mark.parametrize("opcode", [Opcode.OPEN_FILE_RO, Opcode.OPEN_FILE_WO])
def test_opening_a_directory_gets_no_answer(opcode: int) -> None:
    assert Client("mavsdk").ask_all(opcode, DIR, wait=60.0) == []


def test_listing_a_file_kills_the_server() -> None:
    c = Client("mavsdk")
    c.open(A, Opcode.CREATE_FILE)
    ack(c.ask(Opcode.WRITE_FILE, b"abc"))
    assert c.ask_all(Opcode.LIST_DIRECTORY, FIVE, wait=60.0) == []
    assert c.server.crashed
    assert c.ask_all(Opcode.LIST_DIRECTORY, DIR, wait=60.0) == []
    assert isinstance(c.tree, MemoryTree)
    assert c.tree.data(A) == b"", "what was in the stream's buffer is gone"
    c.server.reboot(c.now)
    assert not c.server.crashed
    assert nak(c.ask(Opcode.LIST_DIRECTORY, DIR)) == EOF


# -- the two streams -----------------------------------------------------------------------------


def test_a_second_open_redirects_the_first_silently() -> None:
    c = Client("mavsdk")
    c.open(A)
    c.open(FIVE, session=9)
    assert ack(c.ask(Opcode.READ_FILE, size=1)) == b"\x05"


def test_a_wrong_session_closes_everything() -> None:
    c = Client("mavsdk")
    c.open(A)
    c.open(FIVE, Opcode.OPEN_FILE_WO)
    assert nak(c.ask(Opcode.READ_FILE, session=1, size=1)) == FAIL
    assert c.server.open_sessions == 0
    assert nak(c.ask(Opcode.READ_FILE, size=1)) == FAIL
    assert nak(c.ask(Opcode.READ_FILE, size=1, offset=1)) == EOF, "the size of the last open is kept"


def test_a_read_across_the_end_fails() -> None:
    c = big(100)
    assert nak(c.ask(Opcode.READ_FILE, size=239)) == FAIL
    assert ack(c.ask(Opcode.READ_FILE, size=100)) == content(100)
    assert nak(c.ask(Opcode.READ_FILE, size=1, offset=100)) == EOF
    assert ack(c.ask(Opcode.READ_FILE, size=0)) == b""


def test_on_old_versions_it_spoils_the_stream() -> None:
    c = big(100, "mavsdk-old")
    assert nak(c.ask(Opcode.READ_FILE, size=239)) == FAIL
    assert nak(c.ask(Opcode.READ_FILE, size=100)) == FAIL
    c.open(A)
    assert ack(c.ask(Opcode.READ_FILE, size=100)) == content(100)


# -- writing -------------------------------------------------------------------------------------


def test_write_only_truncates_and_reports_the_old_size() -> None:
    c = Client("mavsdk")
    assert ack(c.open(A, Opcode.OPEN_FILE_WO)) == struct.pack("<I", 1024)
    assert c.tree.stat(A).size == 0
    assert nak(c.ask(Opcode.OPEN_FILE_WO, b"/none")) == NOT_FOUND


def test_the_last_write_stays_in_a_buffer_until_terminate() -> None:
    c = Client("mavsdk")
    assert ack(c.open(A, Opcode.CREATE_FILE)) == b""
    ack(c.ask(Opcode.WRITE_FILE, b"abc"))
    ack(c.ask(Opcode.WRITE_FILE, b"def", offset=3))
    assert isinstance(c.tree, MemoryTree)
    assert c.tree.data(A) == b"abc"
    ack(c.ask(Opcode.TERMINATE_SESSION))
    assert c.tree.data(A) == b"abcdef"


def test_a_full_disk_shows_late_or_never() -> None:
    tree = MemoryTree(capacity=100)
    c = Client("mavsdk", tree)
    c.open(b"/new", Opcode.CREATE_FILE)
    ack(c.ask(Opcode.WRITE_FILE, bytes(150)))
    assert nak(c.ask(Opcode.WRITE_FILE, bytes(10), offset=150)) == FAIL
    ack(c.ask(Opcode.TERMINATE_SESSION))
    c.open(b"/new", Opcode.CREATE_FILE)
    ack(c.ask(Opcode.WRITE_FILE, bytes(150)))
    ack(c.ask(Opcode.TERMINATE_SESSION))
    assert tree.stat(b"/new").size == 100


# -- bursts --------------------------------------------------------------------------------------


def test_a_burst_has_150_packets_of_two_milliseconds_and_no_nak() -> None:
    c = big(50_000)
    started = c.now
    replies = c.ask_all(Opcode.BURST_READ_FILE, size=239, wait=0.3089)
    assert len(replies) == 149
    replies += c.receive(0.001)
    assert [p.burst_complete for p in replies] == [0] * 149 + [1]
    assert c.receive(5.0) == []
    assert c.now > started
    replies = c.ask_all(Opcode.BURST_READ_FILE, size=100, offset=49_850, wait=1.0)
    assert [(p.offset, p.size, p.burst_complete) for p in replies] == [(49_850, 100, 0), (49_950, 50, 1)]
    assert nak(c.ask(Opcode.BURST_READ_FILE, size=100, offset=50_000)) == EOF


def test_a_read_during_a_burst_moves_the_burst() -> None:
    """Later packets carry wrong bytes under right offsets, until the stream's end spoils them all."""
    c = big(20_000)
    c.send(Opcode.BURST_READ_FILE, size=239)
    first = c.receive(0.003)
    assert [p.data for p in first] == [content(239)]
    assert ack(c.ask(Opcode.READ_FILE, size=10, offset=19_000, wait=0.0)) == content(20_000)[19_000:19_010]
    (wrong,) = c.receive(0.002)
    assert (wrong.offset, wrong.data) == (239, content(20_000)[19_010:19_249])
    rest = c.receive(5.0)
    assert rest[-1].data == FAIL
    assert {p.opcode for p in rest[5:]} == {Opcode.NAK}
    assert len(first) + 1 + len(rest) == 150


def test_old_versions_burst_to_the_end_of_the_file() -> None:
    c = big(100_000, "mavsdk-old")
    replies = c.ask_all(Opcode.BURST_READ_FILE, size=239, wait=10.0)
    assert len(replies) == 419
    assert [p.burst_complete for p in replies] == [0] * 418 + [1]


# -- paths ---------------------------------------------------------------------------------------


def test_listing_leaves_out_but_counts() -> None:
    tree = MemoryTree()
    tree.add(b"/d/file", b"123", mtime=1001)
    tree.add_other(b"/d/fifo")
    tree.add_symlink(b"/d/dangling", b"none")
    tree.add_symlink(b"/d/link", b"file")
    tree.add_directory(b"/d/sub", mtime=1001)
    c = Client("mavsdk", tree)
    assert c.listing(b"/d") == b"Ffile\t3\0Flink\t3\0Dsub\0"
    assert c.listing(b"/d", 3) == b"Flink\t3\0Dsub\0", "so a client that counts names sees one twice"
    timed = c.listing(b"d/", opcode=Opcode.LIST_DIRECTORY_WITH_TIME)
    assert timed == b"Ffile\t3\t1001\0Flink\t3\t1001\0Dsub\t0\t1001\0"
    old = Client("mavsdk-old", tree)
    assert old.ask_all(Opcode.LIST_DIRECTORY_WITH_TIME, b"/d") == []


def test_a_name_too_long_hides_the_rest() -> None:
    tree = MemoryTree()
    tree.set_order(b"/", [b"before", b"n" * 236, b"after"])
    for name in (b"before", b"n" * 236, b"after"):
        tree.add(b"/" + name)
    c = Client("mavsdk", tree)
    assert c.listing(b"/") == b"Fbefore\t0\0"
    assert nak(c.ask(Opcode.LIST_DIRECTORY, b"/", offset=1)) == EOF


@pytest.mark.parametrize(
    ("opcode", "data", "refusal"),
    [
        (Opcode.OPEN_FILE_RO, b"/none", NOT_FOUND),
        (Opcode.LIST_DIRECTORY, b"/none", NOT_FOUND),
        (Opcode.REMOVE_FILE, b"/none", NOT_FOUND),
        (Opcode.REMOVE_DIRECTORY, b"/fs", FAIL),
        (Opcode.RENAME, b"/none\0/x", NOT_FOUND),
        (Opcode.RENAME, A + b"\0" + DIR, FAIL),
        (Opcode.CREATE_DIRECTORY, b"/no/such", bytes([NakCode.FAIL_ERRNO, errno.ENOENT])),
        (Opcode.CREATE_FILE, DIR, FAIL),
        (Opcode.CALC_FILE_CRC32, b"/none", NOT_FOUND),
        (Opcode.CALC_FILE_CRC32, DIR, bytes([201])),
    ],
)
def test_refusals(opcode: int, data: bytes, refusal: bytes) -> None:
    assert nak(Client("mavsdk").ask(opcode, data)) == refusal


def test_a_checksum_blocks_the_handler() -> None:
    tree = MemoryTree()
    tree.add(b"/digits", b"123456789")
    c = Client("mavsdk", tree, crc_rate=9.0)
    c.send(Opcode.CALC_FILE_CRC32, b"/digits")
    c.send(Opcode.RESET_SESSIONS)
    assert c.receive(0.99) == []
    crc, reset = c.receive(0.02)
    assert crc.data == struct.pack("<I", 0x2DFD2D88)
    assert reset.req_opcode == Opcode.RESET_SESSIONS
