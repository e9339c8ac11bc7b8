"""Two mounts of one vehicle at once. They share its session: errors are allowed, wrong bytes are not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import Mount
from tests.support.places import FOLDERS, OPTIONS
from tests.support.vehicles import HOST, Program, free_udp_port

COPIER = """
import json, os, sys
root, mine, rounds = sys.argv[1], sys.argv[2], int(sys.argv[3])
confirmed = {}
for number in range(rounds):
    name = f"{mine}{number % 4}"
    data = bytes([65 + number]) * (700 + 900 * (number % 5)) + mine.encode()
    confirmed[name] = None
    try:
        with open(os.path.join(root, name), "wb", 0) as file:
            file.write(data)
            os.fsync(file.fileno())
        confirmed[name] = data.hex()
        with open(os.path.join(root, name), "rb") as file:
            back = file.read()
        assert back == data, (name, len(back), len(data))
        with open(os.path.join(root, "shared.bin"), "rb") as file:
            shared = file.read()
        assert shared == b"shared" * 2000, len(shared)
    except OSError as error:
        print(name, error.strerror, file=sys.stderr)
print(json.dumps(confirmed))
"""
"""Writes its own files again and again, reads them back and a file of both; prints what was confirmed."""


def start(mount: Mount, folder: str, name: str) -> subprocess.Popen[str]:
    argv = [sys.executable, "-c", COPIER, str(mount.path / folder), name, "5"]
    return subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def check(child: subprocess.Popen[str], card: Path) -> int:
    """Check that the card has every confirmed file; return how many these are."""
    out, errors = child.communicate(timeout=240)
    assert child.returncode == 0, errors
    confirmed = {name: bytes.fromhex(data) for name, data in json.loads(out).items() if data}
    for name, data in confirmed.items():
        assert (card / name).read_bytes() == data, name
    return len(confirmed)


OTHERS = ("px4", "px4-nuttx", "ardupilot", "ardupilot5")


@pytest.mark.holds("fault two mounts")
@pytest.mark.parametrize("kind", ["mavsdk", *(pytest.param(kind, marks=pytest.mark.soak) for kind in OTHERS)])
def test_two_mounts_at_once_confirm_nothing_wrong(field: Field, kind: str) -> None:
    root = field.local("card")
    card = root / FOLDERS[kind]
    card.mkdir(parents=True, exist_ok=True)
    (card / "shared.bin").write_bytes(b"shared" * 2000)
    ports = [free_udp_port() for _ in range(3)]
    argv = ["tests.support.proxy", *map(str, ports)]
    router = Program("router", argv, field.local("router"))
    vehicle = field.sim(root, kind, link=f"udpout:{HOST}:{ports[0]}")
    vehicle.left_alone = True  # each may have taken the other's session
    options = (*OPTIONS.get(kind, ()), "op_deadline=8")
    try:
        mounts = [
            field.mount(f"udpin:{HOST}:{ports[n]}", *options, f"source_system={255 - n}") for n in (1, 2)
        ]
        fill_at_once(mounts, FOLDERS[kind], card)
        assert "another FTP client of vehicle 1/1 is heard" in mounts[0].alive().text()
        for mount in mounts:  # the second one may have heard the first before it began to log
            assert mount.status()["link"]["other_ftp_client"]
        assert [mount.unmount() for mount in mounts] == [0, 0]
    finally:
        router.stop()


def fill_at_once(mounts: list[Mount], folder: str, card: Path) -> None:
    """Let each fill the card with its own files; what was confirmed is there, and nothing else."""
    children = [start(mount, folder, name) for mount, name in zip(mounts, "ab", strict=True)]
    counts = [check(child, card) for child in children]
    assert sum(counts) > 0, "at least one of them gets something done"
    known = {f"{mine}{number}" for mine in "ab" for number in range(4)} | {"shared.bin"}
    assert {name for name in os.listdir(card) if not name.startswith(".mavftpfs-")} <= known
