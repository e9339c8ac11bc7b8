"""client.watchpolicy: when logs are synced, and when a vehicle is let alone."""

from __future__ import annotations

import pytest

from mavftpfs.client.watchpolicy import (
    GROWN,
    LOST,
    MOST_GROWN,
    MOST_RETRY,
    PATIENCE,
    QUIET,
    REFUSED,
    RETRY,
    Log,
    Policy,
)

A, B = Log(b"/log/a", 100), Log(b"/log/b", 200)


class Story:
    """A policy and its clock; the vehicle sends a heartbeat each second."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.policy = Policy()
        self.armed = False

    def hears(self, *, armed: bool = False) -> str:
        self.armed = armed
        return self.policy.heard(armed, self.now)

    def passes(self, seconds: float) -> None:
        for _ in range(int(seconds)):
            self.now += 1.0
            self.policy.heard(self.armed, self.now)

    @property
    def due(self) -> bool:
        return self.policy.due(self.now)

    def syncs(self, *logs: Log) -> dict[bytes, bool]:
        """Sync; return what is chosen, and whether it grows."""
        assert self.due
        self.policy.begin()
        chosen = self.policy.choose(logs, self.now)
        for path, grows in chosen.items():
            if grows:
                self.policy.grew(path, self.now)
        self.policy.synced()
        return chosen

    def wait_for(self) -> float:
        """Return after how long the next sync is due, and let it pass."""
        began = self.now
        while not self.due:
            self.passes(1.0)
            assert self.now - began < 2 * MOST_GROWN
        return self.now - began


@pytest.fixture
def story() -> Story:
    made = Story()
    made.hears()
    return made


def test_a_log_that_grows_is_waited_for_and_then_fetched_as_it_is(story: Story) -> None:
    size, began = 100, story.now
    while not (chosen := story.syncs(Log(A.path, size))):
        story.wait_for()
        size += 10
    assert PATIENCE <= story.now - began < PATIENCE + 2 * QUIET
    assert chosen == {A.path: True}


def test_what_grows_for_ever_is_looked_at_more_and_more_seldom(story: Story) -> None:
    story.passes(PATIENCE)
    assert story.syncs(A) == {A.path: True}
    spans = []
    for size in range(101, 112):
        spans.append(story.wait_for())
        assert story.syncs(Log(A.path, size)) == {}
    assert spans[0] == GROWN
    assert spans == sorted(spans)
    assert spans[-1] == MOST_GROWN
    story.passes(MOST_GROWN)
    assert story.syncs(Log(A.path, 111)) == {A.path: False}
    assert not story.due


def test_a_log_that_grew_while_it_was_fetched_is_looked_at_again_soon(story: Story) -> None:
    assert story.syncs(A) == {}
    story.passes(QUIET)
    story.policy.begin()
    assert story.policy.choose([A], story.now) == {A.path: False}
    story.policy.grew(A.path, story.now)
    story.policy.synced()
    assert story.wait_for() == QUIET


def test_what_fails_is_tried_again_later_and_later(story: Story) -> None:
    spans = []
    for _ in range(8):
        story.policy.begin()
        story.policy.failed(story.now)
        story.policy.synced()
        spans.append(story.wait_for())
    assert spans[0] == RETRY
    assert spans == sorted(spans)
    assert spans[-1] == MOST_RETRY
    story.policy.begin()
    story.policy.arrived()
    story.policy.failed(story.now)
    story.policy.synced()
    assert story.wait_for() == RETRY


def test_a_sync_that_was_cancelled_stays_due(story: Story) -> None:
    story.policy.begin()
    story.policy.choose([A], story.now)
    story.policy.refused(story.now)
    assert not story.policy.may_transfer(story.now)
    assert story.wait_for() == REFUSED


@pytest.mark.holds("promise 9")
def test_an_armed_or_lost_vehicle_is_not_asked(story: Story) -> None:
    assert story.hears(armed=True) == "armed"
    assert not story.due
    assert story.hears() == "disarmed"
    story.now += LOST + 1
    assert story.policy.newly_lost(story.now)
    assert not story.policy.newly_lost(story.now)
    assert not story.due
    assert story.hears() == "back"
    assert story.due


def test_a_restart_counts_as_the_end_of_a_flight_but_not_in_flight(story: Story) -> None:
    story.syncs()
    assert not story.due
    story.policy.restarted(story.now)
    story.syncs()
    story.hears(armed=True)
    story.policy.restarted(story.now)
    assert not story.due


def test_what_happens_during_a_sync_counts_for_the_next(story: Story) -> None:
    story.policy.begin()
    story.policy.restarted(story.now)
    story.policy.choose([], story.now)
    story.policy.synced()
    assert story.due
