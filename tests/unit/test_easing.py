"""Finding out whether losses are our own."""

from __future__ import annotations

from math import inf

from mavftpfs.protocol.easing import Easing


class Rounds:
    """Runs rounds over a path that loses a share of what is sent, by the window it is sent in."""

    def __init__(self, *, random_share: float, buffer: float = inf) -> None:
        self.easing = Easing()
        self.random_share = random_share
        self.buffer = buffer
        self.order = 0
        self.window = 100.0
        self.windows: list[float] = []

    def run(self, count: int, target: float = 100.0) -> None:
        for _ in range(count):
            sent = int(self.window)
            lost = max(0.0, self.window - self.buffer) + min(self.window, self.buffer) * self.random_share
            for index in range(sent):
                self.easing.count(self.order + index, lost=index < lost)
            self.order += sent
            usual = lost / self.window
            self.window = self.easing.next_window(target, usual, self.order)
            self.windows.append(self.window)


def test_without_losses_nothing_is_eased() -> None:
    rounds = Rounds(random_share=0.0)
    rounds.run(200)
    assert set(rounds.windows) == {100.0}


def test_random_losses_cost_a_round_now_and_then_and_set_no_ceiling() -> None:
    rounds = Rounds(random_share=0.3)
    rounds.run(200)
    assert rounds.easing.ceiling == inf
    assert 3 < sum(1 for window in rounds.windows if window < 71) < 12


def test_an_overflowing_buffer_is_found() -> None:
    rounds = Rounds(random_share=0.0, buffer=60.0)
    rounds.run(60)
    assert rounds.easing.ceiling <= 70.0 * 1.25


def test_the_ceiling_rises_when_losses_end() -> None:
    rounds = Rounds(random_share=0.0, buffer=60.0)
    rounds.run(20)
    assert max(rounds.windows[-5:]) < 100.0
    rounds.buffer = inf
    rounds.run(40)
    assert rounds.window == 100.0


def test_no_news_is_no_evidence() -> None:
    easing = Easing()
    for _ in range(100):
        easing.next_window(100.0, 0.5, 10)
    assert easing.ceiling == inf


def test_gusts_of_losses_set_no_ceiling_where_narrowing_answers_fewer() -> None:
    easing = Easing()
    window, order = 100.0, 0
    for number in range(300):
        sent, gust = int(window), number % 4 == 0
        for index in range(sent):
            easing.count(order + index, lost=gust and index < sent // 2)
        order += sent
        window = easing.next_window(100.0, 0.125, order)
        assert easing.ceiling >= 70.0 * 1.25
