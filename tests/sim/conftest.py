"""Virtual time. Tier: sim."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest
from trio.testing import MockClock

from tests.support.clocks import use_virtual_time

REAL_TIME = ("test_endpoints", "test_hub", "test_impostors", "test_links")
"""Modules with sockets. A test of theirs runs on virtual time only if it asks for it."""


@pytest.fixture
def autojump() -> MockClock:
    """Virtual time for a test of a module with sockets: it jumps to whatever is waited for."""
    return MockClock(autojump_threshold=0)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Have all other tests of this tier run on virtual time."""
    for item in items:
        if _is_virtual(item.path):
            use_virtual_time(item)


@functools.cache
def _is_virtual(path: Path) -> bool:
    return path.parent == Path(__file__).parent and path.stem not in REAL_TIME
