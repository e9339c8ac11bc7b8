"""The simulated PX4: its sessions, replay slot, bursts, errno, whitelist and timing (servers.md 1-13, 15)."""

from __future__ import annotations

import errno
import struct
from typing import Any

import pytest

from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.sim.tree import MemoryTree
from tests.support.sim_client import DIR, FIVE, OTHER, A, Client, ack, nak


def client(profile: str = "px4", tree: MemoryTree | None = None, **changes: Any) -> Client:
    return Client(profile, tree, **changes)


def prompt() -> Client:
    """PX4 on NuttX without costs and stalls."""
    return client("px4-nuttx", request_cost=0.0, stall_chance=0.0, readdir_cost=0.0)


# -- sessions ------------------------------------------------------------------------------------


def test_session_closes_after_ten_seconds_without_requests() -> None:
    c = client()
    c.open(A)
    c.receive(9.9)
    assert c.server.open_sessions == 1
    c.ask(Opcode.NONE)
    c.receive(9.9)
    assert c.server.open_sessions == 1
    c.receive(0.2)
    assert c.server.open_sessions == 0


def test_a_burst_does_not_keep_its_session_alive() -> None:
    """A link of 2 kB/s: the stream stops silently in the middle, ten seconds after the last request."""
    c = burst_client(1_000_000)
    sent_at = c.now
    c.server.firmware.tx_room = lambda: 300 if int(c.now * 100) % 10 == 0 else 0
    packets = c.ask_all(Opcode.BURST_READ_FILE, size=239, wait=30.0)
    assert 0 < len(packets) < 147
    assert {p.opcode for p in packets} == {Opcode.ACK}
    assert c.server.open_sessions == 0
    assert c.now - sent_at > 10


def test_of_2026_an_answer_is_repeated_for_the_client_that_asked_only() -> None:
    c = client("px4-2026")
    seq = c.send(Opcode.OPEN_FILE_RO, A)
    c.receive()
    c.source = OTHER
    other = c.ask(Opcode.TERMINATE_SESSION, seq=seq)
    assert other.req_opcode == Opcode.TERMINATE_SESSION
    assert c.server.firmware.replays == 0


def test_of_2026_a_write_needs_an_open_file_and_no_whitelisted_path_before_it() -> None:
    c = client("px4-2026", writable_root=b"/fs/microsd/")
    assert nak(c.ask(Opcode.WRITE_FILE, b"x")) == bytes([NakCode.INVALID_SESSION])
    c.open(FIVE, Opcode.OPEN_FILE_WO)
    c.ask(Opcode.LIST_DIRECTORY, b"/fs")
    assert ack(c.ask(Opcode.WRITE_FILE, b"x"))


# -- listings ------------------------------------------------------------------------------------


def test_nuttx_folds_case_and_drops_the_dot_of_short_names_only() -> None:
    tree = MemoryTree()
    for number, name in enumerate((b"short", b"UP.txt", b"Mixed", b"longer-than-8", b"e.html", b"a+b")):
        tree.add(b"/fs/microsd/" + name, bytes(number + 1))
    c = client("px4-nuttx", tree, request_cost=0.0, stall_chance=0.0)
    for name, size in ((b"SHORT", 1), (b"SHORT.", 1), (b"short.", 1), (b"up.TXT", 2), (b"Mixed", 3)):
        assert ack(c.ask(Opcode.OPEN_FILE_RO, b"/fs/microsd/" + name)) == struct.pack("<I", size)
        ack(c.ask(Opcode.TERMINATE_SESSION))
    other_case = (b"Short", b"Up.txt", b"mixed", b"MIXED", b"LONGER-THAN-8", b"E.HTML", b"A+B")
    for name in (*other_case, b"Mixed.", b"longer-than-8.", b"short ", b"short.."):
        assert nak(c.ask(Opcode.OPEN_FILE_RO, b"/fs/microsd/" + name)) == bytes([NakCode.FILE_NOT_FOUND])


# -- bursts --------------------------------------------------------------------------------------


