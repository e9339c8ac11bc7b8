"""Order and clock of the tiers, and hypothesis profiles. Fixtures of one tier live in its own conftest."""

from __future__ import annotations

import functools
import logging
import os
import signal
import tempfile
import weakref
from collections.abc import Callable, Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pytest
import trio
import trio._core._run as scheduler
from hypothesis import HealthCheck, settings

from mavftpfs.cache.pathlocks import PathLocks
from mavftpfs.session.scheduler import Scheduler, Turn
from tests.support.clocks import use_virtual_time

pytest_plugins = ("tests.support.privileges",)

TIERS = ("unit", "property", "sim", "ops", "api", "mount")
"""Lower tiers run first, so that the first failure is the one nearest to its cause."""

VIRTUAL = ("unit", "sim")
"""Their tests run on virtual time, but for those that are marked `real_time`."""

TESTS = Path(__file__).parent

settings.register_profile(
    "default",
    deadline=None,  # no assertion on wall time
    derandomize=True,  # the same examples at every run: what fails here fails everywhere
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile(
    "soak", parent=settings.get_profile("default"), derandomize=False, max_examples=2000
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))


@pytest.fixture(scope="session", autouse=True)
def surroundings(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Give all programs the same surroundings. What they leave in TMPDIR goes with pytest's own. Ctrl-C
    and a hang-up end them, also where the tests run with these ignored (`&`, nohup). Modes are as usual, and
    only a terminal is taken for one. Modules stay compiled, as in an installation: else each of the many
    programs compiles all of them again."""
    for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, handler)
    os.umask(0o022)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(tmp_path_factory.mktemp("t")))
        patch.setattr(tempfile, "tempdir", None)
        for name in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
            patch.delenv(name, raising=False)
        if TESTS.stat().st_uid == os.geteuid():  # root leaves nothing in an ordinary user's checkout
            patch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)
        yield


@pytest.fixture(scope="session", autouse=True)
def state_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where the daemons keep what is not delivered: not in the home of the user that runs the tests."""
    path = tmp_path_factory.mktemp("state")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(path))
        yield path


@pytest.fixture(autouse=True)
def order_of_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seed what trio draws the order of ready tasks with: what fails once fails again. Its own door to this
    is for hypothesis alone."""
    monkeypatch.setattr(scheduler, "_ALLOW_DETERMINISTIC_SCHEDULING", True)
    scheduler._r.seed(0)


@pytest.fixture(autouse=True)
def nobody_waits_in_a_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that no task that has the session waits for a path, a node or memory for reads: a task that has
    one of these may wait for the session."""
    schedulers: weakref.WeakSet[Scheduler] = weakref.WeakSet()
    set_holder = Scheduler._set_holder

    def noting(one: Scheduler, turn: Turn | None) -> None:
        schedulers.add(one)
        set_holder(one, turn)

    def guarded(wait: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(wait)
        def waiting(*args: Any, **kwargs: Any) -> Any:
            for one in list(schedulers):
                one.assert_no_turn()
            return wait(*args, **kwargs)

        return waiting

    monkeypatch.setattr(Scheduler, "_set_holder", noting)
    for owner, name in ((PathLocks, "hold"), (trio.Lock, "acquire"), (trio.Semaphore, "acquire")):
        monkeypatch.setattr(owner, name, guarded(getattr(owner, name)))


@pytest.fixture(autouse=True)
def log_levels() -> Iterator[None]:
    """Leave no test's log levels to the next: a command run in this process sets them for good."""
    loggers = [logging.getLogger(name) for name in (None, "mavftpfs", "mavftpfs.cache")]
    levels = [logger.level for logger in loggers]
    yield
    for logger, level in zip(loggers, levels, strict=True):
        logger.setLevel(level)


@functools.cache
def tier_of(path: Path) -> str:
    """Return the directory below tests/ that a test file lies in."""
    return path.relative_to(TESTS).parts[0]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Sort by tier, mark the mount tier, and give virtual time."""
    for item in items:
        tier = tier_of(item.path)
        if tier == "mount":
            item.add_marker(pytest.mark.mount)
        if tier in VIRTUAL and item.get_closest_marker("real_time") is None:
            use_virtual_time(item)
    rank = {tier: number for number, tier in enumerate(TIERS)}
    items.sort(key=lambda item: rank.get(tier_of(item.path), len(TIERS)))
    if hasattr(config, "workerinput"):
        items[:] = packed(items)


def packed(items: list[pytest.Item]) -> list[pytest.Item]:
    """Order files for workers that take one at a time: those that wait for a kernel and those that compute
    in turns, then the others, so that none is left running alone at the end. A long text takes long."""
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    longest = sorted(files, key=lambda path: -path.stat().st_size)
    waiting = [path for path in longest if tier_of(path) in ("mount", "api")]
    computing = [path for path in longest if tier_of(path) == "sim"]
    turns = [path for pair in zip_longest(waiting, computing) for path in pair if path is not None]
    rest = [path for path in longest if path not in turns]
    return [item for path in (*turns, *rest) for item in files[path]]
