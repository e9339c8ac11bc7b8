"""Virtual time. Tier: sim."""

from __future__ import annotations

from pathlib import Path

import pytest
from trio.testing import MockClock

from tests.support.clocks import use_virtual_time


@pytest.fixture
def autojump() -> MockClock:
    """Virtual time: it jumps to whatever is waited for."""
    return MockClock(autojump_threshold=0)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give virtual time also to tests that only use a fixture which asks for it."""
    for item in items:
        virtual = {"autojump", "autojump_clock"} & set(getattr(item, "fixturenames", ()))
        if virtual and item.path.parent == Path(__file__).parent:
            use_virtual_time(item)
