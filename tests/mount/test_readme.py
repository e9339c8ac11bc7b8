"""README's commands, run as they stand there: only the vehicle's address is a simulated one's."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import COMMAND_TIMEOUT, abort_mount, install_programs, mounted_at
from tests.support.vehicles import HOST, PROJECT

README = (PROJECT / "README.md").read_text()
LOG = "fs/microsd/log/2026-11-20/10_32_15.ulg"

SOURCES = {
    "udpin:0.0.0.0:14550": "",
    "udpout:192.168.4.1:14550": "udpin",
    "tcp:192.168.1.10:5760": "tcpin",
    "/dev/ttyACM0": "pty",
    "/dev/ttyUSB0,57600": "pty",
}
"""README's addresses, and the kind of link that a simulated vehicle waits on for each."""


def block(heading: str) -> list[str]:
    """Return the command lines of a section."""
    section = README.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    return [line.partition("  #")[0].strip() for line in re.findall(r"^    (\S.*)$", section, re.MULTILINE)]


MOUNTING = [line for line in block("Mount") if line.startswith("mavftpfs") and line.endswith(" ~/drone")]
MOUNTS = [line for line in MOUNTING if line.split()[1] in SOURCES]


class Home:
    """A user's home with a shell in it; `drone` is a vehicle's card."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.card = path / "card"
        self.mountpoint = path / "drone"
        (self.card / LOG).parent.mkdir(parents=True)
        (self.card / LOG).write_bytes(os.urandom(30_000))
        (self.card / "fs/microsd/etc").mkdir()
        (self.card / "APM/scripts").mkdir(parents=True)
        (self.card / "APM/scripts/hover.lua").write_text("return 1\n")
        (path / "params.txt").write_text("param set COM_DISARM_LAND 2\n")
        install_programs(path)

    def run(self, line: str) -> str:
        """Run a line of README in a shell and return its output; it must succeed."""
        done = subprocess.run(
            ["bash", "-c", line],
            cwd=self.path,
            env={**os.environ, "HOME": str(self.path), "PATH": f"{self.path}:{os.environ['PATH']}"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=COMMAND_TIMEOUT,
            check=False,
        )
        assert done.returncode == 0, f"{line}: exit {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout


@pytest.fixture
def home(tmp_path: Path, field: Field) -> Iterator[Home]:
    """A home; its mount is taken away before its vehicle ends."""
    place = Home(tmp_path)
    yield place
    abort_mount(place.mountpoint)


def with_vehicle(line: str, home: Home, field: Field, profile: str) -> str:
    """Start the vehicle that a line of README speaks of, and return the line with its address."""
    address = line.split()[1]
    kind = SOURCES[address]
    link = {"udpin": f"udpin:{HOST}:0", "tcpin": f"tcpin:{HOST}:0"}.get(kind, kind or None)
    return line.replace(address, field.sim(home.card, profile, link=link).source)


@pytest.mark.parametrize("line", MOUNTS)
def test_mounting(line: str, home: Home, field: Field) -> None:
    for command in block("Mount"):
        if command in MOUNTS:
            if command == line:
                home.run(with_vehicle(command, home, field, "px4"))
                assert mounted_at(home.mountpoint)
        else:
            home.run(command)
    assert not mounted_at(home.mountpoint)


def test_all_ways_to_mount_are_tried() -> None:
    assert [line.split()[1] for line in MOUNTS] == list(SOURCES)


@pytest.mark.parametrize("number", range(3))
def test_copying_the_logs(number: int, home: Home, field: Field) -> None:
    line = block("Copy the logs")[number]
    if line.split()[-2].startswith("~/drone"):
        home.mountpoint.mkdir()
        home.run(with_vehicle(MOUNTS[0], home, field, "px4"))
        home.run(line)
        home.run("mavftpfs umount ~/drone")
    else:
        words = line.split()
        home.run(line.replace(words[2], with_vehicle(f"mavftpfs {words[2]}", home, field, "px4").split()[1]))
    copy = home.path / "logs" / Path(LOG).relative_to("fs/microsd/log")
    assert copy.read_bytes() == (home.card / LOG).read_bytes()


def test_editing(home: Home, field: Field) -> None:
    home.mountpoint.mkdir()
    home.run(with_vehicle(MOUNTS[0], home, field, "ardupilot"))
    vim, cp, cat = block("Edit")
    home.run(vim.replace("vim ", "vim -es -V1 -u NONE -c 's/1/2/' -c wq "))
    assert (home.card / "APM/scripts/hover.lua").read_text() == "return 2\n"
    home.run(cp)
    assert (home.card / "fs/microsd/etc/params.txt").read_text() == (home.path / "params.txt").read_text()
    assert home.run(cat) != ""
    home.run("mavftpfs umount ~/drone")


def test_parameters(home: Home, field: Field) -> None:
    home.mountpoint.mkdir()
    home.run(with_vehicle(MOUNTS[0], home, field, "ardupilot"))
    vim, save, diff = block("Parameters")
    home.run(save)
    home.run(vim.replace("vim ", "vim -es -V1 -u NONE -c '%s/^RTL_ALT,.*/RTL_ALT,3000/' -c wq "))
    assert home.run("grep ^RTL_ALT, ~/drone/@PARAM/params.parm") == "RTL_ALT,3000\n"
    assert home.run(f"{diff} || test $? = 1").split()[-3:] == ["RTL_ALT", "3000", "1500"]
    home.run(diff.replace("--diff", "--load"))
    home.run(diff)
    home.run("mavftpfs umount ~/drone")


def told_keys(command: str) -> set[str]:
    """Return the names of keys in the page's paragraph or table on `COMMAND --json`, without examples."""
    page = (PROJECT / "docs/json.md").read_text()
    part = page.partition(f"`{command} --json")[2]
    part = re.split(r"\n\n(?:`\w+ --json|## )", part)[0]
    rows = re.findall(r"^\| (`[^|]*`) \|", part, re.MULTILINE)
    text = "".join(rows) if rows else re.sub(r"\([^)]*\)", "", part.partition(".")[0])
    return set(re.findall(r"`(\w+)`", text))


def inner_keys(group: str) -> set[str]:
    """Return the keys that the page names for one group of `status --json`."""
    page = (PROJECT / "docs/json.md").read_text()
    row = re.search(rf"^\| `{group}` \| (.*) \|$", page, re.MULTILINE)
    assert row is not None
    return set(re.findall(r"`(\w+)`", re.sub(r"\([^)]*\)", "", row[1])))


def test_the_page_names_the_keys_of_json(home: Home, field: Field) -> None:
    home.mountpoint.mkdir()
    home.run(with_vehicle(MOUNTS[0], home, field, "px4"))
    status = json.loads(home.run("mavftpfs status --json ~/drone"))
    assert told_keys("status") - {"members", "vehicles"} == set(status)  # those two: of several mounts
    for group in ("vehicle", "link", "held"):
        assert inner_keys(group) == set(status[group])
    (entry,) = json.loads(home.run(f"mavftpfs ls --json ~/drone /{LOG}"))
    assert told_keys("ls") == set(entry)
    (found,) = json.loads(home.run("mavftpfs scan --json ~/drone"))
    assert told_keys("scan") == set(found)
    home.run("mavftpfs umount ~/drone")
