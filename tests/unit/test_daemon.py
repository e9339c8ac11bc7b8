"""daemon: what the parent is told, and what the child lets go of. Each fork is in a process of its own."""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from mavftpfs.mount import daemon
from mavftpfs.shared.readable import readable


def run(work: str, tmp_path: Path, timeout: float = 90.0) -> subprocess.CompletedProcess[str]:
    """Run `in_background(work)` in a fresh process; the body of `work` may use `report`, `here` and os."""
    code = f"""
import os, pathlib, signal, sys, time
from mavftpfs.mount.daemon import in_background
here = pathlib.Path({str(tmp_path)!r})
def work(report):
{textwrap.indent(textwrap.dedent(work), "    ")}
sys.exit(in_background(work))
"""
    argv = [sys.executable, "-c", code]
    return subprocess.run(argv, capture_output=True, text=True, timeout=timeout, check=False, cwd=tmp_path)


def wait_for(path: Path) -> str:
    deadline = time.monotonic() + 90
    while not path.exists() or not path.read_text():
        assert time.monotonic() < deadline, f"{path} never came"
        time.sleep(0.01)
    return path.read_text()


def test_success_frees_the_parent_and_detaches_the_child(tmp_path: Path) -> None:
    work = """
        report(0, "")
        report(3, "later words count for nothing")
        links = [os.readlink(f"/proc/self/fd/{fd}") for fd in (0, 1, 2)]
        facts = (os.getcwd(), os.getsid(0) == os.getpid(), links)
        (here / "facts.tmp").write_text(repr(facts))
        (here / "facts.tmp").rename(here / "facts")
        return 0
    """
    done = run(work, tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert wait_for(tmp_path / "facts") == repr(("/", True, ["/dev/null"] * 3))


@pytest.mark.parametrize(
    ("work", "code", "line"),
    [
        ('report(2, "no vehicle\\non that link")\nreturn 2', 2, "no vehicle on that link"),
        (
            "from mavftpfs.shared.errors import UsageError\nraise UsageError('not that log')",
            1,
            "not that log",
        ),
        ("raise ValueError('a bug')", 70, "internal error: ValueError('a bug')"),
        ("os.kill(os.getpid(), signal.SIGKILL)", 3, "signal 9"),
        ("os._exit(5)", 3, "exit code 5"),
    ],
)
def test_failure_is_the_parent_s_exit_code_and_line(tmp_path: Path, work: str, code: int, line: str) -> None:
    done = run(work, tmp_path)
    assert done.returncode == code
    assert line in done.stderr.splitlines()[-1]


AT_FORK = "os.register_at_fork(after_in_parent=lambda: os.kill(os.getpid(), signal.{}))"


@pytest.mark.parametrize(
    ("form", "number"), [("", signal.SIGTERM), (AT_FORK, signal.SIGINT)], ids=["later", "at once"]
)
def test_interrupting_the_parent_ends_the_child(tmp_path: Path, form: str, number: signal.Signals) -> None:
    at_fork = form.format(number.name)
    code = f"""
import os, pathlib, signal, sys, time
from mavftpfs.mount.daemon import in_background
{at_fork}
def work(report):
    pathlib.Path({str(tmp_path / "pid")!r}).write_text(str(__import__("os").getpid()))
    time.sleep(60)
sys.exit(in_background(work))
"""
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE) as parent:
        try:
            if not at_fork:
                wait_for(tmp_path / "pid")
                parent.send_signal(number)
            parent.communicate(timeout=90)
        finally:
            parent.kill()
    assert parent.returncode == 128 + number
    if (tmp_path / "pid").exists() and (pid := (tmp_path / "pid").read_text()):
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid), 0)


@pytest.fixture
def restored_logging() -> object:
    """Put the root logger back as it was."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    own_level = logging.getLogger("mavftpfs").level
    yield None
    for handler in root.handlers[:]:
        if handler not in handlers:
            root.removeHandler(handler)
            handler.close()
    for handler in handlers:
        if handler not in root.handlers:
            root.addHandler(handler)
    root.setLevel(level)
    logging.getLogger("mavftpfs").setLevel(own_level)


@pytest.mark.usefixtures("restored_logging")
def test_without_syslog_the_log_goes_to_a_small_private_file(tmp_path: Path) -> None:
    path = tmp_path / "state" / "mavftpfs.log"
    daemon.log_in_background(path, logging.INFO, socket=str(tmp_path / "nolog"))
    logging.getLogger("mavftpfs.mount").info("hello")
    assert "hello" in path.read_text()
    assert f"[{os.getpid()}]" in path.read_text()
    assert path.parent.stat().st_mode & 0o777 == 0o700


@pytest.mark.usefixtures("restored_logging")
def test_where_there_is_syslog_the_log_goes_there(tmp_path: Path) -> None:
    place, file = tmp_path / "devlog", tmp_path / "state" / "mavftpfs.log"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as syslog:
        syslog.bind(str(place))
        syslog.settimeout(20)
        daemon.log_in_background(file, logging.INFO, socket=str(place))
        logging.getLogger("mavftpfs.mount").info("hello")
        line = syslog.recv(1000).decode()
    assert f"mavftpfs[{os.getpid()}]: INFO mavftpfs.mount: hello" in line
    assert not file.exists()


def test_what_a_terminal_would_obey_is_shown_by_no_message() -> None:
    """A name may be in it as text already, as a vehicle listed it."""
    assert readable("/log\x1b[2J\x9b: one\r\n\ttwo") == "/log?[2J?: one?\n\ttwo"
