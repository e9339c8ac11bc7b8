"""Every kind of link, both ways round, clean and bad: the same bytes."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import Mount, wait_until
from tests.support.trees import COMPARE, content
from tests.support.vehicles import HOST, free_udp_port

FLAWS = ("--loss", "0.1", "--dup", "0.05", "--reorder", "0.05", "--corrupt", "0.02")
BAD = (*FLAWS, "--delay", "0.01", "--seed", "5")


def free_port_link(kind: str) -> str:
    """Return a link of the vehicle on a free port (a pty needs none)."""
    return kind if kind == "pty" else f"{kind}:{HOST}:{free_udp_port()}"


def size_of(path: Path) -> int:
    """Return a local file's size, 0 if it is not there yet."""
    return path.stat().st_size if path.exists() else 0


def compare(mount: Mount, expected: Path, part: str = "") -> None:
    """Compare the whole tree, or a directory of it, byte for byte."""
    mount.run(*COMPARE, expected / part, mount.path / part, timeout=240)


@pytest.mark.parametrize("kind", ["udpout", "pty"])
def test_each_kind_of_link(field: Field, tiny_tree: Path, kind: str) -> None:
    vehicle = field.sim(tiny_tree, "px4", BAD, link=free_port_link(kind))
    compare(field.mount(vehicle.source), tiny_tree, "sizes")


@pytest.mark.holds("promise 5", "fault reboot")
def test_a_reboot_in_mid_copy(field: Field, tmp_path: Path) -> None:
    card = field.local("card")
    data = content("reboot", 400_000)
    (card / "log.bin").write_bytes(data)
    vehicle = field.sim(card, "px4", ("--rate", "150000"), link=free_port_link("tcpin"))
    mount = field.mount(vehicle.source)
    with mount.started("cp", mount.path / "log.bin", tmp_path / "copy") as copy:
        wait_until("it is under way", lambda: size_of(tmp_path / "copy") > 0)
        vehicle.react(signal.SIGPWR)
        _, errors = copy.communicate(timeout=120)
    assert (copy.returncode, errors) == (0, "")
    assert (tmp_path / "copy").read_bytes() == data


@pytest.mark.holds("promise 5")
def test_tcp_comes_back_after_the_vehicle_did(field: Field, small_tree: Path) -> None:
    vehicle = field.sim(small_tree, link=free_port_link("tcpin"))
    mount = field.mount(vehicle.source, "op_deadline=8")
    assert mount.run("cat", mount.path / "deep/at0.txt").stdout == "level 0\n"
    vehicle.kill()
    vehicle.start()

    def back() -> bool:
        return mount.run("cat", mount.path / "deep/d0/at1.txt", code=None).stdout == "level 1\n"

    wait_until("files are readable again", back)
    compare(mount, small_tree)
