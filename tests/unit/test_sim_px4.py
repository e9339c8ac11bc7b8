"""The simulated PX4: its sessions, replay slot, bursts, errno, whitelist and timing (servers.md 1-13, 15)."""

from __future__ import annotations

import errno
import struct
from typing import Any

import pytest

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.sim.tree import MemoryTree
from tests.support.sim_client import OTHER, Client, ack, nak, small_tree

A = b"/fs/microsd/a.bin"
FIVE = b"/fs/microsd/five"
DIR = b"/fs/microsd/dir"


def client(profile: str = "px4", tree: MemoryTree | None = None, **changes: Any) -> Client:
    return Client(profile, tree, **changes)


def prompt() -> Client:
    """PX4 on NuttX without costs and stalls."""
    return client("px4-nuttx", request_cost=0.0, stall_chance=0.0, readdir_cost=0.0)


# -- sessions ------------------------------------------------------------------------------------


def test_one_session_with_id_zero() -> None:
    c = client()
    assert c.open(A, session=9).session == 0
    assert nak(c.ask(Opcode.OPEN_FILE_RO, FIVE)) == bytes([NakCode.NO_SESSIONS_AVAILABLE])
    assert nak(c.ask(Opcode.READ_FILE, session=9, size=5)) == bytes([NakCode.INVALID_SESSION])
    assert nak(c.ask(Opcode.TERMINATE_SESSION, session=9)) == bytes([NakCode.INVALID_SESSION])
    assert c.server.open_paths == [A]
    ack(c.ask(Opcode.RESET_SESSIONS, session=77))
    assert c.server.open_sessions == 0
    assert nak(c.ask(Opcode.TERMINATE_SESSION)) == bytes([NakCode.INVALID_SESSION])


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
    c.server.tx_room = lambda: 300 if int(c.now * 100) % 10 == 0 else 0
    packets = c.ask_all(Opcode.BURST_READ_FILE, size=239, wait=30.0)
    assert 0 < len(packets) < 147
    assert {p.opcode for p in packets} == {Opcode.ACK}
    assert c.server.open_sessions == 0
    assert c.now - sent_at > 10


def test_size_is_that_of_the_open() -> None:
    c = client()
    c.open(FIVE)
    tree = c.tree
    assert isinstance(tree, MemoryTree)
    tree.open(FIVE, write=True).write(1, b"more")
    assert ack(c.ask(Opcode.READ_FILE, size=239)) == b"\x05more"
    assert nak(c.ask(Opcode.READ_FILE, size=239, offset=1)) == bytes([NakCode.EOF])


def test_posix_opens_directories() -> None:
    c = client()
    assert ack(c.open(DIR)) == struct.pack("<I", 4096)
    assert nak(c.ask(Opcode.READ_FILE, size=5)) == bytes([NakCode.FAIL_ERRNO, errno.EISDIR])
    c.ask(Opcode.TERMINATE_SESSION)
    assert nak(prompt().ask(Opcode.OPEN_FILE_RO, DIR)) == bytes([NakCode.FAIL_ERRNO, errno.EISDIR])


def test_reboot_forgets_what_waited_and_starts_its_ticks_anew() -> None:
    c = client("px4-nuttx", stall_chance=1.0)
    c.open(A)
    for _ in range(100):
        c.send(Opcode.READ_FILE, size=100)
    dropped = c.server.dropped_requests
    assert dropped > 0
    c.now += 0.005
    c.server.reboot(c.now)
    assert c.receive(60.0) == []
    ack(c.ask(Opcode.NONE))
    for _ in range(dropped):
        c.send(Opcode.NONE)
    assert c.server.dropped_requests == dropped, "the receive buffer is empty again"
    c.receive(1.0)
    assert nak(c.ask(Opcode.BURST_READ_FILE)) == bytes([NakCode.EOF]), "and no file has a size"


# -- the replay slot -----------------------------------------------------------------------------


def test_a_repeated_request_is_answered_from_the_slot_with_stray_bytes() -> None:
    c = client()
    ack(c.ask(Opcode.CREATE_DIRECTORY, b"/x"))
    c.send(Opcode.CREATE_DIRECTORY, b"/x", seq=c.seq)
    (wire,) = c.receive_raw(0.01)
    assert wire[3] == Opcode.ACK
    assert any(wire[16:])
    assert c.server.replays == 1