def burst_client(size: int, **changes: Any) -> Client:
    tree = MemoryTree()
    tree.add(A, bytes(i % 251 for i in range(size)))
    made = client(tree=tree, **changes)
    made.open(A)
    made.receive(0.003)  # between two ticks
    return made


def test_a_file_that_shrank_floods_empty_packets() -> None:
    c = burst_client(100_000)
    c.tree.open(A, write=True).resize(239)
    replies = c.ask_all(Opcode.BURST_READ_FILE, size=239, wait=0.05)
    assert replies[0].size == 239
    assert {p.size for p in replies[1:]} == {0}
    assert {p.offset for p in replies[1:]} == {239}
    assert c.ask_all(Opcode.READ_FILE, size=10, offset=500, wait=0.0)[0].size == 0


# -- writing -------------------------------------------------------------------------------------


def test_a_full_card_shows_as_a_short_write_and_then_enospc() -> None:
    tree = MemoryTree(capacity=300)
    tree.add_directory(b"/fs/microsd")
    c = client(tree=tree)
    c.open(b"/fs/microsd/new", Opcode.CREATE_FILE)
    assert ack(c.ask(Opcode.WRITE_FILE, bytes(239))) == struct.pack("<I", 239)
    assert ack(c.ask(Opcode.WRITE_FILE, bytes(239), offset=239)) == struct.pack("<I", 61)
    full = bytes([NakCode.FAIL_ERRNO, errno.ENOSPC])
    assert nak(c.ask(Opcode.WRITE_FILE, bytes(239), offset=300)) == full


PROTECTED = bytes([NakCode.FILE_PROTECTED])


def test_nuttx_refuses_a_write_after_another_path_operation_or_two_seconds_of_silence() -> None:
    c = prompt()
    c.open(b"/fs/microsd/new", Opcode.CREATE_FILE)
    ack(c.ask(Opcode.WRITE_FILE, b"x"))
    ack(c.ask(Opcode.CALC_FILE_CRC32, A))
    ack(c.ask(Opcode.WRITE_FILE, b"x"))
    ack(c.ask(Opcode.LIST_DIRECTORY, b"/fs"))
    assert nak(c.ask(Opcode.WRITE_FILE, b"x")) == PROTECTED
    ack(c.ask(Opcode.LIST_DIRECTORY, b"/fs/microsd/"))
    c.receive(1.9)
    ack(c.ask(Opcode.WRITE_FILE, b"x"))
    c.receive(2.1)
    assert nak(c.ask(Opcode.WRITE_FILE, b"x")) == PROTECTED


@pytest.mark.parametrize(
    ("opcode", "data"),
    [
        (Opcode.REMOVE_FILE, b"/etc/rc"),
        (Opcode.CREATE_DIRECTORY, b"fs/microsd/x"),
        (Opcode.REMOVE_DIRECTORY, b"/fs/microsd/../x"),
        (Opcode.RENAME, A + b"\0/etc/rc"),
    ],
)
def test_nuttx_whitelist(opcode: int, data: bytes) -> None:
    assert nak(prompt().ask(opcode, data)) == PROTECTED


def test_nuttx_renames_into_directories_and_over_files() -> None:
    c = prompt()
    ack(c.ask(Opcode.RENAME, FIVE + b"\0" + DIR))
    assert isinstance(c.tree, MemoryTree)
    assert c.tree.data(DIR + b"/five") == b"\x05"
    ack(c.ask(Opcode.RENAME, DIR + b"/five\0" + A))
    assert c.tree.data(A) == b"\x05"


# -- timing --------------------------------------------------------------------------------------


def test_a_slow_card_loses_what_does_not_fit_the_receive_buffer() -> None:
    c = client("px4-nuttx", stall_chance=1.0)
    c.open(A)
    c.receive(1.0)
    for i in range(80):
        c.send(Opcode.READ_FILE, size=100, offset=i)
    assert c.server.firmware.dropped_requests > 0
    answered = c.receive(120.0)
    assert len(answered) == 80 - c.server.firmware.dropped_requests
    assert [p.offset for p in answered] == list(range(len(answered)))
