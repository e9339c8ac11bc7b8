"""The in-flight window: what it does on paths whose every round trip is known."""

from __future__ import annotations

import random
from collections.abc import Callable
from itertools import pairwise

import pytest

from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import DEFAULT_CAP, SERIAL_CAP, Flow
from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import Opcode


def keep_a_reserve(flow: Flow) -> None:
    reserve = flow.stalls.reserve
    reserve.seconds = reserve.wanted = reserve._held = 0.15


def test_a_pause_on_a_fast_path_lets_no_thousands_loose() -> None:
    flow = Flow()
    path = Path(flow, rate=50_000.0, base=0.001)
    for _ in range(40):
        path.round()
    keep_a_reserve(flow)  # as after many pauses of a card, or of a busy computer
    flow._trains.proven = False  # answers come in bunches there
    assert flow.room(0, path.now, paced=True) == flow.window
    assert Flow(limit=8).room(0, 0.0, paced=True) <= 8


def test_pauses_of_a_link_as_fast_as_radios_are_bridged_by_some_hundreds() -> None:
    flow = Flow()
    path = Path(flow, rate=4000.0, base=0.030)
    path.rounds(40)
    keep_a_reserve(flow)
    flow._trains.proven = False
    room = flow.room(0, path.now, paced=True)
    assert flow.window + 300 < room <= flow.window + 1024


def test_what_a_busy_computer_answers_late_is_no_longer_way() -> None:
    flow = Flow()
    path = Path(flow, rate=20_000.0, base=0.0003)
    path.rounds(40)
    before = flow.window
    for _ in range(5):  # it is not run for a while; then it answers what waited, and goes on as before
        path.now += 0.150
        first = path.order
        path.order += flow.window
        flow.on_silence()
        for order in range(first, path.order):
            path.now += 1 / path.rate
            flow.on_reply(path.now, 0.155, order, path.order + order - first)
        path.rounds(12)
        assert flow.window <= before
    path.rounds(5)
    assert flow.window == before


def test_a_queue_of_our_reserve_is_no_longer_way() -> None:
    flow = Flow()
    path = Path(flow, rate=2000.0, base=0.030)
    path.rounds(40)
    before = flow.window
    keep_a_reserve(flow)
    sent = flow._reserve(path.now, True)
    for number in range(26):
        before_that, sent = sent, flow._reserve(path.now, True)
        path.waiting = min(before_that, sent)  # the first answers are to what was sent a round ago
        # What is lost brakes: a narrower window, but the reserve makes nearly all of the queue.
        path.round(lost=5 if 3 <= number < 6 else 0)
    assert flow.window <= 1.1 * before


def test_losses_in_pauses_do_not_brake_for_the_queue_of_our_reserve() -> None:
    flow = Flow()
    path = Path(flow, rate=400.0, base=0.1)
    path.rounds(40)
    before = flow.window
    keep_a_reserve(flow)
    flow.stalls._calm = 0
    flow.stalls._watched = -1e9  # so it stays
    path.waiting = 60
    path.rounds(40, lost=4)
    assert flow.window >= before


class Path:
    """A path of a fixed rate (replies/s) and base round trip; the window is always full."""

    def __init__(self, flow: Flow, *, rate: float, base: float, start: float = 0.0) -> None:
        self.flow = flow
        self.rate = rate
        self.base = base
        self.now = start
        self.order = 0
        self.waiting = 0
        """Requests that the window does not count."""

    def round(self, *, lost: int = 0) -> None:
        window = self.flow.window
        rtt = max(self.base, (window + self.waiting) / self.rate)
        took = rtt * window / (window + self.waiting)
        first = self.order
        self.order += window
        for index in range(window):
            self.now += took / window
            if index < lost:
                self.flow.on_loss(first + index)
            else:
                self.flow.on_reply(self.now, rtt, first + index, self.order)

    def rounds(self, count: int, *, lost: int = 0) -> None:
        for _ in range(count):
            self.round(lost=lost)


def listed(flow: Flow, *, rate: float, base: float) -> Path:
    """Return a path whose round trip is known from listings."""
    path = Path(flow, rate=rate, base=base)
    for _ in range(3):
        path.now += base
        flow.on_starved()
        flow.on_reply(path.now, base, path.order, path.order + 1)
        path.order += 1
    return path


