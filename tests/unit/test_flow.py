"""The in-flight window: what it does on paths whose every round trip is known.

What it brings over whole links, with servers that pause or queue little: tests/sim/test_shares.py and
test_latency.py.
"""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.flow import MOST_SERIAL, Flow


class Path:
    """A path of a fixed rate (replies/s) and base round trip; the window is always full."""

    def __init__(self, flow: Flow, *, rate: float, base: float, start: float = 0.0) -> None:
        self.flow = flow
        self.rate = rate
        self.base = base
        self.now = start
        self.order = 0

    def round(self, *, lost: int = 0) -> None:
        window = self.flow.window
        rtt = max(self.base, window / self.rate)
        first = self.order
        self.order += window
        for index in range(window):
            self.now += rtt / window
            if index < lost:
                self.flow.on_loss(first + index)
            else:
                self.flow.on_replies(self.now, rtt, 1, first + index, self.order)

    def rounds(self, count: int, *, lost: int = 0) -> None:
        for _ in range(count):
            self.round(lost=lost)


def test_grows_to_what_the_path_holds_and_not_far_beyond() -> None:
    flow = Flow()
    path = Path(flow, rate=2000.0, base=0.1)
    path.rounds(40)
    assert 200 <= flow.window <= 400, "at most a tenth of a second more"


def test_random_loss_does_not_shrink_it() -> None:
    flow = Flow()
    path = Path(flow, rate=1000.0, base=0.1)
    path.rounds(20)
    path.rounds(40, lost=10)
    assert flow.window >= 80
    assert flow.loss == pytest.approx(10 / flow.window, rel=0.2)


def test_loss_with_a_standing_queue_brakes_and_comes_back() -> None:
    flow = Flow()
    path = Path(flow, rate=1000.0, base=0.1)
    path.rounds(20)
    before = flow.window
    path.rate = 300.0
    path.rounds(4, lost=5)
    assert flow.window < 0.6 * before
    path.rate = 1000.0
    path.rounds(60)
    assert flow.window >= 100, "what fills the path"


@pytest.mark.holds("fault overflow")
def test_a_queue_ends_the_start() -> None:
    flow = Flow()
    path = Path(flow, rate=200.0, base=0.1)
    widest = 0
    for _ in range(20):
        path.round()
        widest = max(widest, flow.window)
    assert widest <= 64
    assert 20 <= flow.window <= 40


def test_a_start_that_overflows_a_buffer_ends() -> None:
    flow = Flow()
    path = Path(flow, rate=1e6, base=0.1)
    while flow.window < 100:
        path.round()
    wide = flow.window
    path.rounds(2, lost=90)
    assert flow.window < wide
    path.rounds(4)
    assert flow.window <= wide


def test_a_starved_round_proves_nothing() -> None:
    flow = Flow()
    path = Path(flow, rate=1000.0, base=0.1)
    path.rounds(20)
    before = flow.window
    for _ in range(30):
        flow.on_starved()
        flow.on_replies(path.now + 1.0, 0.1, 1, path.order, path.order + 1)
        path.order += 1
        path.now += 1.0
    assert flow.window == before


def test_silence_probes_with_two_until_something_is_heard() -> None:
    flow = Flow()
    path = Path(flow, rate=1000.0, base=0.1)
    path.rounds(20)
    before = flow.window
    flow.on_silence()
    flow.on_silence()
    assert flow.window == 2
    flow.on_replies(path.now + 5.0, None, 1, 0, path.order)
    assert flow.window == before // 2
    flow.on_silence()
    flow.set_queue_limit(4)
    flow.on_replies(path.now + 6.0, None, 1, 0, path.order)
    assert flow.window <= 4


def test_a_longer_way_is_noticed() -> None:
    flow = Flow()
    path = Path(flow, rate=1000.0, base=0.05)
    path.rounds(30)
    path.base = 0.2
    path.rounds(400)
    assert flow.window >= 200


# --- a serial port


def lose_what_overflows(flow: Flow, holds: int, rounds: int, *, loss: float = 0.0) -> list[int]:
    """Return the windows of some rounds before a receive buffer that holds so many requests."""
    path = Path(flow, rate=100.0, base=0.1)
    rng = random.Random(1)
    windows = []
    for _ in range(rounds):
        windows.append(flow.window)
        survivors = min(flow.window, holds)
        chance = sum(rng.random() < loss for _ in range(survivors))
        path.round(lost=min(flow.window - 1, 2 * (flow.window - survivors) + chance))
    return windows


