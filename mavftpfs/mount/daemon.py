"""Going to the background, and logging there. Layer: mount; imports no trio.

The fork happens before trio and threads start. The parent stays until the child reports success or failure
over a pipe. So `mavftpfs SOURCE DIR && ls DIR` works, and a failure has an exit code and a reason.
"""

from __future__ import annotations

import logging
import logging.handlers
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import NoReturn

from mavftpfs.shared.errors import SIGNALLED, ExitCode, MavftpfsError, exit_code_for
from mavftpfs.shared.options import Options
from mavftpfs.shared.private import make_private_directory, open_private
from mavftpfs.shared.readable import readable

Report = Callable[[int, str], None]
"""Called with (exit code, one line) for the command that waits for a mount: 0 and perhaps a notice once the
mount is up, otherwise the reason of the failure. Only the first call counts."""

SYSLOG_SOCKET = "/dev/log"
MAX_REPORT = 64 * 1024
_LOG_SIZE = 1 << 20
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end a parent that still waits, and its child."""


class _Ended(BaseException):
    """A signal told the waiting parent to end."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def in_background(work: Callable[[Report], int]) -> int:
    """Fork; run `work(report)` in the child, and return in the parent what the child reported.

    The child never returns from here. After report(0, ...) the child is detached: no terminal, cwd `/`.
    """
    read_end, write_end = os.pipe()
    sys.stdout.flush()
    sys.stderr.flush()
    # Python's own hooks around a fork would swallow an exception of a signal handler.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
    pid = os.fork()
    if pid == 0:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        os.close(read_end)
        _be_child(write_end, work)
    os.close(write_end)
    return _await_report(read_end, pid, mask)


def _be_child(write_end: int, work: Callable[[Report], int]) -> NoReturn:
    code: int = ExitCode.BUG
    reporter = _Reporter(write_end)
    try:
        os.setsid()
        code = work(reporter)
        reporter(code, "")
    except MavftpfsError as exc:
        code = exit_code_for(exc)
        reporter(code, str(exc))
    except BaseException as exc:
        # Nothing above us: a bug must reach the log and the waiting parent, not vanish with the process.
        logging.getLogger("mavftpfs").exception("the daemon failed")
        reporter(code, f"internal error: {exc!r}; please report it with the log")
    finally:
        logging.shutdown()
        os._exit(code)


class _Reporter:
    def __init__(self, write_end: int) -> None:
        self._write_end: int | None = write_end

    def __call__(self, code: int, message: str) -> None:
        if self._write_end is None:
            return
        line = message.replace("\n", " ")[:4096]
        os.write(self._write_end, f"{code} {line}\n".encode("utf-8", "surrogateescape"))
        os.close(self._write_end)
        self._write_end = None
        if code == 0:
            _detach()


def _detach() -> None:
    """Detach from the terminal and the working directory."""
    os.chdir("/")
    null = os.open(os.devnull, os.O_RDWR)
    for fd in (0, 1, 2):
        os.dup2(null, fd)
    if null > 2:
        os.close(null)


def _await_report(read_end: int, pid: int, mask: set[int]) -> int:
    """Return the child's report; `mask`: the signals that were blocked before the fork."""
    try:
        with os.fdopen(read_end, "rb") as pipe, _ending_raises():
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            text = pipe.read(MAX_REPORT).decode("utf-8", "surrogateescape")
    except _Ended as exc:
        os.kill(pid, signal.SIGTERM)
        os.waitpid(pid, 0)
        return SIGNALLED + exc.number
    code, _, message = text.partition(" ")
    if not code:
        return _explain_death(pid)
    if message.strip():
        print(f"mavftpfs: {readable(message.strip())}", file=sys.stderr)
    return int(code)


def ending_signals() -> list[signal.Signals]:
    """Return the signals that end this program. A shell's nohup, or `&` in a script, makes it ignore some of
    them."""
    return [n for n in _ENDING if n == signal.SIGTERM or signal.getsignal(n) != signal.SIG_IGN]


@contextmanager
def _ending_raises() -> Iterator[None]:
    """Have these signals raise _Ended."""

    def end(number: int, _frame: object) -> NoReturn:
        raise _Ended(number)

    with _handled_by(end):
        yield


@contextmanager
def signals_held() -> Iterator[None]:
    """Delay these signals until after the body, because the processes that it starts would be left behind."""
    came: list[int] = []
    try:
        with _handled_by(lambda number, _: came.append(number)):
            yield
    finally:
        for arrived in came:
            signal.raise_signal(arrived)


@contextmanager
def _handled_by(handler: Callable[[int, object], None]) -> Iterator[None]:
    """Send these signals to a handler."""
    before = {number: signal.signal(number, handler) for number in ending_signals()}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _explain_death(pid: int) -> int:
    _, status = os.waitpid(pid, 0)
    code = os.waitstatus_to_exitcode(status)
    reason = f"signal {-code}" if code < 0 else f"exit code {code}"
    print(f"mavftpfs: the background process ended without a word ({reason})", file=sys.stderr)
    return ExitCode.MOUNT_FAILED


def log_to_stderr(level: int) -> None:
    """Log to the terminal, for foreground runs; beside a trace (-d) with the time of day."""
    times = "%(asctime)s.%(msecs)03d " if level == logging.DEBUG else ""
    _install(logging.StreamHandler(), f"{times}mavftpfs: %(message)s", level, times="%H:%M:%S")


class _PrivateFile(logging.handlers.RotatingFileHandler):
    """Appends to a file that is made 0600. Without maxBytes it is never rotated."""

    def _open(self) -> TextIOWrapper:
        return open(open_private(self.baseFilename, os.O_WRONLY | os.O_APPEND), "a", encoding="utf-8")


def log_in_background(fallback: Path, level: int, *, socket: str = SYSLOG_SOCKET) -> None:
    """Log to syslog; without one, to a small file that is rotated."""
    form = f"mavftpfs[{os.getpid()}]: %(levelname)s %(name)s: %(message)s"
    handler: logging.Handler
    if Path(socket).is_socket():  # the handler itself says nothing about a missing one
        handler = logging.handlers.SysLogHandler(socket)
    else:
        make_private_directory(fallback.parent)
        handler = _PrivateFile(fallback, maxBytes=_LOG_SIZE, backupCount=1)
        form = f"%(asctime)s {form}"
    _install(handler, form, level)


def warn_of_gone(options: Options) -> None:
    """Log a line about each removed option of 0.2 that was given."""
    for line in options.gone:
        logging.getLogger("mavftpfs").warning("%s", line)


class _Readable(logging.Formatter):
    """Shows names in readable form; local names may be invalid text."""

    def format(self, record: logging.LogRecord) -> str:
        """See logging.Formatter."""
        return super().format(record).encode("utf-8", "backslashreplace").decode()

    def formatMessage(self, record: logging.LogRecord) -> str:
        """See logging.Formatter."""
        return readable(super().formatMessage(record))


def _install(handler: logging.Handler, form: str, level: int, times: str | None = None) -> None:
    handler.setFormatter(_Readable(form, times))
    root = logging.getLogger()
    for old in root.handlers[:]:
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(logging.WARNING)
    logging.getLogger("mavftpfs").setLevel(level)
