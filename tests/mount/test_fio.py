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
    "mixed sizes": ("--rw=randwrite", "--bsrange=512-7000", "--bs_unaligned=1", "--numjobs=1"),
    "read and write": ("--rw=randrw", "--bs=1024", "--numjobs=2"),
    "mapped": ("--ioengine=mmap", "--rw=randwrite", "--bs=4096", "--numjobs=1"),
}
FEW = ("sequential", "random", "mapped")


BLOCKS = {"sequential": 1237, "random": 600, "mapped": 4096}
"""Jobs of which each block is written once, so that the files can be verified afterwards."""


def run_fio(mount: Mount, place: Place, job: str, size: int, seed: int = 1) -> None:
    """Run a job in an empty directory of the mount; what it wrote is verified again on the card itself."""
    name = job.replace(" ", "-")
    folder = mount.path / place.folder / name
    mount.run("mkdir", folder)
    size -= size % BLOCKS.get(job, 1024)  # fio leaves out a last part of a block
    argv = [*COMMON, *JOBS[job], f"--size={size}", f"--randseed={seed}", f"--name={name}"]
    mount.run("fio", f"--directory={folder}", *argv, timeout=600)
    card = place.card / name
    assert [path.stat().st_size for path in card.iterdir()]
    if job in BLOCKS:
        mount.run("fio", f"--directory={card}", *argv, "--verify_only=1", timeout=120)
    mount.run("rm", "-r", folder)


@pytest.fixture(scope="module", params=[REAL])
def mounted(request: pytest.FixtureRequest, module_field: Field) -> tuple[Mount, Place]:
    """A mount of an empty card."""
    place = start_place(module_field, request.param)
    return module_field.mount(place.vehicle.source, *place.options), place


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("job", FEW)
def test_fio_reads_back_what_it_wrote(mounted: tuple[Mount, Place], job: str) -> None:
    run_fio(*mounted, job, 150_000)


@pytest.mark.soak
@pytest.mark.parametrize("job", JOBS)
@pytest.mark.parametrize("kind", ["px4", "px4-nuttx", "ardupilot", "ardupilot5", "littlefs", "mavsdk", REAL])
def test_fio_for_long_over_a_bad_link(field: Field, kind: str, job: str) -> None:
    place = start_place(field, kind, ("--loss", "0.01", "--seed", "3"))
    mount = field.mount(place.vehicle.source, *place.options)
    for seed in range(2):
        run_fio(mount, place, job, 600_000, seed=seed)