def test_the_slot_looks_at_nothing_but_seq() -> None:
    c = client()
    ack(c.ask(Opcode.CREATE_DIRECTORY, b"/x"))
    c.source = OTHER
    c.send(Opcode.REMOVE_FILE, A, session=3, seq=c.seq)
    target, wire = c.server.outgoing(c.now)[0]
    assert wire[5] == Opcode.CREATE_DIRECTORY
    assert target == Address(255, 190)
    assert isinstance(c.tree, MemoryTree)
    assert c.tree.data(A)
    nak(c.ask(Opcode.RENAME, b"/none\0/there"))
    c.source = Address(1, 2)
    c.send(Opcode.NONE, seq=c.seq)
    assert c.server.outgoing(c.now)[0][0] == OTHER, "a repeat goes to whom the first went"


@pytest.mark.parametrize("path", [b"/fs/microsd/size5", FIVE])
def test_an_ack_that_starts_with_five_is_not_cached(path: bytes) -> None:
    """Open of a file whose size ends in 5: the retry is executed, and there is no session left."""
    tree = small_tree()
    tree.add(b"/fs/microsd/size5", bytes(256 + 5))
    c = client(tree=tree)
    c.open(path)
    again = c.ask(Opcode.OPEN_FILE_RO, path, seq=c.seq)
    if path == FIVE:
        assert ack(again) == b"\1\0\0\0"
        assert ack(c.ask(Opcode.READ_FILE, size=4)) == b"\x05"
        assert nak(c.ask(Opcode.READ_FILE, session=1, seq=c.seq)) == bytes([NakCode.INVALID_SESSION])
    else:
        assert nak(again) == bytes([NakCode.NO_SESSIONS_AVAILABLE])


def test_after_a_burst_the_slot_lies_ahead_of_the_client() -> None:
    """A file of one packet: the request after the burst's is taken for a repeat, and answered by its NAK."""
    c = client()
    c.open(FIVE)
    first, end = c.ask_all(Opcode.BURST_READ_FILE, size=239)
    assert (first.data, nak(end)) == (b"\x05", bytes([NakCode.EOF]))
    stale = c.ask(Opcode.TERMINATE_SESSION, seq=c.seq + 1)
    assert (stale.req_opcode, stale.opcode) == (Opcode.BURST_READ_FILE, Opcode.NAK)
    assert c.server.open_sessions == 1


# -- errno ---------------------------------------------------------------------------------------


def test_eexist_sticks_until_another_errno_or_a_listing_to_the_end() -> None:
    c = client()
    exists = bytes([NakCode.FILE_EXISTS])
    assert nak(c.ask(Opcode.CREATE_DIRECTORY, DIR)) == exists
    assert nak(c.ask(77)) == exists
    assert nak(c.ask(Opcode.TERMINATE_SESSION)) == exists
    assert nak(c.ask(Opcode.LIST_DIRECTORY, b"/none")) == bytes([NakCode.FILE_NOT_FOUND])
    assert nak(c.ask(77)) == bytes([NakCode.UNKNOWN_COMMAND])
    assert nak(c.ask(Opcode.CREATE_DIRECTORY, DIR)) == exists
    ack(c.ask(Opcode.LIST_DIRECTORY, DIR))
    assert nak(c.ask(77)) == bytes([NakCode.UNKNOWN_COMMAND])


def test_oversize_and_unknown() -> None:
    c = client()
    assert nak(c.ask(Opcode.NONE, size=240)) == bytes([NakCode.INVALID_DATA_SIZE])
    assert nak(c.ask(Opcode.LIST_DIRECTORY_WITH_TIME, b"/")) == bytes([NakCode.UNKNOWN_COMMAND])
    echoed = c.ask(Opcode.NONE, b"hello", session=9, offset=7)
    assert (echoed.data, echoed.session, echoed.offset) == (b"hello", 9, 7)


# -- listings ------------------------------------------------------------------------------------


