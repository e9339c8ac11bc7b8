"""client.flights: when logs are looked at and fetched, and when a vehicle is let alone."""

from __future__ import annotations

import pytest

from mavftpfs.client.flights import (
    GROWN,
    MOST_GROWN,
    MOST_RETRY,
    PATIENCE,
    QUIET,
    RETRY,
    Fetch,
    Log,
    Look,
    Policy,
    Wait,
)

A, B = Log(b"/log/a", 100), Log(b"/log/b", 200)


class Story:
    """A policy and its clock; the vehicles send a heartbeat each second."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.policy = Policy()
        self.armed: dict[int, bool] = {}

    def hears(self, system: int = 1, *, armed: bool = False) -> str:
        self.armed[system] = armed
        return self.policy.heard(system, armed, self.now)

    def passes(self, seconds: float) -> None:
        for _ in range(int(seconds)):
            self.now += 1.0
            for system, armed in self.armed.items():
                self.policy.heard(system, armed, self.now)

    def does(self) -> object:
        return self.policy.next(self.now)

    def looks(self, *logs: Log, system: int = 1) -> None:
        assert self.does() == Look(system)
        self.policy.looked(system, logs, self.now)

    def wait_for(self) -> float:
        """Return for how long nothing is to be done, and let it pass."""
        step = self.does()
        assert isinstance(step, Wait)
        span = step.until - self.now
        self.passes(span)
        return span


@pytest.fixture
def story() -> Story:
    made = Story()
    made.hears()
    return made


def test_a_log_that_grows_is_waited_for_and_then_fetched_as_it_is(story: Story) -> None:
    size, began = 100, story.now
    while isinstance(step := story.does(), Look | Wait):
        if isinstance(step, Look):
            size += 10
            story.policy.looked(1, [Log(b"/log/a", size)], story.now)
        else:
            story.wait_for()
    assert PATIENCE <= story.now - began < PATIENCE + 2 * QUIET
    assert story.does() == Fetch(1, Log(b"/log/a", size))


def test_what_grows_for_ever_is_looked_at_more_and_more_seldom(story: Story) -> None:
    story.passes(PATIENCE)
    story.looks(A)
    assert story.does() == Fetch(1, A)
    assert story.policy.grows(1, A, story.now) is True
    spans = []
    for size in range(101, 112):
        spans.append(story.wait_for())
        story.policy.looked(1, [Log(A.path, size)], story.now)
    assert spans[:3] == [GROWN, GROWN, 2 * GROWN]
    assert max(spans) <= MOST_GROWN
    story.passes(MOST_GROWN)
    story.looks(Log(A.path, 111))
    assert story.does() == Fetch(1, Log(A.path, 111))
    assert story.policy.grows(1, Log(A.path, 111), story.now) is False  # it was said


def test_a_log_that_grew_while_it_was_fetched_soon_after_the_flight_is_not_worth_a_word(story: Story) -> None:
    story.looks(A)
    story.passes(QUIET)
    story.looks(A)
    assert story.policy.grows(1, A, story.now) is False
    assert story.wait_for() == QUIET
    story.looks(B)


def test_what_fails_is_tried_again_later_and_later_and_does_not_hinder_others(story: Story) -> None:
    story.passes(PATIENCE)
    story.looks(A, B)
    story.policy.failed(1, A, story.now)
    assert story.does() == Fetch(1, B)
    story.policy.failed(1, B, story.now)
    spans = []
    for _ in range(8):
        spans.append(story.wait_for())
        assert story.does() == Look(1)
        story.policy.failed(1, None, story.now)
    assert spans[0] == RETRY
    assert spans == sorted(spans)
    assert spans[-1] == MOST_RETRY


def test_the_vehicle_that_is_served_goes_on_first(story: Story) -> None:
    story.hears(2)
    story.looks(A, system=1)
    story.looks(B, system=2)
    story.passes(QUIET)
    story.looks(B, system=2)  # the last one that was served
    assert story.does() == Fetch(2, B)
    story.policy.fetched(2, B)
    story.looks(A, system=1)
    assert story.does() == Fetch(1, A)
    story.hears(1, armed=True)
    assert story.policy.may_transfer(2, story.now)


def test_a_restart_counts_as_the_end_of_a_flight_but_not_in_flight(story: Story) -> None:
    story.looks()
    story.policy.restarted(1, story.now)
    story.looks()
    story.hears(armed=True)
    story.policy.restarted(1, story.now)
    assert isinstance(story.does(), Wait)
    story.policy.restarted(77, story.now)
