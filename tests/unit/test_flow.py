"""The in-flight window, and what is known of the network path: on paths whose every round trip is known.

What it brings over whole links, with servers that pause or queue little: tests/sim/test_shares.py and
test_latency.py.
"""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.flow import MOST_SERIAL, SILENT, Flow


class Path:
    """A path of a fixed rate (replies/s) and base round trip; the window is always full. rounds: so many
    went before."""

    def __init__(self, *, rate: float, base: float, rounds: int = 0, serial: bool = False) -> None:
        self.flow = Flow(serial=serial)
        self.known = self.flow.path
        self.rate = rate
        self.base = base
        self.now = 0.0
        self.order = 0
        self.rounds(rounds)

    @property
    def window(self) -> int:
        return self.flow.window

    def round(self, *, lost: int = 0) -> None:
        window = self.window
        rtt = max(self.base, window / self.rate)
        first = self.order
        self.order += window
        for index in range(window):
            self.now += rtt / window
            if index < lost:
                self.known.on_loss()
            else:
                self.flow.on_replies(self.now, rtt, 1, first + index, self.order)

    def rounds(self, count: int, *, lost: int = 0) -> None:
        for _ in range(count):
            self.round(lost=lost)


def test_random_loss_does_not_shrink_it() -> None:
    path = Path(rate=1000.0, base=0.1, rounds=20)
    path.rounds(150, lost=10)
    assert path.window >= 80
    assert path.known.loss == pytest.approx(10 / path.window, rel=0.2)


def test_loss_with_a_standing_queue_brakes_and_comes_back() -> None:
    path = Path(rate=1000.0, base=0.1, rounds=20)
    before = path.window
    path.rate = 300.0
    path.rounds(4, lost=5)
    assert path.window < 0.6 * before
    path.rate = 1000.0
    path.rounds(60)
    assert path.window >= 100, "what fills the path"


@pytest.mark.holds("fault overflow")
def test_a_start_that_overflows_a_buffer_ends() -> None:
    path = Path(rate=1e6, base=0.1)
    while path.window < 100:
        path.round()
    wide = path.window
    path.rounds(2, lost=90)
    assert path.window < wide
    path.rounds(4)
    assert path.window <= wide


def test_an_application_limited_round_proves_nothing() -> None:
    path = Path(rate=1000.0, base=0.1, rounds=20)
    before = path.window
    for _ in range(30):
        path.known.on_app_limited()
        path.flow.on_replies(path.now + 1.0, 0.1, 1, path.order, path.order + 1)
        path.order += 1
        path.now += 1.0
    assert path.window == before


def test_silence_probes_with_two_until_something_is_heard() -> None:
    path = Path(rate=1000.0, base=0.1, rounds=20)
    before = path.window
    path.flow.on_silence(SILENT)
    path.flow.on_silence(SILENT)
    assert path.window == 2
    path.flow.on_replies(path.now + 5.0, None, 1, 0, path.order)
    assert path.window == before // 2


@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.parametrize("paced", [True, False])
def test_only_reads_of_a_lone_client_go_beyond_a_short_queue(alone: bool, paced: bool) -> None:
    path = Path(rate=100.0, base=0.1)
    path.flow.set_queue_limit(4)
    path.flow.sole_client = alone
    path.rounds(60)
    path.flow.begin()
    assert (path.flow.room(6, path.now, paced=paced) > 0) is (alone and paced)
    assert (path.flow.room(4, path.now, paced=paced) > 0) is alone
    assert path.flow.room(3, path.now, paced=paced) > 0


def test_a_longer_way_is_noticed() -> None:
    path = Path(rate=1000.0, base=0.05, rounds=30)
    path.base = 0.2
    path.rounds(400)
    assert path.window >= 200


# --- a serial port


def lose_what_overflows(holds: int, rounds: int, *, loss: float = 0.0) -> list[int]:
    """Return the windows of some rounds at a serial port before a buffer that holds so many requests."""
    path = Path(rate=100.0, base=0.1, serial=True)
    rng = random.Random(1)
    windows = []
    for _ in range(rounds):
        windows.append(path.window)
        survivors = min(path.window, holds)
        chance = sum(rng.random() < loss for _ in range(survivors))
        path.round(lost=min(path.window - 1, 2 * (path.window - survivors) + chance))
    return windows


def test_a_serial_window_is_small_whatever_the_path_holds() -> None:
    windows = lose_what_overflows(100, 60)
    assert max(windows) <= MOST_SERIAL
    assert windows[-1] >= 9


@pytest.mark.parametrize("loss", [0.0, 0.05])
def test_it_stays_near_what_the_receive_buffer_holds(loss: float) -> None:
    windows = lose_what_overflows(6, 200, loss=loss)
    assert 5 <= sum(windows[20:]) / len(windows[20:]) <= 9.5


# --- a card that pauses


def paused() -> Path:
    """Return a path whose server has just paused for 0.2 s."""
    path = Path(rate=400.0, base=0.1, rounds=40)
    path.now += 0.2
    path.flow.on_replies(path.now, path.base + 0.2, 1, path.order, path.order)
    return path


def beyond(path: Path, after: float) -> int:
    """Return how many writes may go out although the window is full."""
    path.flow.begin()
    return path.flow.room(path.window, path.now + after, paced=False)


def test_a_reserve_that_overflows_a_queue_shrinks() -> None:
    path = paused()
    path.rounds(30)
    usual = path.known.reserve
    path.rounds(5, lost=10)
    assert path.known.reserve < 0.5 * usual


def test_what_overflows_while_a_card_pauses_is_no_loss_of_the_link() -> None:
    path = paused()
    path.rounds(1, lost=path.window // 2)
    assert path.known.loss == 0.0
    path.rounds(10)
    path.rounds(60, lost=path.window // 10)
    assert 0.03 < path.known.loss < 0.15


def test_writes_go_on_while_answers_pause_but_not_for_long() -> None:
    path = paused()
    path.rounds(10)
    assert beyond(path, 0.01) <= 0
    assert beyond(path, 0.1) > 0
    assert path.flow.next_room_at() < path.now + 0.2
    assert path.flow.room(path.window + 200, path.now + 15.0, paced=False) <= 0


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
    computer, path = Computer(best), Path(rate=60_000.0, base=0.0001)
    windows, rates = [], []
    while path.now < 3.0:
        path.rate = computer.rate(path.window)
        path.round()
        if path.now > 1.0:
            windows.append(path.window)
            rates.append(path.rate)
    assert max(windows) <= 160
    assert sum(rates) / len(rates) >= 0.5 * computer.rate(best)


@pytest.mark.parametrize("window", [1, 2, 4])
def test_bulk_goes_on_beside_what_is_waited_for_even_in_a_small_window(window: int) -> None:
    flow = Flow(limit=window)
    flow.room(0, 100.0, paced=True, urgent=True)
    assert flow.room(0, 100.0, paced=True) >= 1
