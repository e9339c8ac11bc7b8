"""The simulated servers answer what real ones answered.

Every request of a recording is handed to the matching profile at its recorded time, and the replies are
compared field by field, all but stray bytes behind `size`.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import replace

import pytest

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Payload
from mavftpfs.sim.parameters import Selection, Table
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.pseudo import VirtualTrees
from mavftpfs.sim.tree import MemoryTree
from mavftpfs.sim.vehicle import FtpServer
from tests.support.recordings import Step, data_of, unpacked
from tests.support.recordings import load_recording as load
from tests.support.replies import decode_reply

CLIENT = Address(255, 190)
NAMES = ("px4", "px4-2026", "ardupilot", "mavsdk")
MTIMES = {"px4-2026": 1_795_490_017}
MTIME = 1_795_197_991
"""Of all files in the other recordings."""
EXPLAINED = {
    "px4-2026": {
        "burst, then at once a read of another offset": "a tick of the server fell between the two requests",
        "burst, then terminate at once": "a tick of the server fell between the two requests",
    }
}
"""Steps in which the simulated replies differ, and why: neither their order nor their number is compared."""


# -- the tree that was served --------------------------------------------------------------------


def listed(steps: list[Step], name: str) -> list[bytes]:
    """Return the entries of a recorded listing, each with its type letter."""
    data = b"".join(
        reply.data for step in steps if step.name == name for _, reply in step.replies if reply.opcode == 128
    )
    return [entry for entry in data.split(b"\0") if entry]


def names(entries: list[bytes]) -> list[bytes]:
    return [entry[1:].partition(b"\t")[0] for entry in entries]


def build_tree(name: str, steps: list[Step]) -> MemoryTree:
    tree = MemoryTree(clock=lambda: MTIMES.get(name, MTIME))
    ardupilot = load("ardupilot")
    tree.add_directory(b"/t/emptydir")
    for size in (0, 1, 5, 238, 239, 240, 478, 4096, 40152, 119500):
        tree.add(b"/t/s%d.bin" % size, bytes((7 * i + size) % 256 for i in range(size)))
    for text in ("space in name.txt", "ünï.txt", "n" * 100):
        tree.add(b"/t/" + text.encode(), b"x" * 10)
    for i in range(120):
        tree.add(b"/t/many/log_%03d.ulg" % i, b"y" * i)
    # ArduPilot lists the dot entries by name, so its recording tells where readdir has them.
    first_page = names(listed(ardupilot, "list /t page by page"))
    tree.set_order(b"/t", [b"new.bin", *first_page, b"s40152.bin"])
    tree.set_order(b"/t/many", names(listed(ardupilot, "list /t/many page by page")))
    add_root_entries(tree, name, listed(steps, "list '.'"))
    return tree


def add_root_entries(tree: MemoryTree, name: str, entries: list[bytes]) -> None:
    order = []
    unnamed = iter((b".", b"..", b"fifo1", b"fifo2"))  # what PX4 lists as S
    for entry in entries:
        shown, _, size = entry[1:].partition(b"\t")
        path = shown or next(unnamed)
        order.append(path)
        if entry[:1] == b"F":
            tree.add(b"/" + path, bytes(int(size)))
        elif entry[:1] == b"D" and path not in (b".", b".."):
            tree.add_directory(b"/" + path)
        elif path.startswith(b"fifo"):
            tree.add_other(b"/" + path)
    if name != "mavsdk":
        tree.set_order(b"/", order)


def downloaded(steps: list[Step], step_name: str) -> bytes:
    step = next(step for step in steps if step.name == step_name)
    return data_of(step)


def build_virtual(name: str, steps: list[Step]) -> VirtualTrees | None:
    if name != "ardupilot":
        return None
    sys_files = dict.fromkeys(names(listed(steps, "list '@SYS'")), b"")
    sys_files[b"uarts.txt"] = downloaded(steps, "@SYS/uarts.txt: burst 239")
    sys_files[b"storage.bin"] = bytes(16384)
    locations = downloaded(steps, "@ROMFS/locations.txt: burst 239")
    return VirtualTrees(
        table=Table(unpacked(downloaded(steps, "@PARAM/param.pck: burst 239"))),
        sys_files=sys_files,
        romfs={b"locations.txt": locations, b"models/x": b""},
    )


# -- the replay ----------------------------------------------------------------------------------


def replay(name: str, steps: list[Step]) -> Iterator[tuple[Step, list[tuple[float, Payload]]]]:
    """Hand every request over at its time and yield each step with the simulated replies."""
    tree, virtual = build_tree(name, steps), build_virtual(name, steps)
    profile = replace(PROFILES[name], root_omits_files=name == "ardupilot")  # it was recorded under SITL
    server = FtpServer(tree, profile, rng=random.Random(1), virtual=virtual)
    ends = [step.requests[0][0] for step in steps[1:]] + [float("inf")]
    for step, end in zip(steps, ends, strict=True):
        replies: list[tuple[float, Payload]] = []
        for when, wire in step.requests:
            replies += collect(server, when)
            server.handle(wire, CLIENT, when)
        replies += collect(server, min(end, step.requests[-1][0] + 60))
        yield step, replies


def collect(server: FtpServer, until: float) -> list[tuple[float, Payload]]:
    """Return what the server sends up to `until`."""
    found = []
    while (due := server.next_deadline()) is not None and due <= until:
        for target, wire in server.outgoing(due):
            assert target == CLIENT
            found.append((due, decode_reply(wire)))
    return found


@pytest.mark.parametrize("name", NAMES)
def test_replies_are_those_of_the_real_server(name: str) -> None:
    steps = load(name)
    explained = EXPLAINED.get(name, {})
    for step, replies in replay(name, steps):
        simulated, real = [reply for _, reply in replies], [reply for _, reply in step.replies]
        if step.name in explained:
            assert simulated != real, f"{step.name}: no longer needs an explanation"
            assert all(reply in real for reply in simulated), step.name
        else:
            assert simulated == real, step.name
    assert sum(len(step.replies) for step in steps) > 1000


@pytest.mark.parametrize("name", NAMES)
def test_replies_take_as_long_as_those_of_the_real_server(name: str) -> None:
    """Virtual time against recorded time: within 25 % and 25 ms (the recordings have a host's hiccups)."""
    for step, replies in replay(name, load(name)):
        if not step.replies:
            continue
        start = step.requests[-1][0]
        real, simulated = step.replies[-1][0] - start, replies[-1][0] - start
        assert simulated == pytest.approx(real, rel=0.25, abs=0.025), step.name


def test_parameter_file_depends_on_the_block_size() -> None:
    """The recorded vehicle's file had 14882 bytes in blocks of 239 and 14901 in blocks of 80."""
    packed = downloaded(load("ardupilot"), "@PARAM/param.pck: burst 239")
    params = unpacked(packed)
    table = Table(params)
    assert table.download(Selection(), 239, 0) == packed
    assert len(table.download(Selection(), 80, 0)) == 14901
    assert unpacked(table.download(Selection(), 80, 0)) == params
