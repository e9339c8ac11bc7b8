"""The simulated ArduPilot: queue, sessions of each generation, bursts, filesystems (servers.md 1-13, 15)."""

from __future__ import annotations

import errno
import struct
from typing import Any

import pytest

from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.sim.tree import MemoryTree
from tests.support.sim_client import OTHER, Client, ack, nak, small_tree

A = b"/fs/microsd/a.bin"
FIVE = b"/fs/microsd/five"
DIR = b"/fs/microsd/dir"
INVALID_SESSION = bytes([NakCode.INVALID_SESSION])
NOT_FOUND = bytes([NakCode.FILE_NOT_FOUND])
FAIL = bytes([NakCode.FAIL])
EOF = bytes([NakCode.EOF])


def big(profile: str, size: int, **changes: Any) -> Client:
    tree = small_tree()
    tree.add(A, bytes(i % 251 for i in range(size)))
    made = Client(profile, tree, **changes)
    made.open(A, session=7)
    return made


# -- queue and timing ----------------------------------------------------------------------------


def test_five_wait_and_the_sixth_is_dropped_silently() -> None:
    c = big("ardupilot", 10_000)
    for i in range(8):
        c.send(Opcode.READ_FILE, session=7, size=239, offset=239 * i)
    replies = c.receive(1.0)
    assert [p.offset for p in replies] == [239 * i for i in range(5)]
    assert c.server.firmware.dropped_requests == 3


def test_the_worker_waits_for_room_and_nothing_else_happens() -> None:
    c = big("ardupilot", 10_000)
    room = 0
    c.server.firmware.tx_room = lambda: room
    c.send(Opcode.READ_FILE, session=7, size=100)
    c.send(Opcode.NONE, session=7)
    assert c.receive(100.0) == []
    room = 1000
    assert [p.req_opcode for p in c.receive(0.01)] == [Opcode.READ_FILE, Opcode.NONE]


def test_a_checksum_holds_up_the_queue() -> None:
    c = big("ardupilot5", 400_000)
    c.send(Opcode.CALC_FILE_CRC32, A, session=8)
    c.send(Opcode.NONE, session=8)
    assert c.receive(0.99) == []
    assert len(c.receive(0.1)) == 2


# -- sessions, generation A ----------------------------------------------------------------------


def test_an_idle_session_is_stolen_after_three_seconds_of_silence() -> None:
    c = Client("ardupilot")
    c.open(A, session=7)
    for _ in range(5):
        c.receive(2.0)
        assert nak(c.ask(Opcode.OPEN_FILE_RO, FIVE, session=8)) == INVALID_SESSION, "each NAK keeps it alive"
    c.receive(3.1)
    assert ack(c.ask(Opcode.OPEN_FILE_RO, FIVE, session=8)) == b"\1\0\0\0"
    c.receive(3.1)
    assert ack(c.ask(Opcode.OPEN_FILE_RO, A, session=8)) == struct.pack("<I", 1024)
    assert nak(c.ask(Opcode.READ_FILE, session=7, size=3)) == INVALID_SESSION


# -- sessions, generations B and C ---------------------------------------------------------------


def test_five_sessions_and_then_none() -> None:
    c = Client("ardupilot5")
    for session in range(1, 6):
        c.open(A, session=session)
    assert nak(c.ask(Opcode.OPEN_FILE_RO, A, session=6)) == bytes([NakCode.NO_SESSIONS_AVAILABLE])
    assert nak(c.ask(Opcode.NONE, session=0)) == bytes([NakCode.NO_SESSIONS_AVAILABLE])
    ack(c.ask(Opcode.TERMINATE_SESSION, session=3))
    c.open(FIVE, session=6)
    assert ack(c.ask(Opcode.READ_FILE, session=1, size=2)) == b"\0\1"
    assert c.server.open_sessions == 5


def test_sessions_are_closed_after_twenty_seconds() -> None:
    c = Client("ardupilot5")
    c.open(A, session=1)
    c.receive(19.0)
    assert c.server.open_sessions == 1
    c.receive(2.0)
    assert c.server.open_sessions == 0


def test_ids_belong_to_who_uses_them_and_reset_closes_only_ones_own() -> None:
    c = Client("ardupilot5")
    c.open(A, session=1)
    c.source = OTHER
    assert nak(c.ask(Opcode.READ_FILE, session=1, size=2)) == NOT_FOUND
    c.open(FIVE, session=1)
    ack(c.ask(Opcode.RESET_SESSIONS, session=99))
    assert c.server.open_paths == [A]


# -- the replay slot -----------------------------------------------------------------------------


