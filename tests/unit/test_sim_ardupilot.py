"""The simulated ArduPilot: queue, sessions of each generation, bursts, filesystems (servers.md 1-13, 15)."""

from __future__ import annotations

import errno
import struct

import pytest

from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.sim.tree import MemoryTree
from tests.support.sim_client import DIR, FIVE, OTHER, A, Client, ack, nak

INVALID_SESSION = bytes([NakCode.INVALID_SESSION])
NOT_FOUND = bytes([NakCode.FILE_NOT_FOUND])


# -- queue and timing ----------------------------------------------------------------------------


def test_five_wait_and_the_sixth_is_dropped_silently() -> None:
    c = Client("ardupilot")
    c.open(A, session=7)
    for offset in range(8):
        c.send(Opcode.READ_FILE, session=7, size=239, offset=offset)
    assert [p.offset for p in c.receive(1.0)] == [0, 1, 2, 3, 4]
    assert c.server.firmware.dropped_requests == 3


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


# -- changing things -----------------------------------------------------------------------------


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


def test_a_full_card_is_acked_in_part_and_then_eio() -> None:
    tree = MemoryTree(capacity=300)
    c = Client("ardupilot5", tree)
    c.open(b"/new", Opcode.CREATE_FILE)
    ack(c.ask(Opcode.WRITE_FILE, bytes(239)))
    assert ack(c.ask(Opcode.WRITE_FILE, bytes(239), offset=239)) == b"", "61 bytes found room"
    full = bytes([NakCode.FAIL_ERRNO, errno.EIO])
    assert nak(c.ask(Opcode.WRITE_FILE, b"x", offset=300)) == full
    assert nak(c.ask(Opcode.WRITE_FILE, b"")) == full, "and so is a write of nothing"
