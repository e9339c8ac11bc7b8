"""The facts that a mount tells people and scripts about itself: `status`, and the log."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mavftpfs.shared.errors import ExitCode
from tests.mount.conftest import Field
from tests.support import terminal
from tests.support.mounts import COMMAND_TIMEOUT, Mount, abort_mount, command, wait_until
from tests.support.vehicles import PROJECT

STATUS = (sys.executable, "-m", "mavftpfs", "status")
CAT = ("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "cat")
AS_NOBODY = (sys.executable, str(PROJECT / "tests/support/programs/as_nobody.py"))


def logged(mount: Mount, text: str) -> None:
    """Wait until the mount's log holds a text."""
    wait_until(f"{text!r} in the log", lambda: text in mount.alive().text())


def test_the_log_has_one_line_for_each_thing_that_happens(field: Field, small_tree: Path) -> None:
    vehicle = field.sim(small_tree)
    mount = field.mount(vehicle.source)
    arm, cut, reboot = signal.SIGUSR1, signal.SIGUSR2, signal.SIGPWR
    for number, text in ((arm, "is armed"), (arm, "1/1 is disarmed"), (cut, "is lost")):
        vehicle.react(number)
        logged(mount, text)
    assert ": PX4 1/1, disarmed, LOST: last heard " in command("status", mount.path)[0]
    for number, text in ((cut, "is back"), (reboot, "restarted")):
        vehicle.react(number)
        logged(mount, text)
    lines = [line for line in mount.alive().text().splitlines() if "vehicle" in line]
    assert [re.sub(r" (for|after) [0-9].*", r" \1 TIME", line) for line in lines] == [
        "mavftpfs: vehicle 1/1 is armed: nothing is written to it until it is disarmed",
        "mavftpfs: vehicle 1/1 is disarmed",
        "mavftpfs: vehicle 1/1 is lost: no heartbeat for TIME",
        "mavftpfs: vehicle 1/1 is back after TIME",
        "mavftpfs: vehicle 1/1 restarted",
    ]


def test_what_is_read_is_shown_on_a_terminal(field: Field) -> None:
    card = field.local("card")
    name = "log/2026-11-20-with-a-rather-long-name-for-a-folder/10_32_15.ulg"
    (card / name).parent.mkdir(parents=True)
    (card / name).write_bytes(os.urandom(3_000_000))
    mount = field.mount(field.sim(card, options=("--rate", "60000")).source)
    with mount.started("cat", mount.path / name):
        wait_until("it is read", lambda: mount.bytes_read() > 0)
        screen = terminal.mavftpfs("status", "--watch", mount.path)
        screen.read_until(lambda _: screen.raw.count("reading") > 3)
        screen.interrupt()
        assert screen.finish() == 130
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", screen.raw)
    shown = " ".join(
        shown.rpartition(str(mount.path))[2].split()
    )  # the last picture stays; lines are wrapped
    assert ": PX4 1/1, disarmed, link " in shown
    assert re.search(r" reading .*10_32_15.ulg: \d+ % of 3.0 MB(, .* kB/s, .* left)?", shown), shown


def test_status_is_for_programs_too(field: Field, small_tree: Path) -> None:
    mount = field.mount(field.sim(small_tree).source)
    argv = [*STATUS, "--json", "--watch", str(mount.path)]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, cwd=PROJECT) as watch:
        assert watch.stdout is not None
        first, second = (json.loads(watch.stdout.readline()) for _ in range(2))
        assert second["uptime"] > first["uptime"] >= 0
        watch.send_signal(signal.SIGINT)
        assert watch.wait(COMMAND_TIMEOUT) == 130
    shown = command("status", mount.path)[0]
    assert re.sub(r"RTT \d+ ms|loss [0-9<]+ %|, [0-9.]+ k?B/s", "", shown).splitlines() == [
        f"{mount.path}: PX4 1/1, disarmed, link fine: , ",
        "  nothing is pending: the vehicle has all that was written",
    ]
    assert shown.isascii(), shown  # no boxes, no colours
    assert "\x1b" not in shown


def test_a_dead_mount_is_said_to_be_dead_and_watching_it_ends_when_it_is_cleared(
    field: Field, small_tree: Path
) -> None:
    vehicle = field.sim(small_tree)
    vehicle.left_alone = True
    mount = field.mount(vehicle.source)
    argv, pipe = [*STATUS, "--watch", str(mount.path)], subprocess.PIPE
    with subprocess.Popen(argv, stdout=pipe, stderr=pipe, text=True, cwd=PROJECT) as watch:
        assert watch.stdout is not None
        assert watch.stderr is not None
        assert "link fine" in watch.stdout.readline()
        mount.kill()
        try:
            assert any("DEAD: its program is gone" in line for line in watch.stdout)
            line = f"{mount.path}: DEAD: its program is gone; run: mavftpfs umount {mount.path}"
            assert command("status", mount.path, code=ExitCode.MOUNT_FAILED)[0] == f"{line}\n"
            assert line in command("status")[0].splitlines()
            facts = json.loads(command("status", "--json", mount.path)[0])
            assert (facts["state"], facts["source"]) == ("dead", vehicle.source)
            command("umount", mount.path)
            assert str(mount.path) not in command("status")[0]
        finally:
            abort_mount(mount.path)
        assert watch.wait(COMMAND_TIMEOUT) == ExitCode.MOUNT_FAILED
        assert watch.stderr.read() == f"mavftpfs: no vehicle of yours is mounted on {mount.path}\n"


def by_nobody(mount: Mount, *words: str | Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run a command of mavftpfs as another user."""
    return mount.run(*AS_NOBODY, *words, cwd=Path("/"), code=code)


@pytest.mark.needs("root")
@pytest.mark.holds("promise 10")
def test_another_user_is_told_in_a_line(
    open_field: Field, small_tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """He may neither unmount it nor read the state directory, which a careless su left in his environment."""
    mount = open_field.mount(open_field.sim(small_tree).source, "allow_other")
    state = mount.folder / "state"
    state.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_STATE_HOME", str(state))
    for words, code, why in (
        (("umount", mount.path), ExitCode.MOUNT_FAILED, "belongs to another user"),
        (("ls", mount.path), ExitCode.NO_VEHICLE, f"the mount on {mount.path}: belongs to another user"),
        (("recover",), ExitCode.USAGE, "Permission denied"),
    ):
        refused = by_nobody(mount, *words, code=code)
        assert len(refused.stderr.splitlines()) == 1
        assert why in refused.stderr
    shown = mount.run(*CAT, mount.path / "README.txt", cwd=Path("/")).stdout
    assert shown == (small_tree / "README.txt").read_text()
    assert str(mount.path) not in by_nobody(mount, "status").stdout
    assert (
        "belongs to another user" in by_nobody(mount, "status", mount.path, code=ExitCode.MOUNT_FAILED).stdout
    )
    refused = by_nobody(mount, "ls", mount.source, code=ExitCode.NO_VEHICLE)
    assert "of another user has this port" in refused.stderr


@pytest.mark.needs("root")
def test_another_user_does_not_see_what_he_may_not_read(open_field: Field, small_tree: Path) -> None:
    mount = open_field.mount(open_field.sim(small_tree).source)
    assert str(mount.path) not in by_nobody(mount, "status").stdout
    by_nobody(mount, "status", mount.path, code=ExitCode.MOUNT_FAILED)