@pytest.mark.parametrize("profile", ["ardupilot", "ardupilot5"])
def test_the_last_reply_of_the_server_is_replayed_exactly(profile: str) -> None:
    c = Client(profile)
    first = c.ask(Opcode.CREATE_DIRECTORY, b"/x", session=3)
    assert c.ask(Opcode.CREATE_DIRECTORY, b"/x", session=3, seq=c.seq) == first
    assert c.ask(Opcode.REMOVE_FILE, A, session=3, seq=c.seq) == first, "the opcode is not compared"
    assert c.server.firmware.replays == 2
    again = c.ask(Opcode.CREATE_DIRECTORY, b"/x", session=4, seq=c.seq)
    assert nak(again) == bytes([NakCode.FILE_EXISTS])
    c.source = OTHER
    again = c.ask(Opcode.CREATE_DIRECTORY, b"/x", session=4, seq=c.seq)
    assert nak(again) == bytes([NakCode.FILE_EXISTS])


def test_generation_b_does_not_replay_what_starts_with_five() -> None:
    for profile, replays in (("ardupilot", 1), ("ardupilot5", 0)):
        c = Client(profile)
        c.open(FIVE, session=1)
        assert ack(c.ask(Opcode.READ_FILE, session=1, size=1)) == b"\x05"
        c.ask(Opcode.READ_FILE, session=1, size=1, seq=c.seq)
        assert c.server.firmware.replays == replays


# -- bursts --------------------------------------------------------------------------------------


def summary(c: Client, size: int) -> list[tuple[int, int, int, int]]:
    replies = c.ask_all(Opcode.BURST_READ_FILE, session=7, size=size, wait=60.0)
    return [(p.opcode, p.offset, p.size, p.burst_complete) for p in replies[-2:]]


def test_the_end_of_a_burst_in_generation_c() -> None:
    assert summary(big("ardupilot5", 300), 200) == [(128, 200, 100, 0), (129, 300, 1, 1)]
    assert summary(big("ardupilot5", 400), 200) == [(128, 200, 200, 0), (129, 400, 1, 1)]
    assert summary(big("ardupilot5", 50_000), 20)[-1] == (128, 1999 * 20, 20, 1)


# -- paths and listings --------------------------------------------------------------------------


def test_size_must_be_the_length_of_the_path() -> None:
    bad = bytes([NakCode.INVALID_DATA_SIZE])
    for profile, refused in (("ardupilot", True), ("ardupilot5", False)):
        c = Client(profile)
        assert nak(c.ask(Opcode.LIST_DIRECTORY, b"")) == bad
        assert nak(c.ask(Opcode.LIST_DIRECTORY, b"/fs/junk", size=3)) == bad
        counted = c.ask(Opcode.LIST_DIRECTORY, b"/fs\0")
        assert (nak(counted) == bad) if refused else ack(counted)
        assert nak(c.ask(Opcode.RENAME, b"/a", size=2)) == bad
        assert nak(c.ask(Opcode.RENAME, b"/a\0/b", size=4)) == bad


def test_listings_of_generation_b_leave_out_tabs_and_tell_even_seconds() -> None:
    tree = MemoryTree()
    tree.add(b"/d/file", b"123", mtime=1001)
    tree.add(b"/d/tab\tname", b"1")
    tree.add_directory(b"/d/sub", mtime=1001)
    tree.set_order(b"/d", [b".", b"file", b"sub", b"tab\tname", b".."])
    c = Client("ardupilot5", tree)
    assert c.listing(b"/d") == b"Ffile\t3\0Dsub\0S\0"
    timed = c.listing(b"/d", opcode=Opcode.LIST_DIRECTORY_WITH_TIME)
    assert timed == b"Ffile\t3\t1000\0Dsub\t0\t1000\0S\0"


def test_a_name_too_long_ends_the_listing_or_is_dropped() -> None:
    tree = MemoryTree()
    tree.set_order(b"/", [b"before", b"n" * 240, b"after", b".", b".."])
    for name in (b"before", b"n" * 240, b"after"):
        tree.add(b"/" + name)
    c = Client("ardupilot", tree, root_hides_files=False, virtual_trees=False)
    assert c.listing(b"/") == b"Fbefore\t0\0\0"
    assert nak(c.ask(Opcode.LIST_DIRECTORY, b"/", offset=1)) == EOF
    assert c.listing(b"/", 2) == b"D.\0\0D..\0\0", "offsets count only what would fit"
    c = Client("ardupilot5", tree, virtual_trees=False)
    assert c.listing(b"/") == b"Fbefore\t0\0Fafter\t0\0"


def test_unknown_opcodes() -> None:
    for profile, code in (("ardupilot5", 7), ("littlefs", 1)):
        for opcode in (77, Opcode.TRUNCATE_FILE):
            assert nak(Client(profile).ask(opcode, A)) == bytes([code])
    assert nak(Client("littlefs").ask(Opcode.LIST_DIRECTORY_WITH_TIME, b"/fs")) == FAIL


