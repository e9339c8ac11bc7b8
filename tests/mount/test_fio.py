"""fio writes with odd block sizes, at random, in several jobs, and reads everything back checked."""

from __future__ import annotations

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import Mount
from tests.support.places import REAL, Place, start_place

COMMON = (
    "--ioengine=psync",
    "--fallocate=none",
    "--verify=crc32c",
    "--verify_fatal=1",
    "--end_fsync=1",
    "--thread",
    "--group_reporting",
    "--output-format=terse",
    "--verify_state_save=0",
)
JOBS: dict[str, tuple[str, ...]] = {
    "sequential": ("--rw=write", "--bs=1237", "--numjobs=2", "--fsync=97"),
    "random": ("--rw=randwrite", "--bs=600", "--numjobs=2", "--fsync=41", "--random_generator=tausworthe64"),
    "mapped": ("--ioengine=mmap", "--rw=randwrite", "--bs=4096", "--numjobs=1"),
}
BLOCKS = {"sequential": 1237, "random": 600, "mapped": 4096}
"""Bytes. Each block is written once, so that the files can be verified afterwards."""


@pytest.fixture(scope="module")
def mounted(module_field: Field) -> tuple[Mount, Place]:
    """A mount of an empty card."""
    place = start_place(module_field, REAL)
    return module_field.mount(place.vehicle.source, *place.options), place


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("job", JOBS)
def test_fio_reads_back_what_it_wrote(mounted: tuple[Mount, Place], job: str) -> None:
    """And it is verified again on the card itself."""
    mount, place = mounted
    folder, card = mount.path / place.folder / job, place.card / job
    mount.run("mkdir", folder)
    size = 150_000 // BLOCKS[job] * BLOCKS[job]  # fio leaves out a last part of a block
    argv = [*COMMON, *JOBS[job], f"--size={size}", "--randseed=1", f"--name={job}"]
    mount.run("fio", f"--directory={folder}", *argv)
    assert [path.stat().st_size for path in card.iterdir()]
    mount.run("fio", f"--directory={card}", *argv, "--verify_only=1")
    mount.run("rm", "-r", folder)
