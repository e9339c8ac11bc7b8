"""Many things at once, and large things: the mount stays responsive and small."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import Mount
from tests.support.trees import content

FRESH_DIRECTORIES = 60
COPIES_AT_MOST = 4
MIB = 1 << 20
SEVERAL_SECONDS = 10_000_000
"""Bytes that take so long."""


@pytest.mark.holds("promise 7")
def test_ls_overtakes_a_large_copy(field: Field, tmp_path: Path) -> None:
    card = field.local("card")
    (card / "large0.bin").write_bytes(content("large", SEVERAL_SECONDS))
    for number in range(1, COPIES_AT_MOST):
        os.link(card / "large0.bin", card / f"large{number}.bin")
    for number in range(FRESH_DIRECTORIES):
        (card / f"fresh{number}").mkdir()
        (card / f"fresh{number}" / f"file{number}").touch()
    mount = field.mount(field.mavsdk(card).source)
    fresh, beside = iter(range(FRESH_DIRECTORIES)), 0
    for attempt in range(COPIES_AT_MOST):  # a program kept from working for seconds needs a second one
        with mount.started("cp", mount.path / f"large{attempt}.bin", tmp_path / "copy") as copy:
            for number in fresh:
                time.sleep(0.1)
                if copy.poll() is not None or beside >= 5:
                    break
                names = mount.run("ls", mount.path / f"fresh{number}").stdout
                assert names == f"file{number}\n"
                beside += copy.poll() is None
            _, errors = copy.communicate(timeout=300)
        assert (copy.returncode, errors) == (0, "")
        assert (tmp_path / "copy").read_bytes() == (card / "large0.bin").read_bytes()
        if beside >= 5:
            break
    assert beside >= 5, "ls waits for the copy"


SLACK = 12 * MIB
"""Bytes that a long transfer may take beside what is held: buffers, and what Python keeps of freed ones."""


def peaks(mount: Mount, source: Path, target: Path) -> tuple[int, int]:
    """Copy a small file and then a large one; return the peak memory after each, in bytes."""
    found = []
    for name in ("small", "large"):
        mount.run("cp", source / name, target / name, timeout=300)
        found.append(mount.alive().peak_memory())
    return found[0], found[1]


def two_files(folder: Path, large: int) -> Path:
    """Make a file of a megabyte and one of `large` bytes."""
    (folder / "small").write_bytes(content("small", MIB))
    (folder / "large").write_bytes(content("memory", large))
    return folder


@pytest.mark.holds("promise 8")
def test_memory_is_bounded_while_reading_ten_times_the_cache(field: Field, tmp_path: Path) -> None:
    cache = 2 * MIB
    card = two_files(field.local("card"), 10 * cache)
    mount = field.mount(field.sim(card).source, f"cache_size={cache}")
    before, after = peaks(mount, mount.path, tmp_path)
    assert (tmp_path / "large").read_bytes() == (card / "large").read_bytes()
    assert after <= cache + 60 * MIB
    assert after - before <= cache + SLACK


@pytest.mark.holds("promise 8")
def test_memory_is_bounded_while_writing(field: Field) -> None:
    """Bytes that the vehicle does not provably have yet wait on the local disk."""
    cache = 2 * MIB
    card, local = field.local("card"), two_files(field.local("local"), 16 * MIB)
    mount = field.mount(field.sim(card).source, f"cache_size={cache}")
    before, after = peaks(mount, local, mount.path)
    assert (card / "large").read_bytes() == (local / "large").read_bytes()
    assert after <= cache + 60 * MIB
    assert after - before <= SLACK


OPEN_ALL = """
import concurrent.futures, os, sys
def read(name):
    for attempt in range(3):
        try:
            with open(os.path.join(sys.argv[1], name), "rb") as file:
                return name, file.read()
        except OSError as error:
            failed = error
    return name, failed
names = sys.argv[2:]
with concurrent.futures.ThreadPoolExecutor(len(names)) as pool:
    print("started", flush=True)
    for name, data in pool.map(read, names):
        print(name, data.hex() if isinstance(data, bytes) else data)
"""


@pytest.mark.holds("promise 8")
def test_120_blocked_opens_do_not_freeze_df(field: Field) -> None:
    card = field.local("card")
    names = [f"file{number}" for number in range(120)]
    for number, name in enumerate(names):
        (card / name).write_bytes(content(name, number % 5))
    vehicle = field.sim(card)
    mount = field.mount(vehicle.source, "dir_timeout=600", "op_deadline=600")  # stat is to need no vehicle
    mount.run("ls", mount.path)
    vehicle.pause()
    with mount.started(sys.executable, "-c", OPEN_ALL, mount.path, *names) as readers:
        assert readers.stdout is not None
        readers.stdout.readline()
        time.sleep(1.0)
        mount.run("df", mount.path)
        mount.run("stat", mount.path / names[0])
        vehicle.resume()
        out, errors = readers.communicate(timeout=120)
    assert readers.returncode == 0, errors
    read = dict(line.partition(" ")[::2] for line in out.splitlines())
    assert read == {name: (card / name).read_bytes().hex() for name in names}
