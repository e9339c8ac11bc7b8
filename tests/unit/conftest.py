"""What tests of the writing tree share, and the time they run on. Tier: unit."""

from __future__ import annotations

import inspect
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import Tree
from tests.support.fake_writer import FakeWriter, make_writable

REAL_TIME = ("test_control", "test_kernelnews")
"""Modules with threads and sockets, which virtual time would not wait for."""


def run(main: Callable[[], Awaitable[Any]], *, clock: trio.abc.Clock | None = None, **more: Any) -> Any:
    """Run a test on virtual time also where it does not mention it: a machine that pauses for seconds changes
    nothing then, not even the age of what was listed a moment ago."""
    return trio.run(main, clock=clock or MockClock(autojump_threshold=0), **more)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Have all tests of this tier run so."""
    for item in items:
        is_here = item.path.parent == Path(__file__).parent and item.path.stem not in REAL_TIME
        if is_here and isinstance(item, pytest.Function) and inspect.iscoroutinefunction(item.obj):
            item.add_marker(pytest.mark.trio(run=run))


@pytest.fixture
def tree(store: FakeWriter) -> Tree:
    """A tree that writes to the module's own `store` (see fake_writer.card)."""
    return make_writable(store)
