"""Virtual time, and the same order of tasks at every run: what fails once fails again. Tier: sim."""

from __future__ import annotations

import pytest
import trio._core._run as scheduler
from trio.testing import MockClock


@pytest.fixture
def autojump() -> MockClock:
    """Virtual time: it jumps to whatever is waited for."""
    return MockClock(autojump_threshold=0)


@pytest.fixture(autouse=True)
def order_of_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seed what trio draws the order of ready tasks with; its own door to this is for hypothesis alone."""
    monkeypatch.setattr(scheduler, "_ALLOW_DETERMINISTIC_SCHEDULING", True)
    scheduler._r.seed(0)
