"""demo: what it starts is ended, whenever Ctrl-C comes."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from mavftpfs.cli import demo


def test_an_interrupt_while_a_process_is_being_started_leaves_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def interrupted(*args: Any, **more: Any) -> subprocess.Popen[bytes]:
        started.append(start(*args, **more))
        os.kill(os.getpid(), signal.SIGINT)
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", interrupted)
    with pytest.raises(KeyboardInterrupt), demo.vehicle([str(tmp_path)], tmp_path):
        pytest.fail("it went on")
    (process,) = started
    try:
        assert process.poll() is not None, "it was left to itself"
    finally:
        process.kill()
        process.wait()
