"""Virtual time. Tier: sim."""

from __future__ import annotations

import pytest
from trio.testing import MockClock


@pytest.fixture
def autojump() -> MockClock:
    """Virtual time: it jumps to whatever is waited for."""
    return MockClock(autojump_threshold=0)
