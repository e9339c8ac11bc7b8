"""Bridging the pauses of a server."""

from __future__ import annotations

from collections import deque

import pytest

from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.stalls import Stalls

RATE = 400.0


def run(stalls: Stalls, seconds: float, *, every: float = 0.0, pause: float = 0.0) -> float:
    """Answer at RATE, with a pause after each `every` seconds; return the time."""
    now = since = 0.0
    while now < seconds:
        now += 1 / RATE
        if every and now - since > every:
            now += pause
            since = now
        stalls.on_reply(now, RATE)
    return now


def test_steady_answers_need_no_reserve() -> None:
    stalls = Stalls()
    run(stalls, 60.0)
    assert stalls.reserve.wanted == 0.0
    assert not stalls.usual


@pytest.mark.parametrize(("rtt", "most"), [(0.01, 0.26), (0.1, 0.35), (0.3, 0.45), (2.0, 0.45)])
def test_the_first_pause_calls_for_one_that_a_longer_way_allows_to_be_larger(rtt: float, most: float) -> None:
    """Who lists a directory meanwhile may wait three round trips and 0.3 s (docs/benchmarks.md)."""
    stalls = Stalls()
    now = run(stalls, 0.5)
    stalls.on_reply(now + 0.1, RATE, rtt)
    assert stalls.reserve.wanted == pytest.approx(most)


def test_short_pauses_are_not_worth_a_queue() -> None:
    stalls = Stalls()
    run(stalls, 60.0, every=1.0, pause=0.03)
    assert stalls.reserve.wanted == 0.0


def test_a_gap_because_nothing_was_asked_is_no_pause() -> None:
    stalls = Stalls()
    now = 0.0
    for _ in range(20):
        for _ in range(400):
            now += 1 / RATE
            stalls.on_reply(now, RATE)
        stalls.interrupt()
        now += 0.5
    assert stalls.reserve.wanted == 0.0


def test_an_unknown_rate_proves_nothing() -> None:
    stalls = Stalls()
    for second in range(60):
        stalls.on_reply(float(second), 0.0)
    assert stalls.reserve.wanted == 0.0


@pytest.mark.parametrize("serial", [False, True])
def test_the_reserve_is_for_reads_where_the_buffers_are_not_known_to_be_small(serial: bool) -> None:
    flow = Flow(serial=serial)
    now = 0.0
    for order in range(4000):
        waiting = flow._reserve(now, True) / RATE
        now += 1 / RATE if order % 200 else max(1 / RATE, 0.15 - waiting)
        flow.on_reply(now, max(0.05, flow.window / RATE + waiting), order, order + flow.window)
    full = flow.window
    assert (flow.room(full, now, paced=True) > 0) is not serial
    assert flow.room(full, now, paced=False) == 0


def at_work_with_pauses(flow: Flow) -> float:
    """Have a server answer at RATE, with a pause now and then; return the time when that was seen."""
    now = 0.0
    for order in range(4000):
        now += 1 / RATE if order % 200 else 0.15
        flow.on_reply(now, 0.05, order, order + flow.window)
    flow._trains.proven = False  # as when many are allowed at once
    flow.begin()
    return now


def test_writes_go_on_while_answers_pause_but_not_for_long() -> None:
    """What arrives during a pause is lost; what was not sent would leave the server idle after it."""
    flow = Flow()
    now = at_work_with_pauses(flow)
    full = flow.window
    assert flow.room(full, now, paced=False) == 0
    assert now < flow.next_room_at() < now + 0.05
    assert flow.room(full, now + 0.1, paced=False) == pytest.approx(0.1 * RATE, rel=0.1)
    assert flow.room(full, now + 5.0, paced=False) == pytest.approx(0.4 * RATE, rel=0.1)
    flow.begin()
    assert flow.room(0, now, paced=True, urgent=True) > 0
    assert flow.room(full, now + 0.1, paced=False) <= 0, "who waits for an answer waits behind it"


def test_what_was_sent_in_a_pause_is_a_bridge_until_it_is_known_to_be_lost() -> None:
    """The next pause came before, and found the window full of it: nothing was sent in that one."""
    flow = Flow()
    now = at_work_with_pauses(flow)
    flow._base_rtt = 0.3
    full = flow.window
    before = flow.room(full, now, paced=False)
    now += 0.15
    flow.on_reply(now, None, 4000, 4001)
    sent = flow.room(full, now, paced=False)
    assert sent == pytest.approx(before + 0.15 * RATE, rel=0.1)
    assert flow.room(full, now + 0.1, paced=False) == pytest.approx(sent + 0.1 * RATE, rel=0.1)
    for order in range(30):
        flow.on_loss(order)
    assert flow.room(full, now, paced=False) == pytest.approx(sent - 30, abs=1)
    flow._base_rtt = 0.1
    for order in range(60):
        now += 1 / RATE
        flow.on_reply(now, None, 4001 + order, 4100)
    assert flow.room(flow.window, now, paced=False) == 0, "a round trip later all of that is answered or lost"


