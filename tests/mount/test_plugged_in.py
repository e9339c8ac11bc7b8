"""The systemd unit by use: its own commands, as systemd would run them, on a simulated serial port."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

from mavftpfs.cli import install
from tests.mount.conftest import Field
from tests.support.mounts import abort_mount, mounted_at, wait_until


def commands(unit: str, key: str, home: Path, device: str, options: str) -> list[list[str]]:
    """Return the commands of one key, with what systemd puts in place of % and $."""
    places = {"%h": str(home), "%I": device, "%i": device.replace("/", "-"), "${MAVFTPFS_OPTIONS}": options}
    found = []
    for line in re.findall(rf"^{key}=-?(.*)$", unit, re.MULTILINE):
        words = shlex.split(line)
        for mark, text in places.items():
            words = [word.replace(mark, text) for word in words]
        found.append(words)
    return found


def run(*words: str) -> None:
    """Run one command as systemd does: without a shell and with a bound."""
    subprocess.run(words, check=True, timeout=90, stdin=subprocess.DEVNULL)


def test_the_unit_mounts_and_unmounts(field: Field, tiny_tree: Path, tmp_path: Path) -> None:
    vehicle = field.sim(tiny_tree, link="pty")
    device = vehicle.source.partition(",")[0].removeprefix("/dev/")
    program = tmp_path / "mavftpfs"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m mavftpfs "$@"\n')
    program.chmod(0o755)
    unit = install._unit(program)
    mountpoint = tmp_path / f"drone-{device.replace('/', '-')}"

    def take(key: str) -> None:
        for words in commands(unit, key, tmp_path, device, "ro"):
            run(*words)

    try:
        take("ExecStartPre")
        take("ExecStart")
        assert mounted_at(mountpoint)
        shown = subprocess.run(
            ["cat", mountpoint / "README.txt"], capture_output=True, timeout=60, check=True
        )
        assert shown.stdout == (tiny_tree / "README.txt").read_bytes()
        take("ExecStop")
        wait_until("it is unmounted", lambda: not mounted_at(mountpoint))
        take("ExecStopPost")
        assert not mountpoint.exists()
    finally:
        abort_mount(mountpoint)