def test_begins_small() -> None:
    assert Flow().window == 8
    assert Flow(serial=True).window == 1
    assert Flow(limit=2).window == 2
    assert Flow().cap == DEFAULT_CAP
    assert Flow(serial=True).cap == SERIAL_CAP


def test_grows_to_what_the_path_holds_and_not_far_beyond() -> None:
    flow = Flow()
    path = Path(flow, rate=2000.0, base=0.1)
    path.rounds(40)
    assert 200 <= flow.window <= 270


def test_a_fast_path_gets_more_than_it_holds_but_no_flood() -> None:
    """Nobody waits for long there, and long batches cost both ends less a chunk."""
    flow = Flow()
    path = Path(flow, rate=60_000.0, base=0.0005)
    path.rounds(60)
    assert 150 <= flow.window <= 200


def test_goes_straight_to_what_a_path_with_a_pace_of_its_own_holds() -> None:
    """Answers come at the path's pace although few are under way: requests left in one go."""
    flow = Flow()
    now, first = 0.0, 0
    widest = 0
    for _ in range(6):
        window = flow.window
        for index in range(window):
            flow.on_reply(now + 0.3 + index / 400.0, 0.3, first + index, first + window)
        first += window
        now += max(0.3, window / 400.0)
        widest = max(widest, flow.window)
    assert 120 <= flow.window <= widest <= 132


def flights(flow: Flow, spread: Callable[[int], float], count: int, *, base: float = 0.3) -> list[int]:
    """Answer so many rows of requests that left in one go, spread(n) seconds from the first to the last of
    n; return the windows they found."""
    now, first = 0.0, 0
    for _ in range(3):  # the round trip is known from some listings
        now += base
        flow.on_starved()
        flow.on_reply(now, base, first, first + 1)
        first += 1
    windows = []
    for _ in range(count):
        window = flow.window
        windows.append(window)
        last = spread(window)
        for index in range(window):
            at = now + base + last * index / max(1, window - 1)
            flow.on_reply(at, at - now, first + index, first + window + (index > 0))
        first += window
        now += max(base, last * window / max(1, window - 1))
    return windows


def test_two_rows_of_answers_tell_how_much_a_long_fat_path_holds() -> None:
    rate = 3700.0
    windows = flights(Flow(), lambda answers: (answers - 1) / rate, 6)
    assert windows[:2] == [8, 64]
    assert 0.3 * rate <= windows[2] <= 0.3 * rate + 16
    assert max(windows) <= 0.3 * rate + 16


def test_a_row_that_came_in_a_bunch_is_not_believed_alone() -> None:
    """As where the air is shared out in turns: eight answers come at once, many do not."""
    windows = flights(Flow(), lambda answers: 0.0001 if answers <= 8 else answers / 300.0, 4)
    assert windows[:2] == [8, 64]
    assert max(windows) <= 128
    assert flights(Flow(), lambda answers: 0.0, 3)[1] <= 16


def test_one_lost_request_is_no_silent_link() -> None:
    engine = Engine(random.Random(1), Flow())
    engine.start(Simple(Opcode.NONE), 0.0)
    window = engine.flow.window
    now = 0.0
    for sends in range(1, 4):
        engine.outgoing(now)
        now = engine.next_deadline() or 0.0
        engine.on_deadline(now)
        assert (engine.flow.window == window) is (sends < 3)


def test_random_loss_does_not_shrink_it() -> None:
    flow = Flow()
    path = Path(flow, rate=1000.0, base=0.1)
    path.rounds(20)
    before = flow.window
    path.rounds(40, lost=10)
    assert flow.window >= before
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
    assert flow.window >= 0.9 * before


def test_a_queue_ends_the_start() -> None:
    flow = Flow()
    path = Path(flow, rate=200.0, base=0.1)
    widest = 0
    for _ in range(20):
        path.round()
        widest = max(widest, flow.window)
    assert widest <= 64
    assert 20 <= flow.window <= 40


def test_limits() -> None:
    flow = Flow(limit=8)
    path = Path(flow, rate=1000.0, base=0.1)
    path.rounds(10)
    assert flow.window == 8
    flow.set_queue_limit(4)
    assert (flow.window, flow.cap) == (4, 4)
    path.rounds(10)
    assert flow.window == 4
    flow.set_queue_limit(None)
    assert flow.cap == 8
    flow.set_queue_limit(0)
    assert flow.window == 1


