"""The demo: a newcomer's first command. It shows what it promises and leaves nothing behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mavftpfs.client.mountpoint import mounts
from tests.support.logs import suspects
from tests.support.mounts import abort_mount, processes_in, wait_until
from tests.support.vehicles import PROJECT

HANG = 120.0


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Path]:
    """The demo's TMPDIR; whatever of it is still mounted at the end is freed."""
    path = tmp_path / "two words"
    path.mkdir()
    yield path
    for mountpoint in mounts_in(path):
        abort_mount(Path(mountpoint))


def mounts_in(place: Path) -> list[str]:
    """Return what is mounted below a directory."""
    return [path for path in mounts() if path.startswith(f"{place}/")]


def start_demo(place: Path) -> subprocess.Popen[str]:
    """Start it as `scripts/demo` does, without a terminal."""
    return subprocess.Popen(
        [sys.executable, "-m", "mavftpfs", "demo"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=PROJECT,
        env={**os.environ, "TMPDIR": str(place), "COLUMNS": "100"},
    )


def assert_nothing_is_left(place: Path) -> None:
    """No file, no mount, no process."""
    wait_until("all processes ended", lambda: not processes_in(place))
    assert list(place.iterdir()) == []
    assert mounts_in(place) == []


def test_the_demo_shows_the_tour_and_cleans_up(place: Path, tmp_path: Path) -> None:
    """The directory for temporary files is reached by a symbolic link."""
    (tmp_path / "link").symlink_to(place)
    demo = start_demo(tmp_path / "link")
    out, _ = demo.communicate(timeout=HANG)
    assert demo.returncode == 0, out
    assert suspects(out) == []
    shown = " ".join(out.split())  # lines are folded where a path is long
    for words in ("cat drone", "PX4 1/1, disarmed, link ", "sed -i", "diff -r", "Every byte was right"):
        assert words in shown
    assert_nothing_is_left(place)


@pytest.mark.holds("fault cancel")
def test_a_demo_that_is_stopped_cleans_up(place: Path) -> None:
    demo = start_demo(place)
    assert demo.stdout is not None
    seen = ""
    while "cp drone" not in seen:
        line = demo.stdout.readline()
        assert line, seen
        seen += line
    demo.send_signal(signal.SIGINT)
    rest, _ = demo.communicate(timeout=HANG)
    assert demo.returncode == 130, seen + rest
    assert suspects(seen + rest) == []
    assert_nothing_is_left(place)
