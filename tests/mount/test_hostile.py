"""A vehicle that lies: every answer is a documented errno, never a hang, a traceback, or a wrong byte.

Deadlines are short here; that each command ends is what `Mount.run` insists on.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.hostile import BROKEN, FINE, GOOD, GOOD_NAMES, NAKED
from tests.support.mounts import Mount, mounted_at

QUICK = ("op_deadline=6", "dir_timeout=600")
REFUSALS = {
    "open": {4: "EBUSY", 8: "EBUSY", 9: "EACCES"},
    "read": {9: "EACCES"},
}
"""What a program is told where a code stands for more than EIO; unit/test_errnos.py has them all. 8 may be
PX4's last refusal, of whatever (servers.md 12); while reading, 4 and 8 mean that the session is gone, again
and again."""

MAX_RESIDENT = 150 << 20
"""Bytes; far above what a capped listing needs, far below what an endless one would take."""


@pytest.fixture(scope="module")
def liar(module_field: Field) -> Mount:
    """A mount of the vehicle with hostile listings and broken files."""
    mount = module_field.mount(module_field.hostile("files").source, *QUICK)
    mount.allowed_log = ("took longer than its deadline",)
    return mount


@pytest.mark.holds("promise 10")
def test_only_usable_names_enter_the_tree(liar: Mount) -> None:
    out = liar.python("import os, sys; print(ascii(sorted(os.listdir(sys.argv[1]))))", liar.path / "names")
    assert out.strip() == ascii(sorted(GOOD_NAMES))


@pytest.mark.holds("fault odd listing")
def test_good_files_among_bad_names_are_readable(liar: Mount) -> None:
    for name in sorted(GOOD_NAMES):
        assert liar.read_bytes(liar.path / "names" / name) == GOOD


@pytest.mark.holds("promise 8")
@pytest.mark.parametrize("directory", ["endless", "same"])
def test_endless_listings_end_with_an_error(liar: Mount, directory: str) -> None:
    error = liar.errno_of("os.listdir(sys.argv[1])", liar.path / directory, timeout=120)
    assert error in {"EIO", "ETIMEDOUT"}
    assert liar.alive().peak_memory() < MAX_RESIDENT
    assert liar.run("cat", liar.path / "names/good.txt").stdout == GOOD.decode()


READ_ALL_AT_ONCE = """
import concurrent.futures, errno, sys
def read(path):
    try:
        return len(open(path, "rb").read())
    except OSError as error:
        return errno.errorcode[error.errno]
with concurrent.futures.ThreadPoolExecutor(len(sys.argv)) as pool:
    print(*pool.map(read, sys.argv[1:]))
"""


@pytest.mark.holds("promise 1")
def test_a_file_that_cannot_be_completed_is_an_error(liar: Mount) -> None:
    paths = [liar.path / "broken" / name for name in BROKEN]
    errors = liar.python(READ_ALL_AT_ONCE, *paths, timeout=120).split()
    assert len(errors) == len(BROKEN)
    assert set(errors) <= {"EIO", "ESTALE", "ETIMEDOUT"}
    assert liar.read_bytes(liar.path / "fine.bin") == FINE


@pytest.mark.holds("fault NAK")
@pytest.mark.parametrize("step", ["open", "read"])
@pytest.mark.parametrize("code", NAKED)
def test_every_refusal_has_an_errno(liar: Mount, step: str, code: int) -> None:
    error = liar.errno_of("open(sys.argv[1], 'rb').read()", liar.path / "nak" / f"{step}{code}", timeout=120)
    assert error == REFUSALS[step].get(code, "EIO")


@pytest.mark.holds("promise 1", "promise 10", "fault corrupt")
def test_noise_and_forged_replies_change_nothing(field: Field) -> None:
    mount = field.mount(field.hostile("noise").source)
    assert mount.read_bytes(mount.path / "fine.bin") == FINE
    for name in sorted(GOOD_NAMES):
        assert mount.read_bytes(mount.path / "names" / name) == GOOD


def test_a_vehicle_that_never_answers_ftp_is_exit_2(field: Field) -> None:
    vehicle = field.hostile("mute")
    assert vehicle.process is not None
    vehicle.await_ready(vehicle.process)  # its first heartbeat must come in time
    mount = field.prepare(vehicle.source)
    result = mount.run(
        sys.executable, "-m", "mavftpfs", vehicle.source, mount.path, "-o", "connect_timeout=8", code=2
    )
    assert len(result.stderr.splitlines()) == 1, result.stderr
    assert "FTP" in result.stderr
    assert not mounted_at(mount.path)


@pytest.mark.holds("promise 10")
@pytest.mark.parametrize(("directory", "shown"), [("same", ["same_for_ever"]), ("refused", [])])
def test_programs_end_with_an_error_where_a_directory_was_not_listed_to_its_end(
    liar: Mount, tmp_path: Path, directory: str, shown: list[str]
) -> None:
    """`same` repeats its first page for ever, and listing `refused` is refused as if it were not there. A
    backup must not lose what they do not show."""
    backup = tmp_path / "backup"
    backup.mkdir()
    (backup / "kept").write_text("shown by no page")
    where = liar.path / directory
    assert liar.run("ls", where, code=2).stdout.split() == shown
    liar.run("find", where, code=1)
    liar.run("rsync", "-a", "--delete", f"{where}/", backup, code=23)
    assert (backup / "kept").exists()
    get = (
        sys.executable,
        "-m",
        "mavftpfs",
        "get",
        "-r",
        "--to",
        tmp_path,
        liar.path,
        "/names",
        f"/{directory}",
    )
    complaints = liar.run(*get, code=2).stderr.splitlines()
    assert [f"/{directory}" in line for line in complaints] == [True]
    assert (tmp_path / "names" / "good.txt").read_bytes() == GOOD
