"""mv over a file that a slow link has not brought to the card yet."""

from __future__ import annotations

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import wait_until
from tests.support.trees import content

SLOW = ("--rate", "3000", "--delay", "0.05")
SIZE = 200_000
"""Takes over a minute on that link: more than a change of names waits for anything."""


@pytest.mark.holds("fault overlap")
def test_the_name_goes_while_cp_waits_for_the_card(field: Field) -> None:
    """cp is in its close(), and is told that all is well: nothing is owed for a file without a name."""
    card, disk = field.local("card"), field.local("disk")
    (card / "other").write_text("other\n")
    (disk / "big").write_bytes(content("big", SIZE))
    vehicle = field.sim(card, "px4", SLOW)
    mount = field.mount(vehicle.source, "dirty_max=1M")
    with mount.started("cp", disk / "big", mount.path / "big") as cp:
        wait_until("a part is on the card", lambda: max(p.stat().st_size for p in card.iterdir()) > 5000)
        assert not (card / "big").exists()
        mount.run("mv", mount.path / "other", mount.path / "big")
        assert cp.wait(50) == 0
    assert mount.run("ls", "-A", mount.path).stdout.split() == ["big"]
    assert {path.name: path.read_text() for path in card.iterdir()} == {"big": "other\n"}
    assert mount.unmount() == 0