def test_a_serial_window_is_small_whatever_the_path_holds() -> None:
    windows = lose_what_overflows(Flow(serial=True), 100, 60)
    assert max(windows) <= MOST_SERIAL
    assert windows[-1] >= 9


@pytest.mark.parametrize("loss", [0.0, 0.05])
def test_it_stays_near_what_the_receive_buffer_holds(loss: float) -> None:
    windows = lose_what_overflows(Flow(serial=True), 6, 200, loss=loss)
    assert 5 <= sum(windows[20:]) / len(windows[20:]) <= 9.5


# --- a card that pauses


def paused(*, base: float = 0.1) -> tuple[Flow, Path]:
    """Return a flow that has just seen a server pause for 0.2 s."""
    flow = Flow()
    path = Path(flow, rate=400.0, base=base)
    path.rounds(40)
    path.now += 0.2
    flow.on_replies(path.now, path.base + 0.2, 1, path.order, path.order)
    return flow, path


def beyond(flow: Flow, now: float, *, paced: bool = True) -> int:
    """Return how many requests may go out although the window is full."""
    flow.begin()
    return flow.room(flow.window, now, paced=paced)


def test_a_reserve_that_overflows_a_queue_shrinks() -> None:
    flow, path = paused()
    path.rounds(30)
    usual = flow._reserve()
    path.rounds(5, lost=10)
    assert flow._reserve() < 0.5 * usual


def test_what_overflows_while_a_card_pauses_is_no_loss_of_the_link() -> None:
    flow, path = paused()
    path.rounds(1, lost=flow.window // 2)
    assert flow.loss == 0.0
    path.rounds(10)
    path.rounds(10, lost=flow.window // 10)
    assert 0.03 < flow.loss < 0.15


def test_a_gap_because_nothing_was_asked_is_no_pause() -> None:
    flow = Flow()
    path = Path(flow, rate=400.0, base=0.1)
    path.rounds(40)
    flow.on_starved()
    path.now += 0.3
    path.rounds(3)
    assert beyond(flow, path.now) <= 0
    assert flow.starved or flow.pause == 0.0


def test_writes_go_on_while_answers_pause_but_not_for_long() -> None:
    flow, path = paused()
    path.rounds(10)
    assert beyond(flow, path.now + 0.01, paced=False) <= 0
    assert beyond(flow, path.now + 0.1, paced=False) > 0
    assert flow.next_room_at() < path.now + 0.2
    assert flow.room(flow.window + 200, path.now + 15.0, paced=False) <= 0


# --- a fast path


class Computer:
    """A server on this computer: what a chunk costs depends on how many come at once."""

    def __init__(self, best: int) -> None:
        self.best = best

    def rate(self, window: int) -> float:
        beyond = max(window / self.best, self.best / window)
        return 60_000.0 / (1.0 + 0.4 * (beyond - 1.0))


@pytest.mark.parametrize("best", [16, 48, 128])
def test_on_a_fast_path_the_window_is_no_wider_than_keeps_the_server_busy(best: int) -> None:
    flow, computer = Flow(), Computer(best)
    path = Path(flow, rate=60_000.0, base=0.0001)
    windows, rates = [], []
    while path.now < 3.0:
        path.rate = computer.rate(flow.window)
        path.round()
        if path.now > 1.0:
            windows.append(flow.window)
            rates.append(path.rate)
    assert max(windows) <= 160
    assert sum(rates) / len(rates) >= 0.5 * computer.rate(best)


@pytest.mark.parametrize("window", [1, 2, 4])
def test_bulk_goes_on_beside_what_is_waited_for_even_in_a_small_window(window: int) -> None:
    flow = Flow(limit=window)
    flow.room(0, 100.0, paced=True, urgent=True)
    assert flow.room(0, 100.0, paced=True) >= 1


@pytest.mark.parametrize("seed", range(5))
def test_random_losses_at_the_start_are_not_taken_for_an_overflow(seed: int) -> None:
    """One request or answer in five is lost, as at 10 % each way; a false ceiling would last for minutes."""
    flow = Flow()
    path = Path(flow, rate=400.0, base=0.3)
    rng = random.Random(seed)
    for _ in range(16):
        path.round(lost=sum(rng.random() < 0.19 for _ in range(flow.window)))
    assert flow.window > 60