def test_skip_entries_are_counted() -> None:
    tree = MemoryTree()
    tree.add_symlink(b"/link", b"file")
    tree.add_other(b"/fifo")
    tree.add(b"/file", b"xyz")
    tree.add_directory(b"/sub")
    c = client(tree=tree)
    assert c.listing(b"/") == b"S\0S\0S\0S\0Ffile\t3\0Dsub\0"
    assert c.listing(b"/", 4) == b"Ffile\t3\0Dsub\0"
    assert nak(c.ask(Opcode.LIST_DIRECTORY, b"/", offset=6)) == bytes([NakCode.EOF])


def test_nuttx_drops_the_dot_behind_a_short_name_only() -> None:
    tree = MemoryTree()
    for name in (b"short", b"Mixed", b"longer-than-8", b"a.b"):
        tree.add(b"/fs/microsd/" + name)
    c = client("px4-nuttx", tree, request_cost=0.0, stall_chance=0.0)
    assert c.open(b"/fs/microsd/short.").size == 4
    ack(c.ask(Opcode.TERMINATE_SESSION))
    for name in (b"Mixed.", b"longer-than-8.", b"a.b.", b"short ", b"short.."):
        assert nak(c.ask(Opcode.OPEN_FILE_RO, b"/fs/microsd/" + name)) == bytes([NakCode.FILE_NOT_FOUND])


def test_nuttx_folds_the_case_of_short_names_only() -> None:
    tree = MemoryTree()
    for number, name in enumerate((b"short", b"UP.txt", b"Mixed", b"longer-than-8", b"e.html", b"a+b")):
        tree.add(b"/fs/microsd/" + name, bytes(number + 1))
    c = client("px4-nuttx", tree, request_cost=0.0, stall_chance=0.0)
    for name, size in ((b"SHORT", 1), (b"SHORT.", 1), (b"up.TXT", 2), (b"Mixed", 3)):
        assert ack(c.ask(Opcode.OPEN_FILE_RO, b"/fs/microsd/" + name)) == struct.pack("<I", size)
        ack(c.ask(Opcode.TERMINATE_SESSION))
    for name in (b"Short", b"Up.txt", b"mixed", b"MIXED", b"LONGER-THAN-8", b"E.HTML", b"A+B"):
        assert nak(c.ask(Opcode.OPEN_FILE_RO, b"/fs/microsd/" + name)) == bytes([NakCode.FILE_NOT_FOUND])


def test_a_name_too_long_for_a_page_blocks_the_rest() -> None:
    tree = MemoryTree()
    tree.set_order(b"/", [b"before", b"n" * 236, b"after", b".", b".."])
    for name in (b"before", b"n" * 236, b"after"):
        tree.add(b"/" + name)
    c = client(tree=tree)
    assert c.listing(b"/") == b"Fbefore\t0\0"
    assert c.listing(b"/", 1) == b""
    assert c.listing(b"/", 2) == b"Fafter\t0\0S\0S\0"


def test_listing_with_time_is_data() -> None:
    c = client("px4-2026")
    page = c.listing(b"/fs/microsd", opcode=Opcode.LIST_DIRECTORY_WITH_TIME)
    assert page.startswith(b"S\0S\0Fa.bin\t1024\t1700000000\0")
    assert page.endswith(b"Ddir\0")
    c = client("px4-2026", bare_time_directories=False)
    page = c.listing(b"/fs/microsd", opcode=Opcode.LIST_DIRECTORY_WITH_TIME)
    assert page.endswith(b"Ddir\t0\t1700000000\0")


# -- bursts --------------------------------------------------------------------------------------


def burst_client(size: int, **changes: Any) -> Client:
    tree = MemoryTree()
    tree.add(A, bytes(i % 251 for i in range(size)))
    made = client(tree=tree, **changes)
    made.open(A)
    made.receive(0.003)  # between two ticks
    return made


def test_a_burst_ends_with_the_tick_that_passes_35_kb() -> None:
    c = burst_client(100_000)
    replies = c.ask_all(Opcode.BURST_READ_FILE, size=100, wait=1.0)
    assert [p.size for p in replies] == [239] * 168
    assert [p.burst_complete for p in replies] == [0] * 167 + [1]
    assert [p.seq for p in replies] == [(c.seq + 1 + i) % 65536 for i in range(168)]
    data = b"".join(p.data for p in replies)
    assert isinstance(c.tree, MemoryTree)
    assert data == c.tree.data(A)[:40152]


