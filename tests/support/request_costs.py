"""Commands, and what each costs in requests, exactly, on each server; tests/mount/test_requests.py holds it.

Each starts with its directory's parent listed. Terminate and verification are included; nothing is lost.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.support.trees import content

PROFILES = ("px4", "px4-nuttx", "ardupilot", "ardupilot5", "mavsdk")
MOUNT = "mount"
SMALL = 300
"""Bytes of a small file: two ReadFiles, two WriteFiles."""

BIG = 1_000_000
PYTHON = shlex.quote(sys.executable)
STAT_STORM = (
    f"{PYTHON} -c 'import os, sys\n"
    "for number in range(1000):\n"
    "    os.path.exists(sys.argv[1] + str(number % int(sys.argv[2])))'"
)
THUMBNAIL = (
    f"{PYTHON} -c 'import os\n"
    'file = os.open("big", os.O_RDONLY)\n'
    "for offset in (0, 999000, 500000):\n"
    "    os.pread(file, 1000, offset)'"
)
RSYNC = 'rsync -a tree "$1"/'
GIT = "git -c gc.auto=0 -c core.fsmonitor=false"


def empty(folder: Path) -> None:
    """A directory with nothing in it."""


@dataclass(frozen=True, slots=True)
class Case:
    """One command; `$1` is an empty directory on the local disk.

    cost: on most servers. before: what runs first, uncounted. prepare: fills the directory on the card before
    it is mounted. aged: earlier listings have expired when the script starts.
    """

    name: str
    script: str
    cost: str
    before: str = ""
    prepare: Callable[[Path], None] = empty
    aged: bool = False


def small(folder: Path) -> None:
    """One small file."""
    (folder / "f").write_bytes(content("f", SMALL))


def ten(folder: Path) -> None:
    """Ten small files in a directory."""
    (folder / "ten").mkdir()
    for number in range(10):
        (folder / "ten" / f"{number}").write_bytes(content(str(number), SMALL))


def big(folder: Path) -> None:
    """One file that is far larger than any readahead of its beginning."""
    (folder / "big").write_bytes(content("big", BIG))


def tree(folder: Path) -> None:
    """Five directories with two files each, one of them empty."""
    for number in range(5):
        sub = folder / "tree" / f"d{number}"
        sub.mkdir(parents=True)
        (sub / "f").write_bytes(content(str(number), SMALL))
        (sub / "g").touch()


def repository(folder: Path) -> None:
    """A git repository with two files in one commit."""
    (folder / "a").write_bytes(content("a", SMALL))
    (folder / "sub").mkdir()
    (folder / "sub" / "b").write_bytes(content("b", SMALL))
    environment = {"GIT_CONFIG_GLOBAL": "/dev/null", "GIT_CONFIG_NOSYSTEM": "1", "PATH": "/usr/bin:/bin"}
    for words in (
        ("init", "-q", "--template=", "-b", "main"),
        ("add", "."),
        ("-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "-m", "first"),
    ):
        subprocess.run(["git", *words], cwd=folder, env=environment, check=True, timeout=30)


REWRITE = "open 1, create 1, read 2, write 2, close 2"
"""Fetch a small file, and send it under a temporary name."""

APPEND = f"{REWRITE}, crc 2, rename 1; 602 B"
"""The old file is compared once more before it is replaced."""

FIRST = Case("first append", "echo x >> f", f"{REWRITE}, crc 3, rename 1; 602 B", "ls -l", small)
"""The first change of a part of a file: what the server does when it is written to is found out, and whether
the rename did what its ACK says."""

SHORT = "create 1, write 1, close 1, crc 1, rename 1; 2 B"
LOCK = "create 1, close 1, remove 1"
VIM = "vim -es -u NONE -i NONE -c '%s/$/x/' -c wq f"
TEN = "open 10, create 10, write 20, close 10, crc 10, rename 10; 3000 B"
TWICE = f"{GIT} status --short; {GIT} status --short"

CASES = (
    FIRST,
    # What changes nothing. The second request of each directory tells that there is no more, the third that
    # nothing is hidden behind a name that fits no reply: at first, and when the number of names changed.
    Case("ls -l cold", "ls -l ten", "list 6", prepare=ten),
    Case("ls -l cached", "ls -l ten", "0", "ls -l ten", ten),
    Case("cat cold", "cat f > /dev/null", "open 1, read 2, close 1; 300 B", "ls -l", small),
    Case("cat warm", "cat f > /dev/null", "0", "cat f > /dev/null", small),
    Case("stat known names", f"{STAT_STORM} ten/ 10", "0", "ls -l ten", ten),
    Case("stat unknown names", f"{STAT_STORM} ten/no 1000", "0", "ls -l ten", ten),
    Case("find cold", "find tree > /dev/null", "list 21", prepare=tree),
    Case("find cached", "find tree > /dev/null", "0", "find tree > /dev/null", tree),
    Case("cp 10 files from it", 'cp ten/* "$1"/', "open 10, read 20, close 10; 3000 B", "ls -l ten", ten),
    Case("df", "df . > /dev/null", "0", prepare=small),
    # What the kernel asks for.
    Case("head of a big file", "head -c 100 big", "open 1, read 69, close 1; 16384 B", "ls -l", big),
    Case("thumbnail of a big file", THUMBNAIL, "open 1, read 107, close 1; 25152 B", "ls -l", big),
    # What changes the card. A file is sent, and its CRC32 compared. Is a new name free?
    Case("echo > new", "echo x > new", f"open 1, {SHORT}", "ls -l", aged=True),
    Case("echo > old", "echo x > f", SHORT, "ls -l", small),
    Case("echo >>", "echo x >> f", APPEND, "ls -l", small),
    Case("touch new", "touch new", "open 2, create 1, close 2, rename 1", "ls -l", aged=True),
    Case("touch old", "touch f", "open 1, close 1", "ls -l", small),
    Case("mkdir", "mkdir d", "mkdir 1", "ls -l"),
    Case("mv", "mv f g", "rename 1", "ls -l", small),
    Case("rm", "rm f", "remove 1", "ls -l", small),
    Case("rm -r", "rm -r ten", "list 3, remove 10, rmdir 1", "ls -l ten", ten),
    Case("vim save", VIM, f"{REWRITE}, crc 1, rename 1; 603 B", "ls -l", small),
    Case("cp 10 files to it", "cp ten/* .", TEN, "cat ten/* > /dev/null; ls -l", ten, aged=True),
    # Programs that look at everything.
    Case("rsync unchanged", RSYNC, "0", RSYNC, tree),
    # It makes a lock, and removes it.
    Case("git status again", f"{GIT} status --short", LOCK, TWICE, repository, aged=True),
)
COSTS = {case.name: case.cost for case in CASES} | {MOUNT: "list 4, open 1"}
# One listing tries opcode 16, the open whether there are parameters.
REPLACED = "rename 2, remove 1"  # FAT does not rename over a file, and NuttX removes it first
TIMED = f"list 3, {REWRITE}, crc 1"
"""Where listings tell times, one of them compares the old file. It shows the new one beside it, so it is also
asked what is behind its end."""

FAT = {
    "echo > old": f"create 1, write 1, close 1, crc 1, {REPLACED}; 2 B",
    "rm -r": "list 2, remove 10, rmdir 1",
    "vim save": f"{REWRITE}, crc 1, {REPLACED}; 603 B",
}
ELSEWHERE = {
    "px4-nuttx": {
        **FAT,
        "first append": f"{REWRITE}, crc 3, {REPLACED}; 602 B",
        "echo >>": f"{REWRITE}, crc 2, {REPLACED}; 602 B",
    },
    "ardupilot": {MOUNT: "list 4"},
    "ardupilot5": {
        **FAT,
        MOUNT: "list 3",
        # That it does not rename over a file is learnt, and the names are looked at after the refusal.
        "first append": f"list 6, {REWRITE}, crc 2, rename 3, remove 1; 602 B",
        "echo >>": f"{TIMED}, {REPLACED}; 602 B",
    },
    "mavsdk": {
        MOUNT: "list 3, open 1",
        "first append": f"list 3, {REWRITE}, crc 2, rename 1; 602 B",
        "echo >>": f"{TIMED}, rename 1; 602 B",
        "rm -r": "list 2, remove 10, rmdir 1",
    },
}
"""Where a server needs something else."""


SPARED = {"git status again": ["0", "create 1, close 2, remove 1"]}
"""git removes the lock that it has just made, often before anything of it was sent. If its CreateFile is on
the way just then, both sessions are closed that may be ours."""


def expected(profile: str, name: str) -> tuple[str, ...]:
    """Return what a command may cost there; the first is what it costs as a rule."""
    return (ELSEWHERE.get(profile, {}).get(name, COSTS[name]), *SPARED.get(name, ()))
