"""The window beside somebody who waits for a small answer, and after losses by chance."""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.flow import Flow
from tests.unit.test_flow import Path


def test_an_answer_that_is_waited_for_queues_behind_less() -> None:
    flow = Flow()
    path = Path(flow, rate=1000.0, base=0.1)
    path.rounds(20)
    flow.begin()
    flow.room(0, 100.0, paced=True, urgent=True)
    full = flow.window
    assert flow.room(full - 1, 100.0, paced=True) <= 0
    assert flow.room(full - 1, 100.0, paced=True, urgent=True) == 1
    flow.begin()
    assert flow.room(full - 1, 100.0, paced=True) == 1


@pytest.mark.parametrize("window", [1, 2, 4])
def test_bulk_goes_on_beside_it_even_in_a_small_window(window: int) -> None:
    flow = Flow(limit=window)
    flow.room(0, 100.0, paced=True, urgent=True)
    assert flow.room(0, 100.0, paced=True) >= 1


@pytest.mark.parametrize("seed", range(40))
def test_random_losses_at_the_start_are_not_taken_for_an_overflow(seed: int) -> None:
    """One request or answer in five is lost, as at 10 % each way; a false ceiling would last for minutes."""
    flow = Flow()
    path = Path(flow, rate=400.0, base=0.3)
    rng = random.Random(seed)
    for _ in range(16):
        path.round(lost=sum(rng.random() < 0.19 for _ in range(flow.window)))
    assert flow.window > 60


def test_reads_too_use_one_more_of_a_short_queue_of_ones_own() -> None:
    """Five at a look instead of four: 116 KiB/s instead of 93 from an ArduPilot close by."""
    flow = Flow()
    flow.set_queue_limit(4)
    assert flow.room(4, 0.0, paced=True) == 0
    flow.alone = True
    assert flow.room(4, 0.0, paced=True) == 1
    flow.room(4, 0.0, paced=True, urgent=True)
    assert flow.room(4, 0.0, paced=True) == 0, "left to who waits for a small answer"
