"""The time that unit tests run on. Tier: unit."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.clocks import use_virtual_time

REAL_TIME = ("test_control", "test_kernel", "test_watching")
"""Modules with threads, sockets and programs, which virtual time would not wait for."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Have all tests of this tier run on virtual time."""
    for item in items:
        if item.path.parent == Path(__file__).parent and item.path.stem not in REAL_TIME:
            use_virtual_time(item)
