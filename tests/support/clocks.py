"""Tests on virtual time: it jumps to whatever is waited for, so a machine that pauses changes nothing."""

from __future__ import annotations

import inspect
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
import trio
from trio.testing import MockClock


class HandClock:
    """Time that passes when a test says so."""

    def __init__(self, now: float = 0.0) -> None:
        self.now = now

    def __call__(self) -> float:
        """Return the time."""
        return self.now


def run(main: Callable[[], Awaitable[Any]], *, clock: trio.abc.Clock | None = None, **more: Any) -> Any:
    """Run a test on virtual time, also where it does not mention it."""
    return trio.run(main, clock=clock or MockClock(autojump_threshold=0), **more)


def use_virtual_time(item: pytest.Item) -> None:
    """Have a test run so, if it is one of trio's."""
    if isinstance(item, pytest.Function) and inspect.iscoroutinefunction(item.obj):
        item.add_marker(pytest.mark.trio(run=run))
