"""Privileges that some tests need beyond a mount, and the runs of those tests without them.

A test names its needs: `@pytest.mark.needs("root")`. Root runs it as any other test. For an ordinary user
`sudo -n` runs it in a pytest of root's, because only the whole test, with its mounts and vehicles, can be
root's. Where a need is missing the test does not run, and the last lines of the run name it and the reason.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

SUDO = ("sudo", "-n")
TIMEOUT = 300.0
"""Seconds for one test of root's: longer than any wait in it."""
_MARK = "not run without "


def _why_no_root() -> str:
    """Return why nothing can run as root, "" if it can."""
    if os.geteuid() == 0:
        return ""
    if shutil.which(SUDO[0]) is None:
        return "there is no sudo"
    return _complaint(*SUDO, "true")


def _why_no_namespaces() -> str:
    return _why_no_root() or _complaint(*_root_prefix(), "unshare", "--mount", "--net", "true")


def _why_no_safe_python() -> str:
    """Return who else could change the Python of these tests: `mavftpfs install` refuses such a program."""
    program = Path(os.path.realpath(sys.executable))
    others = [path for path in (program, *program.parents) if path.stat().st_uid != 0]
    return _why_no_root() or (f"{others[-1]} is not root's" if others else "")


NEEDS: dict[str, tuple[str, Callable[[], str]]] = {
    "root": ("root", _why_no_root),
    "namespaces": ("root and namespaces of its own", _why_no_namespaces),
    "root's Python": ("a Python that only root can change", _why_no_safe_python),
}
"""Each need of tests: the words for it, and the function that returns why it is missing."""


def _complaint(*command: str) -> str:
    """Return what a command says when it fails, "" if it succeeds."""
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=TIMEOUT, check=False
    )
    if done.returncode == 0:
        return ""
    return (done.stderr.strip().splitlines() or [f"{command[0]} ended with {done.returncode}"])[-1]


def _root_prefix() -> tuple[str, ...]:
    return () if os.geteuid() == 0 else SUDO


@cache
def _missing(need: str) -> str:
    """Return the whole reason why a need is missing, "" if it is there."""
    words, why = NEEDS[need]
    reason = why()
    return f"{words} ({reason})" if reason else ""


class AsRoot(pytest.Item):
    """A test that a pytest of root's runs."""

    def runtest(self) -> None:
        """Run it; it must pass."""
        words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", self.nodeid]
        done = subprocess.run(
            [*SUDO, "env", "PYTHONDONTWRITEBYTECODE=1", *words],
            cwd=self.config.rootpath,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=TIMEOUT,
            check=False,
        )
        if done.returncode != 0 or "1 passed" not in done.stdout:
            pytest.fail(f"as root:\n{done.stdout}", pytrace=False)

    def reportinfo(self) -> tuple[Path, None, str]:
        """Return how a report calls it."""
        return self.path, None, self.name


def arranged(items: list[pytest.Item]) -> Iterator[pytest.Item]:
    """Yield the tests, each as this user can run it: itself, by root's pytest, or not at all."""
    for item in items:
        needs = [str(need) for mark in item.iter_markers("needs") for need in mark.args]
        reason = next(filter(None, map(_missing, needs)), "")
        if reason:
            item.add_marker(pytest.mark.skip(reason=_MARK + reason))
        elif needs and os.geteuid() != 0:
            assert item.parent is not None
            handed: AsRoot = AsRoot.from_parent(item.parent, name=item.name)
            handed.own_markers.extend(mark for mark in item.own_markers if mark.name != "trio")
            yield handed
            continue
        yield item


@pytest.hookimpl(trylast=True)  # other plugins expect functions
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Arrange the tests."""
    items[:] = arranged(items)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Iterator[None]:
    """Name what did not run, after all else."""
    yield
    write_summary(terminalreporter)


def write_summary(reporter: pytest.TerminalReporter) -> None:
    """Name the tests that did not run, by reason."""
    reasons: dict[str, list[str]] = {}
    for report in reporter.getreports("skipped"):
        _, _, text = report.longrepr if isinstance(report.longrepr, tuple) else (0, 0, "")
        _, found, reason = str(text).partition(_MARK)
        if found:
            reasons.setdefault(reason, []).append(report.nodeid)
    for reason, tests in reasons.items():
        count = "1 test" if len(tests) == 1 else f"{len(tests)} tests"
        reporter.write_line(f"{_MARK}{reason}: {count}", yellow=True)
        for test in sorted(tests):
            reporter.write_line(f"  {test}")