@pytest.mark.parametrize(("room", "packets"), [(1500, 5), (600, 2), (500, 1), (200, 0)])
def test_the_transmit_buffer_paces_a_burst(room: int, packets: int) -> None:
    c = burst_client(100_000)
    c.server.tx_room = lambda: room
    c.send(Opcode.BURST_READ_FILE, size=239)
    assert [len(c.receive(0.01)) for _ in range(3)] == [packets] * 3


def test_a_packet_alone_in_its_tick_may_claim_to_be_the_last() -> None:
    c = burst_client(34_000, garbage_complete=1.0)
    c.server.tx_room = lambda: 500
    first, second, third = c.ask_all(Opcode.BURST_READ_FILE, size=239, wait=0.03)
    assert (first.burst_complete, second.burst_complete, third.offset) == (1, 1, 478)


def test_requests_are_answered_during_a_burst_and_terminate_stops_it() -> None:
    c = burst_client(100_000)
    c.send(Opcode.BURST_READ_FILE, size=239)
    assert len(c.receive(0.01)) == 56
    assert ack(c.ask(Opcode.READ_FILE, size=4, offset=90_000, wait=0.001)) == bytes(
        i % 251 for i in range(90_000, 90_004)
    )
    ack(c.ask(Opcode.TERMINATE_SESSION, wait=0.001))
    assert c.receive(1.0) == []


def test_a_file_that_shrank_floods_empty_packets() -> None:
    c = burst_client(100_000)
    c.tree.truncate(A, 239)
    replies = c.ask_all(Opcode.BURST_READ_FILE, size=239, wait=0.05)
    assert replies[0].size == 239
    assert {p.size for p in replies[1:]} == {0}
    assert {p.offset for p in replies[1:]} == {239}
    assert c.ask_all(Opcode.READ_FILE, size=10, offset=500, wait=0.0)[0].size == 0


def test_replies_without_room_are_lost() -> None:
    c = burst_client(1000)
    c.server.tx_room = lambda: 20
    assert c.ask_all(Opcode.READ_FILE, size=100) == []
    assert c.server.dropped_replies == 1


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


def test_write_only_creates_and_does_not_truncate() -> None:
    c = client()
    assert ack(c.open(A, Opcode.OPEN_FILE_WO)) == struct.pack("<I", 1024)
    ack(c.ask(Opcode.TERMINATE_SESSION))
    assert ack(c.open(b"/new", Opcode.OPEN_FILE_WO)) == struct.pack("<I", 0)


PROTECTED = bytes([NakCode.FILE_PROTECTED])


def test_nuttx_refuses_a_write_after_another_path_operation() -> None:
    c = prompt()
    c.open(b"/fs/microsd/new", Opcode.CREATE_FILE)
    ack(c.ask(Opcode.WRITE_FILE, b"x"))
    ack(c.ask(Opcode.CALC_FILE_CRC32, A))
    ack(c.ask(Opcode.WRITE_FILE, b"x"))
    ack(c.ask(Opcode.LIST_DIRECTORY, b"/fs"))
    assert nak(c.ask(Opcode.WRITE_FILE, b"x")) == PROTECTED
    ack(c.ask(Opcode.LIST_DIRECTORY, b"/fs/microsd/"))
    ack(c.ask(Opcode.WRITE_FILE, b"x"))


def test_nuttx_refuses_a_write_after_two_seconds_of_silence() -> None:
    c = prompt()
    c.open(b"/fs/microsd/new", Opcode.CREATE_FILE)
    c.receive(1.9)
    ack(c.ask(Opcode.WRITE_FILE, b"x"))
    c.receive(2.1)
    assert nak(c.ask(Opcode.WRITE_FILE, b"x")) == PROTECTED
    ack(c.ask(Opcode.LIST_DIRECTORY, b"/fs/microsd/"))
    ack(c.ask(Opcode.WRITE_FILE, b"x"))