# -- changing things -----------------------------------------------------------------------------


def test_one_unlink_for_both() -> None:
    c = Client("ardupilot")
    ack(c.ask(Opcode.REMOVE_FILE, DIR))
    ack(c.ask(Opcode.REMOVE_DIRECTORY, FIVE))
    for profile, number in (("ardupilot", errno.EISDIR), ("ardupilot5", errno.EACCES), ("littlefs", 90)):
        refused = Client(profile).ask(Opcode.REMOVE_DIRECTORY, b"/fs/microsd")
        assert nak(refused) == bytes([NakCode.FAIL_ERRNO, number])


def test_renaming_onto_a_file() -> None:
    data = FIVE + b"\0" + A
    ack(Client("ardupilot").ask(Opcode.RENAME, data))
    assert nak(Client("ardupilot5").ask(Opcode.RENAME, data)) == bytes([NakCode.FILE_EXISTS])
    assert nak(Client("ardupilot5").ask(Opcode.RENAME, FIVE + b"\0" + DIR)) == bytes([NakCode.FILE_EXISTS])
    assert nak(Client("littlefs").ask(Opcode.RENAME, FIVE + b"\0/new")) == bytes([NakCode.FAIL_ERRNO, 0])
    c = Client("littlefs")
    nak(c.ask(Opcode.REMOVE_FILE, b"/none"))
    assert nak(c.ask(Opcode.RENAME, FIVE + b"\0/new")) == NOT_FOUND, "a stale errno"


def test_fat_folds_case_and_drops_dots_and_blanks_at_the_end() -> None:
    c = Client("ardupilot5")
    assert ack(c.open(b"/FS/MicroSD/A.BIN")) == struct.pack("<I", 1024)
    ack(c.ask(Opcode.TERMINATE_SESSION))
    assert nak(c.ask(Opcode.CREATE_DIRECTORY, b"/fs/microsd/DIR")) == bytes([NakCode.FILE_EXISTS])
    for name in (b"a.bin.", b"A.bin. . "):
        assert ack(Client("ardupilot5").open(b"/fs/microsd/" + name)) == struct.pack("<I", 1024)
        assert nak(Client("littlefs").ask(Opcode.OPEN_FILE_RO, b"/fs/microsd/" + name)) == NOT_FOUND
    assert nak(Client("littlefs").ask(Opcode.OPEN_FILE_RO, b"/FS/microsd/a.bin")) == NOT_FOUND


def test_write_only_creates_since_generation_b() -> None:
    assert nak(Client("ardupilot").ask(Opcode.OPEN_FILE_WO, b"/new")) == NOT_FOUND
    c = Client("ardupilot5")
    assert ack(c.open(b"/new", Opcode.OPEN_FILE_WO)) == b""
    assert ack(c.ask(Opcode.WRITE_FILE, b"abc", offset=2)) == b""
    assert isinstance(c.tree, MemoryTree)
    assert len(c.tree.data(b"/new")) == 5
    assert c.tree.data(b"/new")[2:] == b"abc"


def test_gaps_hold_what_the_card_held() -> None:
    c = Client("ardupilot5")
    c.open(b"/new", Opcode.CREATE_FILE)
    ack(c.ask(Opcode.WRITE_FILE, b"end", offset=1000))
    assert isinstance(c.tree, MemoryTree)
    assert any(c.tree.data(b"/new")[:1000])


def test_a_full_card_is_acked_in_part_and_then_eio() -> None:
    tree = MemoryTree(capacity=300)
    c = Client("ardupilot5", tree)
    c.open(b"/new", Opcode.CREATE_FILE)
    ack(c.ask(Opcode.WRITE_FILE, bytes(239)))
    assert ack(c.ask(Opcode.WRITE_FILE, bytes(239), offset=239)) == b"", "61 bytes found room"
    full = bytes([NakCode.FAIL_ERRNO, errno.EIO])
    assert nak(c.ask(Opcode.WRITE_FILE, b"x", offset=300)) == full
    assert nak(c.ask(Opcode.WRITE_FILE, b"")) == full, "and so is a write of nothing"


def test_reboot_forgets_sessions_queue_and_slot() -> None:
    c = big("ardupilot", 100)
    c.ask(Opcode.CREATE_DIRECTORY, b"/x", session=7)
    seq = c.seq
    c.send(Opcode.NONE, session=7)
    c.server.reboot(c.now)
    assert c.receive(1.0) == []
    assert c.server.open_sessions == 0
    assert nak(c.ask(Opcode.CREATE_DIRECTORY, b"/x", session=7, seq=seq)) == bytes([NakCode.FILE_EXISTS])
