"""A file that somebody else replaced while it is open: the kernel has one page cache for both."""

from __future__ import annotations

import os

import pytest

from tests.mount.conftest import Field

pytestmark = pytest.mark.holds("fault replaced file")

PROGRAM = """
import errno, os, sys, time
path, card = sys.argv[1:]
old_bytes, new_bytes = b"old" * 300, b"NEW" * 300

def require_stale(fd):
    # What the kernel still holds of the old file is right, too.
    while True:
        try:
            got = os.pread(fd, 9, 300)
        except OSError as error:
            assert error.errno == errno.ESTALE, error
            return
        assert got == old_bytes[:9], got
        time.sleep(0.05)

old = os.open(path, os.O_RDONLY)
assert os.pread(old, 900, 0) == old_bytes
with open(card + ".new", "wb") as file:
    file.write(new_bytes)
os.utime(card + ".new", (1_600_000_000, 1_600_000_000))
os.replace(card + ".new", card)
while True:
    new = os.open(path, os.O_RDONLY)
    if os.read(new, 900) == new_bytes:
        break
    os.close(new)
    time.sleep(0.2)
require_stale(old)
assert os.fstat(old).st_nlink == 0
assert os.fstat(old).st_size == len(old_bytes)
assert os.fstat(old).st_ino != os.fstat(new).st_ino == os.stat(path).st_ino
with open(path, "r+b", 0) as writer:
    require_stale(old)
    writer.write(b"mid")
    require_stale(old)
    os.fsync(writer.fileno())
    require_stale(old)
for fd in (new, os.open(path, os.O_RDONLY)):
    assert os.pread(fd, 900, 0) == b"mid" + new_bytes[3:]
require_stale(old)
"""


def test_who_has_the_old_file_open_gets_nothing_of_the_new_one(field: Field) -> None:
    card = field.local("card")
    file = card / "file.bin"
    file.write_bytes(b"old" * 300)
    os.utime(file, (1_500_000_000,) * 2)
    mount = field.mount(field.sim(card, "ardupilot5").source, "dir_timeout=0.1")
    mount.python(PROGRAM, mount.path / "file.bin", file, timeout=60)
    assert file.read_bytes() == b"mid" + b"NEW" * 299


GROWING = """
import os, sys, time
path, card = sys.argv[1:]
old = os.open(path, os.O_RDONLY)
with open(card, "ab") as file:
    file.write(b"more")
while True:
    new = os.open(path, os.O_RDONLY)
    if os.pread(new, 900, 900) == b"more":
        break
    os.close(new)
    time.sleep(0.2)
assert os.pread(old, 904, 0) == os.pread(new, 904, 0) == b"old" * 300 + b"more"
assert os.fstat(old).st_ino == os.fstat(new).st_ino
"""


def test_a_file_that_grew_is_the_same_file(field: Field) -> None:
    card = field.local("card")
    (card / "file.bin").write_bytes(b"old" * 300)
    mount = field.mount(field.sim(card, "ardupilot5").source, "dir_timeout=0.1")
    mount.python(GROWING, mount.path / "file.bin", card / "file.bin", timeout=60)
