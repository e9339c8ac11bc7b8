"""cli.watching: the command that is run for each log."""

from __future__ import annotations

import shlex
import time
from pathlib import Path

import pytest
import trio

from mavftpfs.cli.watching import run_command

pytestmark = pytest.mark.real_time


@pytest.mark.parametrize(
    ("command", "problem", "shown"),
    [
        ("cat", "", "a log\n"),
        ("head -c 3", "", "a l\n"),
        ("printf 'x\\033[31m\\n' && cat", "", "x?[31m\na log\n"),
        ("exit 3;", "--exec ended with exit code 3", ""),
        ("no-such-program", "--exec ended with exit code 127", None),
        ("sleep 60 & echo here; true", "", "here\n"),
    ],
)
async def test_a_command_gets_the_file_and_says_how_it_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, problem: str, shown: str | None
) -> None:
    file = tmp_path / "1 log's.ulg"
    file.write_text("a log")
    assert await run_command(command, file, limit=60.0) == problem
    if shown is not None:
        assert capsys.readouterr().out == shown


async def test_a_command_that_takes_too_long_is_ended_with_all_that_it_started(tmp_path: Path) -> None:
    sign = tmp_path / "sign"
    command = f"(sleep 1; touch {shlex.quote(str(sign))}) & sleep 600; true"
    began = time.monotonic()
    problem = await run_command(command, tmp_path, limit=0.5)
    assert problem == "--exec took longer than 500 ms and was ended"
    assert time.monotonic() - began < 60.0
    await trio.sleep(1.5)
    assert not sign.exists()
