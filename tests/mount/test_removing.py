"""rm, and mv over it, of a file that a slow link has not brought to the card yet."""

from __future__ import annotations

import os

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import wait_until
from tests.support.trees import content

SLOW = ("--rate", "3000", "--delay", "0.05")
SIZE = 200_000
"""Takes over a minute on that link: more than a change of names waits for anything."""


@pytest.mark.parametrize("command", ["rm", "mv"])
def test_the_name_goes_while_cp_waits_for_the_card(field: Field, command: str) -> None:
    """cp is in its close(), and is told that all is well: nothing is owed for a file without a name."""
    card, disk = field.local("card"), field.local("disk")
    (card / "other").write_text("other\n")
    (disk / "big").write_bytes(content("big", SIZE))
    vehicle = field.sim(card, "px4", SLOW)
    mount = field.mount(vehicle.source, "dirty_max=1M")
    with mount.started("cp", disk / "big", mount.path / "big") as cp:
        there = card / "big"
        wait_until("a part is on the card", lambda: there.exists() and there.stat().st_size > 5000)
        if command == "rm":
            mount.run("rm", mount.path / "big")
            left = {"other"}
        else:
            mount.run("mv", mount.path / "other", mount.path / "big")
            left = {"big"}
        assert cp.wait(50) == 0
    assert set(mount.run("ls", "-A", mount.path).stdout.split()) == left
    assert {path.name for path in card.iterdir()} == left
    assert {path.read_text() for path in card.iterdir()} == {"other\n"}
    assert mount.unmount() == 0


@pytest.mark.parametrize(("command", "mode"), [("rm", "rb"), ("mv", "r+b")])
def test_a_file_goes_while_a_program_has_a_part_of_it(field: Field, command: str, mode: str) -> None:
    """Where nothing can be renamed: as on a local disk, the program goes on with all of it."""
    card, disk = field.local("card"), field.local("disk")
    old = content("old", SIZE)
    (card / "file").write_bytes(old)
    (disk / "file").write_bytes(b"new\n")
    vehicle = field.sim(card, "littlefs")
    mount = field.mount(vehicle.source)
    expected = bytearray(old)
    with open(mount.path / "file", mode, buffering=0) as file:
        assert os.pread(file.fileno(), 100, 1000) == old[1000:1100]
        if mode != "rb":
            expected[50_000:50_004] = b"here"
            os.pwrite(file.fileno(), b"here", 50_000)
        if command == "rm":
            mount.run("rm", mount.path / "file")
            assert os.listdir(card) == []
        else:
            mount.run("mv", disk / "file", mount.path / "file")
            assert (card / "file").read_bytes() == b"new\n"
        assert file.read() == expected
        if mode != "rb":
            os.pwrite(file.fileno(), b"more", SIZE)
            os.fsync(file.fileno())
            assert os.pread(file.fileno(), SIZE + 10, 0) == expected + b"more"
    assert [path.read_bytes() for path in card.iterdir()] == ([] if command == "rm" else [b"new\n"])
    assert mount.unmount() == 0
