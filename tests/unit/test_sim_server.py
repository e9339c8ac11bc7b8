"""Properties of every simulated server: above all, the server never raises."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.storage import Storage
from mavftpfs.sim.tree import DirectoryTree
from mavftpfs.sim.vehicle import FtpServer
from tests.support.replies import decode_reply, request
from tests.support.sim_client import CLIENT, DIR, FIVE, OTHER, A, small_tree

PATHS = [
    A,
    FIVE,
    b"/fs/microsd/empty",
    DIR,
    b"/fs/microsd/new",
    b"/",
    b"",
    b"/none",
    b"@SYS/tasks.txt",
    b"@SYS",
    b"@ROMFS/none",
    b"@PARAM/param.pck",
    b"@PARAM/param.pck?start=1&count=x",
    b"@MISSION/mission.dat",
    b"/..",
    b"n" * 239,
]


REQUESTS = st.builds(
    lambda seq, opcode, session, offset, size, data: request(
        seq, opcode, session=session, offset=offset, data=data, size=len(data) if size is None else size
    ).encode(),
    st.integers(0, 65535) | st.integers(0, 3),
    st.integers(0, 20) | st.integers(0, 255),
    st.integers(0, 2) | st.integers(0, 255),
    st.integers(0, 2000) | st.integers(0, 2**32 - 1),
    st.none() | st.integers(0, 255),
    st.sampled_from(PATHS)
    | st.tuples(st.sampled_from(PATHS[:9]), st.sampled_from(PATHS[:9])).map(b"\0".join)
    | st.binary(max_size=239),
)
EVENTS = st.lists(
    st.tuples(
        REQUESTS | st.binary(min_size=251, max_size=251) | st.binary(max_size=300),
        st.sampled_from([CLIENT, OTHER, Address(0, 0)]),
        st.sampled_from([0.0, 0.001, 0.02, 0.5, 2.5, 4.0, 12.0]),
    ),
    max_size=40,
)


def drive(server: FtpServer, events: list[tuple[bytes, Address, float]]) -> list[tuple[Address, bytes]]:
    """Hand everything over, waking at every deadline."""
    now, sent = 0.0, []
    for wire, source, pause in events:
        server.handle(wire, source, now)
        stop = now + pause
        for _ in range(100_000):
            due = server.next_deadline()
            if due is None or due > stop:
                break
            now = max(now, due)
            sent += server.outgoing(now)
        else:
            pytest.fail("the server has something to do at every instant")
        now = stop
        sent += server.outgoing(now)
    return sent


@pytest.mark.parametrize("name", sorted(PROFILES))
@settings(max_examples=60, deadline=None)
@given(events=EVENTS)
def test_no_bytes_make_a_server_raise(name: str, events: list[tuple[bytes, Address, float]]) -> None:
    def fresh() -> FtpServer:
        return FtpServer(small_tree(), PROFILES[name], rng=random.Random(3))

    server = fresh()
    sent = drive(server, events)
    for _, wire in sent:
        assert len(wire) == 251
        assert decode_reply(wire).opcode in (Opcode.ACK, Opcode.NAK)
    assert sum(server.requests.values()) + server.malformed == len(events)
    assert drive(fresh(), events) == sent, "the same again"
    server.reboot(1e6)
    assert server.open_sessions == 0
    assert server.outgoing(1e6) == []


HARMLESS = [
    Opcode.NONE,
    Opcode.TERMINATE_SESSION,
    Opcode.READ_FILE,
    Opcode.WRITE_FILE,
    Opcode.BURST_READ_FILE,
]


def random_rows(rng: random.Random) -> list[tuple[list[bytes], float]]:
    """Return rows of a transfer's requests, with repetitions and strangers among them, and pauses."""
    rows: list[tuple[list[bytes], float]] = []
    seq = rng.choice([5, 65_500])
    for _ in range(6):
        reads = rng.random() < 0.5
        usual = Opcode.READ_FILE if reads else Opcode.WRITE_FILE
        opening = Opcode.OPEN_FILE_RO if reads else rng.choice([Opcode.OPEN_FILE_WO, Opcode.CREATE_FILE])
        path = rng.choice([A, A, b"/none/of/these"])
        for kind in (Opcode.RESET_SESSIONS, opening):
            seq += 1
            rows.append(([request(seq & 0xFFFF, kind, data=path).encode()], 0.0))
        for _ in range(3):
            row: list[bytes] = []
            for _ in range(rng.randrange(10)):
                seq += rng.choice([1, 1, 1, 1, 7])
                kind = usual if rng.random() < 0.95 else rng.choice([*HARMLESS, usual, opening])
                data = b"" if kind is Opcode.READ_FILE else rng.randbytes(rng.choice([0, 5, 239, 239, 239]))
                size = rng.choice([239, 239, 239, 100, 3, 250]) if kind is Opcode.READ_FILE else len(data)
                session, offset = int(rng.random() < 0.05), 239 * rng.randrange(6)
                wire = request(seq & 0xFFFF, kind, session=session, offset=offset, data=data, size=size)
                row.append(wire.encode())
                if rng.random() < 0.1:
                    row.append(rng.choice(row[-2:]))
            rows.append((row, rng.choice([0.0, 0.0, 0.001, 0.5, 3.0, 12.0])))
    return rows


