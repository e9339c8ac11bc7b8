"""Which chunk size is chosen for what a link does to long and to short frames."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from mavftpfs.protocol.chunks import SMALLEST, Chunks, best_size
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.session.readmode import ReadSteering

PACE = 0.05


class Requests:
    """Sends one request after another; `lost` says what a link does to one for so many bytes, at a time."""

    def __init__(self, chunks: Chunks, lost: Callable[[int, float], float], *, seed: int = 1) -> None:
        self.chunks = chunks
        self.lost = lost
        self.now = 0.0
        self.sizes: list[int] = []
        self._rng = random.Random(seed)

    def send(self, seconds: float) -> list[int]:
        """Return the sizes of what went out."""
        sizes = []
        end = self.now + seconds
        while self.now < end:
            size = self.chunks.next_size(self.now)
            sizes.append(size)
            if self._rng.random() < self.lost(size, self.now):
                self.chunks.on_lost(size, self.now)
            else:
                self.chunks.on_answered(size, 1, self.now)
            self.now += PACE
        return sizes


def limit(most: int) -> Callable[[int, float], float]:
    return lambda size, now: float(size > most)


def damage(probability: float) -> Callable[[int, float], float]:
    return lambda size, now: 1.0 - (1.0 - probability) ** (size + 27)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("share", [0.0, 0.1, 0.2])
def test_only_full_ones_where_a_fifth_is_lost_each_way(share: float, seed: int) -> None:
    requests = Requests(Chunks(), lambda size, now: 1.0 - (1.0 - share) ** 2, seed=seed)
    assert set(requests.send(3600.0)) == {MAX_DATA}


def test_only_full_ones_where_long_frames_suffer_a_little() -> None:
    assert set(Requests(Chunks(), damage(1e-3)).send(3600.0)) == {MAX_DATA}


def test_a_short_outage_changes_nothing() -> None:
    requests = Requests(Chunks(), lambda size, now: float(now % 60.0 < 0.9))
    assert set(requests.send(600.0)) == {MAX_DATA}


def test_after_a_long_outage_the_first_full_one_that_passes_ends_the_doubt() -> None:
    chunks = Chunks()
    requests = Requests(chunks, lambda size, now: float(10.0 < now < 20.0))
    assert set(requests.send(10.0)) == {MAX_DATA}
    assert set(requests.send(10.0)) == {MAX_DATA, SMALLEST}
    requests.send(0.2)
    assert set(requests.send(600.0)) == {MAX_DATA}


@pytest.mark.parametrize("most", [32, 43, 73, 110, 123, 173, 200, 233, 238])
def test_a_limit_is_found(most: int) -> None:
    chunks = Chunks()
    Requests(chunks, limit(most)).send(30.0)
    assert most - 16 < chunks.size <= most


def test_a_limit_that_goes_away_is_noticed() -> None:
    chunks = Chunks()
    requests = Requests(chunks, lambda size, now: float(size > 120 and now < 20.0))
    requests.send(20.0)
    assert chunks.size <= 120
    requests.send(40.0)
    assert chunks.size == MAX_DATA
    assert set(requests.send(60.0)) == {MAX_DATA}


def test_a_limit_that_falls_is_found_again() -> None:
    chunks = Chunks()
    requests = Requests(chunks, lambda size, now: float(size > (150 if now < 20.0 else 80)))
    requests.send(20.0)
    assert 130 < chunks.size <= 150
    requests.send(20.0)
    assert 64 < chunks.size <= 80


def test_looking_again_costs_ever_less() -> None:
    chunks = Chunks()
    requests = Requests(chunks, limit(120))
    requests.send(30.0)
    lost = [sum(size > 120 for size in requests.send(600.0)) for _ in range(3)]
    assert lost[0] < 120
    assert 0 < lost[2] <= 60


@pytest.mark.parametrize("probability", [2e-3, 3e-3, 5e-3])
def test_damage_to_each_byte_tells_the_size(probability: float) -> None:
    chunks = Chunks()
    Requests(chunks, damage(probability)).send(200.0)

    def brings(size: int) -> float:
        return (1.0 - probability) ** (size + 27) * size / (size + 27)

    assert brings(chunks.size) > 0.95 * max(brings(size) for size in range(16, 240))


def test_short_ones_do_not_pay_where_the_number_of_requests_is_the_limit() -> None:
    chunks = Chunks(lambda: False)
    Requests(chunks, damage(2e-3)).send(1000.0)
    assert chunks.size == MAX_DATA


def test_losses_that_take_all_sizes_leave_the_full_one() -> None:
    chunks = Chunks()
    sizes = Requests(chunks, lambda size, now: 0.55).send(3600.0)
    assert chunks.size == MAX_DATA
    assert sum(size < MAX_DATA for size in sizes) < 0.05 * len(sizes)


def test_best_sizes() -> None:
    sizes = [best_size(probability, roomy=True) for probability in (0.0, 1e-4, 1e-3, 2e-3, 5e-3, 1.0)]
    assert sizes == sorted(sizes, reverse=True)
    assert (sizes[0], sizes[1], sizes[-1]) == (MAX_DATA, MAX_DATA, SMALLEST)
    assert best_size(2e-3, roomy=False) == MAX_DATA


def test_losses_that_have_another_reason_are_none_of_its_business() -> None:
    """A card that pauses lost half of what was written, whatever its size: 4.4 requests a chunk."""
    requests = Requests(Chunks(explained=lambda: 0.45), lambda size, now: 0.6)
    assert set(requests.send(600.0)) == {MAX_DATA}


@pytest.mark.parametrize("explained", [0.0, 0.05])
def test_a_reason_for_a_few_of_them_is_none_for_all(explained: float) -> None:
    """A short fade now and then is a pause, too."""
    requests = Requests(Chunks(explained=lambda: explained), damage(3.5e-3))
    requests.send(120.0)
    assert requests.chunks.size < 150


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_the_pauses_of_a_card_are_such_a_reason(share: float) -> None:
    engine = Engine(random.Random(1), Flow())
    engine.flow.stalls.share = share
    steering = ReadSteering(engine)
    for chunks in (steering.chunks, steering.write_chunks):
        assert chunks is not None
        sizes = set(Requests(chunks, lambda size, now: 0.6).send(600.0))
        assert (sizes == {MAX_DATA}) is (share > 0.0)
