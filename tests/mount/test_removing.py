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


@pytest.mark.holds("fault overlap")
@pytest.mark.parametrize("command", ["rm", "mv"])
def test_the_name_goes_while_cp_waits_for_the_card(field: Field, command: str) -> None:
    """cp is in its close(), and is told that all is well: nothing is owed for a file without a name."""
    card, disk = field.local("card"), field.local("disk")
    (card / "other").write_text("other\n")
    (disk / "big").write_bytes(content("big", SIZE))
    vehicle = field.sim(card, "px4", SLOW)
    mount = field.mount(vehicle.source, "dirty_max=1M")
    with mount.started("cp", disk / "big", mount.path / "big") as cp:
        wait_until("a part is on the card", lambda: max(p.stat().st_size for p in card.iterdir()) > 5000)
        assert not (card / "big").exists()
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


def test_a_file_keeps_its_name_while_a_program_has_only_a_part_of_it(field: Field) -> None:
    """Where nothing can be renamed. Once all of it is known here, the program has it without a name too."""
    card, old = field.local("card"), content("old", SIZE)
    (card / "file").write_bytes(old)
    mount = field.mount(field.sim(card, "littlefs").source)
    with open(mount.path / "file", "rb", buffering=0) as file:
        assert os.pread(file.fileno(), 100, 1000) == old[1000:1100]
        assert "Device or resource busy" in mount.run("rm", mount.path / "file", code=1).stderr
        assert file.read() == old
        mount.run("rm", mount.path / "file")
        assert os.listdir(card) == []
        assert os.pread(file.fileno(), SIZE, 0) == old
    assert mount.unmount() == 0
