"""The next mount tells what a killed mount left, even if that mount is not the next one tried."""

from __future__ import annotations

import random
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.client.leftovers import spool_base
from mavftpfs.link.messages import Address
from mavftpfs.shared.errors import ExitCode
from tests.mount.conftest import Field
from tests.support.mounts import Mount, wait_until

LINE = re.compile(r"1 file\(s\) of an earlier mount did not reach their vehicle; they are in ([^;\n]+)")


def test_a_mount_that_fails_takes_no_news_away(
    field: Field, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = tmp_path / "state"
    state.mkdir()
    monkeypatch.setenv("XDG_STATE_HOME", str(state))
    dead = SpoolDirectory(spool_base(Address(1, 1)), random.Random(1))
    (dead.path / "000001.data").write_bytes(b"held")
    dead.close()
    source = field.sim(field.local("card")).source
    failing = Mount(source, field.local("mnt"), field.local("out"), ("root=/nothing",))
    ended = subprocess.run(
        [sys.executable, "-m", *failing.argv()], capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == ExitCode.USAGE, ended.stderr
    assert "earlier mount" not in ended.stderr
    assert (dead.path / "000001.data").read_bytes() == b"held"
    process = field.mount(source).alive()
    wait_until("it tells of them", lambda: LINE.search(process.text()) is not None)
    match = LINE.search(process.text())
    assert match is not None
    assert [path.read_bytes() for path in Path(match[1].strip()).iterdir()] == [b"held"]
