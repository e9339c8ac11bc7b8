"""The commands whose requests are counted. Each starts with its directory's parent listed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.support.requests import Case
from tests.support.trees import content

SMALL = 300
"""Bytes of a small file: two ReadFiles, two WriteFiles."""

BIG = 1_000_000
STAT_STORM = (
    f"{sys.executable} -c 'import os, sys\n"
    "for number in range(1000):\n"
    "    os.path.exists(sys.argv[1] + str(number % int(sys.argv[2])))'"
)
PROGRAMS = Path(__file__).parent / "programs"
THUMBNAIL = (
    f"{sys.executable} -c 'import os\n"
    'file = os.open("big", os.O_RDONLY)\n'
    "for offset in (0, 999000, 500000):\n"
    "    os.pread(file, 1000, offset)'"
)
RSYNC = 'rsync -a tree "$1"/'
GIT = "git -c gc.auto=0 -c core.fsmonitor=false"


def empty(folder: Path) -> None:
    """A directory with nothing in it."""


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


READING = (
    Case("ls -l cold", "ls -l ten", prepare=ten),
    Case("ls -l cached", "ls -l ten", "ls -l ten", ten),
    Case("cat cold", "cat f > /dev/null", "ls -l", small),
    Case("cat warm", "cat f > /dev/null", "cat f > /dev/null", small),
    Case("stat known names", f"{STAT_STORM} ten/ 10", "ls -l ten", ten),
    Case("stat unknown names", f"{STAT_STORM} ten/no 1000", "ls -l ten", ten),
    Case("find cold", "find tree > /dev/null", prepare=tree),
    Case("find cached", "find tree > /dev/null", "find tree > /dev/null", tree),
    Case("cp 10 files from it", 'cp ten/* "$1"/', "ls -l ten", ten),
    Case("df", "df . > /dev/null", prepare=small),
    Case("head of a big file", "head -c 100 big > /dev/null", "ls -l", big),
    Case("thumbnail of a big file", THUMBNAIL, "ls -l", big),
)
"""What changes nothing."""

FIRST = Case("first append", "echo x >> f", "ls -l", small)
"""The first change of a part of a file: what the server does when it is written to is found out."""

WRITING = (
    Case("echo > new", "echo x > new", "ls -l", empty, aged=True),
    Case("echo > old", "echo x > f", "ls -l", small),
    Case("echo >>", "echo x >> f", "ls -l", small),
    Case("touch new", "touch new", "ls -l", empty, aged=True),
    Case("touch old", "touch f", "ls -l", small),
    Case("mkdir", "mkdir d", "ls -l", empty),
    Case("mv", "mv f g", "ls -l", small, fresh=True),
    Case("rm", "rm f", "ls -l", small, fresh=True),
    Case("rm -r", "rm -r ten", "ls -l ten", ten, fresh=True),
    Case("vim save", "vim -es -u NONE -i NONE -c '%s/$/x/' -c wq f", "ls -l", small),
    Case("nano save", f"{sys.executable} {PROGRAMS / 'nano_save.py'} f", "ls -l", small),
    Case(
        "cp 10 files to it",
        "cp ten/* .",
        "cat ten/* > /dev/null; ls -l",
        ten,
        aged=True,
    ),
)
"""What changes the card."""

WHOLE = (
    Case("rsync unchanged", RSYNC, RSYNC, tree),
    Case(
        "git status again",
        f"{GIT} status --short",
        f"{GIT} status --short; {GIT} status --short",
        repository,
        aged=True,
    ),
)
"""Programs that look at everything."""

CASES = (FIRST, *READING, *WRITING, *WHOLE)