def test_bridges_of_pauses_that_follow_each_other_are_bounded() -> None:
    stalls = Stalls()
    now = run(stalls, 10.0, every=0.5, pause=0.15)
    for _ in range(6):
        now += 0.38
        stalls.on_reply(now, RATE)
    assert stalls.to_bridge(now + 0.38, RATE, 10.0, kept=False) == pytest.approx(0.8)


def test_reads_go_on_when_their_reserve_is_used_up() -> None:
    flow = Flow()
    now = at_work_with_pauses(flow)
    full = flow.window
    flow.stalls.reserve.seconds = 0.1
    usual = flow.room(full, now, paced=True)
    assert flow.room(full, now + 0.1, paced=True) == pytest.approx(usual + 0.1 * RATE, rel=0.1)


def test_what_a_pause_took_of_a_reserve_comes_back_fast_but_not_at_once() -> None:
    """All at once overflowed the server's buffer again; at the pace of the link it never came back."""
    flow = Flow()
    now = at_work_with_pauses(flow)
    flow.stalls.reserve.seconds = flow.stalls.reserve.wanted = flow.stalls.reserve._held = 0.25
    flow.stalls._bridges.clear()
    flow._trains.proven, flow._trains.rate = True, RATE
    sent = 0
    for step in range(100):
        flow.begin()
        room = flow.room(flow.window + sent, now + step / 1000, paced=True)
        assert room <= 4
        flow.on_sent(room, now + step / 1000)
        sent += room
    assert sent == pytest.approx(2 * RATE * 0.1, rel=0.15)


def test_the_longest_pause_of_late_is_no_sign_of_losses() -> None:
    stalls = Stalls()
    assert stalls.patience == 0.0
    now = run(stalls, 20.0, every=0.5, pause=0.15)
    assert stalls.patience == pytest.approx(0.15, rel=0.2)
    stalls.on_reply(now + 30.0, RATE)
    assert stalls.patience <= 0.5, "that was the link"


def test_at_the_end_of_a_transfer_no_newer_answer_would_tell_of_a_loss() -> None:
    """Who waits for an upload's last answers, to read something between, must not wait for a pause more."""
    flow = Flow()
    at_work_with_pauses(flow)
    assert flow.patience == pytest.approx(0.15, rel=0.2)
    flow.on_starved()
    assert flow.patience == 0.0


def test_where_few_may_be_in_flight_a_silence_is_all_of_them_lost() -> None:
    queued, serial = Flow(), Flow(serial=True)
    for flow in (queued, serial):
        at_work_with_pauses(flow)
        assert flow.stalls.patience > 0.1
    queued.set_queue_limit(5)
    assert queued.patience == serial.patience == 0.0


def test_pauses_excuse_no_more_losses_than_come_in_them() -> None:
    """Also where the server takes far more than the link brings: half of a window then finds a queue full."""
    flow = Flow()
    at_work_with_pauses(flow)
    flow._trains.rate, flow.stalls.bridging = 10 * RATE, True
    flow.loss = flow.stalls.share + 0.1
    assert flow._excused()
    flow.loss = flow.stalls.share + 0.3
    assert not flow._excused()


def test_patience_ends_with_the_pauses() -> None:
    stalls = Stalls()
    now = run(stalls, 20.0, every=0.5, pause=0.15)
    for _ in range(int(60 * RATE)):
        now += 1 / RATE
        stalls.on_reply(now, RATE)
    assert stalls.patience == 0.0


def test_reads_go_on_too_where_a_reserve_would_only_overflow_the_servers_buffer() -> None:
    flow = Flow()
    flow.stalls.reserve._until = 1e9  # it was found useless
    now = at_work_with_pauses(flow)
    full = flow.window
    assert flow.room(full, now, paced=True) == 0
    assert flow.room(full, now + 0.1, paced=True) == pytest.approx(0.1 * RATE, rel=0.1)


def test_what_is_lost_in_pauses_puts_no_ceiling_on_the_window() -> None:
    """Such a ceiling stood for a quarter of a minute, at half of what the server took."""
    flow = Flow()
    answers: deque[tuple[float, int]] = deque()
    pace, rtt, now, free, order = 2000.0, 0.3, 0.0, 0.0, 0
    for step in range(20_000):
        now = step / pace
        flow.begin()
        if flow.room(len(answers), now, paced=False) > 0:
            flow.on_sent(1, now)
            if step % 800 < 300:  # what arrives half a round trip later finds the server's buffer full
                flow.on_loss(order)
            else:
                free = max(now + rtt, free + 1 / pace)
                answers.append((free, order))
            order += 1
        while answers and answers[0][0] <= now:
            flow.on_reply(now, rtt, answers.popleft()[1], order)
        if step == 8000:
            flow._easing.ceiling, flow._easing._wait = 450.0, 60  # an overflow was seen
    assert flow.window > 600


def test_where_no_pauses_were_seen_writes_wait_for_answers() -> None:
    flow = Flow()
    for order in range(4000):
        flow.on_reply(order / RATE, 0.05, order, order + flow.window)
    assert flow.room(flow.window, 4000 / RATE + 1.0, paced=False) == 0
