"""A program that is killed, a vehicle that restarts, in mid-copy, on every kind of server."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import wait_until
from tests.support.places import FOLDERS, start_place
from tests.support.trees import content

DATA = content("program", 60_000)
SLOW = ("--rate", "40000")
SHORT = ("px4",)
KINDS = [
    pytest.param(kind, marks=() if kind in SHORT else pytest.mark.soak)
    for kind in sorted(FOLDERS)
    if kind != "mavsdk-server"
]
WRITER = """
import sys, time
with open(sys.argv[1], "wb", 0) as file:
    data = open(sys.argv[2], "rb").read()
    for at in range(0, len(data), 5000):
        file.write(data[at : at + 5000])
        print(at, flush=True)
        time.sleep(0.05)
"""


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A file to be written."""
    path = tmp_path / "data.bin"
    path.write_bytes(DATA)
    return path


@pytest.mark.holds("fault killed program")
@pytest.mark.parametrize("kind", KINDS)
def test_a_killed_program_leaves_what_it_wrote(field: Field, kind: str, source: Path) -> None:
    """The kernel closes its files: what write() took arrives, as on a local disk."""
    place = start_place(field, kind, SLOW)
    mount = field.mount(place.vehicle.source, *place.options)
    target = mount.path / place.folder / "killed.bin"
    argv = [sys.executable, "-c", WRITER, str(target), str(source)]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        while int(writer.stdout.readline()) < 25_000:
            continue
        writer.kill()
    written = mount.read_bytes(target)
    assert len(written) >= 25_000
    assert DATA.startswith(written)
    wait_until("it arrives", lambda: (place.card / "killed.bin").read_bytes() == written)
    mount.run("cp", source, target)
    assert (place.card / "killed.bin").read_bytes() == DATA