def test_serial_grows_by_half_and_goes_back_where_most_is_lost() -> None:
    flow = Flow(serial=True)
    path = Path(flow, rate=100.0, base=0.1)
    seen = []
    for _ in range(12):
        path.round()
        seen.append(flow.window)
    assert all(before <= after <= max(before + 1, 1.5 * before) for before, after in pairwise(seen))
    assert flow.window <= SERIAL_CAP
    high = flow.window
    path.rounds(3, lost=flow.window * 2 // 3)
    assert flow.window < high


def test_a_start_that_overflows_a_buffer_ends() -> None:
    flow = Flow()
    path = Path(flow, rate=1e6, base=0.1)
    while flow.window < 100:
        path.round()
    wide = flow.window
    path.rounds(2, lost=40)
    assert flow.window < wide
    path.rounds(4)
    assert flow.window <= wide


def test_a_queue_that_shrinks_with_the_window_is_no_longer_way() -> None:
    flow = Flow()
    path = Path(flow, rate=1000.0, base=0.05)
    path.rounds(20)
    path.rate = 100.0
    path.rounds(60)
    assert flow.window < 15
    path.rate = 1000.0
    path.rounds(40)
    assert 50 <= flow.window < 80


def test_a_starved_round_proves_nothing() -> None:
    flow = Flow()
    path = Path(flow, rate=1000.0, base=0.1)
    path.rounds(20)
    before = flow.window
    for _ in range(30):
        flow.on_starved()
        flow.on_reply(path.now + 1.0, 0.1, path.order, path.order + 1)
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
    flow.on_reply(path.now + 5.0, None, 0, path.order)
    assert flow.window == before // 2
    flow.on_silence()
    flow.set_queue_limit(4)
    flow.on_reply(path.now + 6.0, None, 0, path.order)
    assert flow.window <= 4


def test_a_longer_way_is_noticed() -> None:
    flow = Flow()
    path = Path(flow, rate=1000.0, base=0.05)
    path.rounds(30)
    path.base = 0.2
    path.rounds(400)
    assert flow.window >= 200


def test_a_longer_way_is_noticed_by_a_window_that_is_too_small_to_become_narrow_by_itself() -> None:
    flow = Flow()
    path = listed(flow, rate=12.0, base=0.05)
    path.rounds(60)
    assert flow.window <= 5
    path.rate, path.base = 250.0, 0.5
    path.rounds(60)
    assert 125 <= flow.window <= 140


def test_a_queue_of_ours_is_looked_into_less_and_less_often() -> None:
    flow = Flow()
    path = listed(flow, rate=20.0, base=0.2)
    path.rounds(12)
    usual = flow.window
    assert usual >= 7
    narrow = []
    for number in range(1000):
        path.round()
        assert flow.window <= usual
        if flow.window < 0.7 * usual:
            narrow.append(number)
    assert 3 <= len(narrow) <= 8
    path.rate, path.base = 250.0, 0.8  # whatever proved to be ours before, this is not
    path.rounds(75)
    assert flow.window >= 200


@pytest.mark.parametrize("limit", [4, None])
def test_rounds_without_a_round_trip_change_little(limit: int | None) -> None:
    flow = Flow(limit=limit)
    path = Path(flow, rate=1000.0, base=0.1)
    if limit is None:
        path.rounds(20)
    before = flow.window
    for order in range(path.order, path.order + 200):
        path.now += 1.0 / 1000.0
        flow.on_reply(path.now, None, order, order + flow.window)
    assert flow.window == pytest.approx(before, abs=0.1 * before)


def test_rounds_in_no_time_or_without_round_trips_are_survived() -> None:
    flow = Flow()
    for order in range(10):
        flow.on_reply(1.0, None, order, order + 1)
    assert flow.window <= 16
    assert flow.loss == 0.0


def test_a_short_queue_of_ones_own_takes_one_more() -> None:
    flow = Flow()
    flow.alone = True
    assert flow.room(0, 0.0, paced=False) == 8
    flow.set_queue_limit(4)
    assert flow.room(4, 0.0, paced=False) == 1
    assert flow.room(5, 0.0, paced=False) == 0
    flow.alone = False
    assert flow.room(4, 0.0, paced=False) == 0