@pytest.mark.parametrize("name", ["px4", "px4-nuttx"])
@pytest.mark.parametrize("seed", range(12))
def test_a_row_is_answered_as_one_by_one(name: str, seed: int) -> None:
    def run(by_rows: bool) -> tuple[list[tuple[Address, bytes]], bytes, object]:
        tree = small_tree()
        tree.add(A, bytes(range(250)) * 4)
        server = FtpServer(tree, PROFILES[name], rng=random.Random(3))
        now, sent = 0.0, []
        for row, pause in random_rows(random.Random(seed)):
            if by_rows:
                server.handle_run(row, CLIENT, now)
            else:
                for wire in row:
                    server.handle(wire, CLIENT, now)
            sent += server.outgoing(now)
            now += pause
            sent += server.outgoing(now)
        return (
            sent,
            bytes(tree.data(A)),
            (server.requests, server.firmware.replays, server.firmware.dropped_requests, server.open_paths),
        )

    assert run(by_rows=True) == run(by_rows=False)


@pytest.mark.parametrize("name", ["px4-nuttx", "ardupilot5"])
def test_fat_tells_the_size_of_a_file_only_once_it_is_closed(name: str) -> None:
    storage = Storage(small_tree(), PROFILES[name], random.Random(3))
    parent, file = A.rpartition(b"/")[0] or b"/", A.rpartition(b"/")[2]

    def told() -> tuple[int, int, bytes, int]:
        (listed,) = [entry.stat.size for entry in storage.entries(parent) if entry.name == file]
        reader = storage.open(A)
        return storage.stat(A).size, listed, reader.read(0, 500), storage.crc(A)[1]

    opened = storage.open(A, write=True, create=True, truncate=True)
    opened.write(0, b"x" * 300)
    assert told() == (0, 0, b"", 0)
    opened.close()
    assert told() == (300, 300, b"x" * 300, 300)
    opened = storage.open(A, write=True)
    opened.write(300, b"y" * 100)
    assert told() == (300, 300, b"x" * 300, 300)
    storage.unlink(A)
    storage.open(A, write=True, create=True).close()
    assert told() == (0, 0, b"", 0), "the removed file is another one"


@pytest.mark.parametrize("real", [False, True])
@pytest.mark.parametrize("name", ["px4-nuttx", "ardupilot5"])
def test_fat_loses_the_sector_in_memory_with_the_power(name: str, real: bool, tmp_path: Path) -> None:
    """FatFs and NuttX write that sector when they need another one, or close the file."""
    (tmp_path / "fs" / "microsd").mkdir(parents=True)
    tree = DirectoryTree(tmp_path) if real else small_tree()
    storage = Storage(tree, PROFILES[name], random.Random(3))
    old, new = bytes(range(250)) * 8, b"x" * 100
    for closed in (False, True):
        opened = storage.open(A, write=True, create=True, truncate=True)
        opened.write(0, old)
        opened.close()
        opened = storage.open(A, write=True)
        for offset in (0, 500, 600, 1000):
            opened.write(offset, new)
        if closed:
            opened.close()
        storage.lose_power()
        expected = new + old[100:500] + new + new + old[700:1000] + new + old[1100:]
        kept = storage.open(A).read(0, 4096)
        assert kept == (expected if closed else expected[:1024] + old[1024:])
