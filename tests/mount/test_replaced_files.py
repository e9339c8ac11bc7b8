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


STATING = """
import os, sys, time
path, card, by_name = sys.argv[1:]
old = os.open(path, os.O_RDONLY)
number = os.fstat(old).st_ino
with open(card + ".new", "wb") as file:
    file.write(b"NEW")
os.replace(card + ".new", card)
while os.stat(path).st_size != 3 if by_name else os.fstat(old).st_nlink:
    assert os.fstat(old).st_size == 900, os.fstat(old)
    time.sleep(0.02)
last = os.fstat(old)
assert (last.st_nlink, last.st_size, last.st_ino) == (0, 900, number), last
assert os.stat(path).st_ino != number
"""


@pytest.mark.parametrize("by_name", ["by name", ""])
def test_the_old_handle_shows_no_attributes_of_the_new_file(field: Field, by_name: str) -> None:
    card = field.local("card")
    (card / "file.bin").write_bytes(b"old" * 300)
    mount = field.mount(field.sim(card, "px4").source, "dir_timeout=0.1")
    mount.python(STATING, mount.path / "file.bin", card / "file.bin", by_name, timeout=60)


def test_tail_follows_the_name_to_the_new_file(field: Field) -> None:
    card = field.local("card")
    (card / "file.txt").write_bytes(b"old line\n" * 100)
    mount = field.mount(field.sim(card, "px4").source, "dir_timeout=0.1")
    with mount.started("tail", "-F", "-s", "0.2", mount.path / "file.txt") as tail:
        assert tail.stdout is not None
        assert tail.stdout.readline() == "old line\n"
        (card / "new.txt").write_text("new line\n")
        (card / "new.txt").replace(card / "file.txt")
        while (line := tail.stdout.readline()) == "old line\n":
            pass
        assert line == "new line\n"