@pytest.mark.parametrize(
    ("opcode", "data"),
    [
        (Opcode.REMOVE_FILE, b"/etc/rc"),
        (Opcode.CREATE_DIRECTORY, b"fs/microsd/x"),
        (Opcode.REMOVE_DIRECTORY, b"/fs/microsd/../x"),
        (Opcode.TRUNCATE_FILE, b"/etc/rc"),
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


@pytest.mark.parametrize("size", [0, 100, 1024, 3000])
def test_nuttx_truncates_through_a_copy(size: int) -> None:
    c = prompt()
    ack(c.ask(Opcode.TRUNCATE_FILE, A, offset=size))
    assert isinstance(c.tree, MemoryTree)
    assert c.tree.data(A) == (bytes(range(256)) * 4).ljust(3000, b"\0")[:size]
    assert all(entry.name != b".trunc.tmp" for entry in c.tree.entries(b"/fs/microsd"))


def test_nuttx_truncate_without_room_for_the_copy_fails() -> None:
    tree = MemoryTree(capacity=1500)
    tree.add(A, bytes(1024))
    c = Client("px4-nuttx", tree, request_cost=0.0, stall_chance=0.0)
    assert nak(c.ask(Opcode.TRUNCATE_FILE, A, offset=600)) == bytes([NakCode.FAIL_ERRNO, errno.ENOSPC])


def test_unclosed_data_is_lost_at_a_reboot_on_fat() -> None:
    c = prompt()
    c.open(b"/fs/microsd/new", Opcode.CREATE_FILE)
    ack(c.ask(Opcode.WRITE_FILE, b"hello"))
    c.server.reboot(c.now)
    assert c.tree.stat(b"/fs/microsd/new").size == 0
    c.open(b"/fs/microsd/new", Opcode.CREATE_FILE)
    ack(c.ask(Opcode.WRITE_FILE, b"hello"))
    ack(c.ask(Opcode.TERMINATE_SESSION))
    c.server.reboot(c.now)
    assert c.tree.stat(b"/fs/microsd/new").size == 5


# -- timing --------------------------------------------------------------------------------------


def test_a_slow_card_loses_what_does_not_fit_the_receive_buffer() -> None:
    c = client("px4-nuttx", stall_chance=1.0)
    c.open(A)
    c.receive(1.0)
    for i in range(80):
        c.send(Opcode.READ_FILE, size=100, offset=i)
    assert c.server.dropped_requests > 0
    answered = c.receive(120.0)
    assert len(answered) == 80 - c.server.dropped_requests
    assert [p.offset for p in answered] == list(range(len(answered)))


def test_a_checksum_takes_time_and_what_follows_waits() -> None:
    tree = MemoryTree()
    tree.add(A, b"123456789" * 20_000)
    c = Client("px4-nuttx", tree, stall_chance=0.0)
    c.send(Opcode.CALC_FILE_CRC32, A)
    c.send(Opcode.NONE)
    assert c.receive(0.2) == []
    crc, none = c.receive(0.2)
    assert (crc.req_opcode, none.req_opcode) == (Opcode.CALC_FILE_CRC32, Opcode.NONE)


def test_checksum_value_and_errors() -> None:
    tree = MemoryTree()
    tree.add(b"/digits", b"123456789")
    c = client(tree=tree)
    assert ack(c.ask(Opcode.CALC_FILE_CRC32, b"/digits")) == struct.pack("<I", 0x2DFD2D88)
    assert nak(c.ask(Opcode.CALC_FILE_CRC32, b"/none")) == bytes([NakCode.FAIL_ERRNO, 0]), "errno untouched"
    assert nak(c.ask(Opcode.CALC_FILE_CRC32, b"/")) == bytes([NakCode.FAIL_ERRNO, errno.EISDIR])


def test_parameters_of_2026_have_their_exact_size() -> None:
    c = client("px4-2026")
    size = struct.unpack("<I", ack(c.open(b"@PARAM/param.pck")))[0]
    data = b"".join(ack(c.ask(Opcode.READ_FILE, offset=offset, size=239)) for offset in range(0, size, 239))
    assert len(data) == size
    assert nak(c.ask(Opcode.READ_FILE, offset=0, size=100)) == bytes([NakCode.FAIL_ERRNO, errno.EINVAL])
