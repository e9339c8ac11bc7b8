"""The readahead window: the reads that open it, its growth and its bounds."""

from __future__ import annotations

from typing import cast

import pytest

from mavftpfs.cache.blocks import SMALL_FILE, BlockCache, RateMeter
from mavftpfs.cache.file import File
from mavftpfs.cache.readahead import (
    FIRST_WINDOW,
    MAX_WINDOW,
    NOTHING,
    Plan,
    Readahead,
)
from mavftpfs.cache.throttle import Throttle
from mavftpfs.shared.speed import Speed

KIB = 1024
BIG = 100 * 1024 * KIB
LOG = "a file"


def read(ahead: Readahead, start: int, size: int = 128 * KIB, limit: int = MAX_WINDOW) -> Plan:
    return ahead.on_read(start, start + size, limit=limit, small=SMALL_FILE)


def test_a_first_read_of_so_much_opens_a_window() -> None:
    """The kernel asks for the next only when the first is there: a round trip without anything to send."""
    assert read(Readahead(BIG), 0) == Plan(128 * KIB, 128 * KIB + FIRST_WINDOW)
    assert read(Readahead(BIG), 0, limit=17 * KIB) == Plan(128 * KIB, 145 * KIB)
    assert read(Readahead(BIG), 4 * KIB) == NOTHING


def test_the_window_doubles_as_it_is_used_up() -> None:
    ahead = Readahead(BIG)
    asked = [read(ahead, i * 128 * KIB).stop for i in range(200)]
    window = max(stop - (i + 1) * 128 * KIB for i, stop in enumerate(asked) if stop)
    assert window == MAX_WINDOW
    sizes = [stop - (i + 1) * 128 * KIB for i, stop in enumerate(asked) if stop]
    assert sizes[:4] == [FIRST_WINDOW, 2 * FIRST_WINDOW, 2 * FIRST_WINDOW, 4 * FIRST_WINDOW]


def test_a_seek_closes_the_window_and_says_so_once() -> None:
    ahead = Readahead(BIG)
    read(ahead, 0)
    read(ahead, 128 * KIB)
    assert read(ahead, 50 * 1024 * KIB) == Plan(seeked=True)
    assert read(ahead, 10 * 1024 * KIB) == NOTHING
    again = 10 * 1024 * KIB + 128 * KIB
    assert read(ahead, again) == Plan(again + 128 * KIB, again + 128 * KIB + FIRST_WINDOW)


def test_the_kernel_may_swap_two_reads() -> None:
    ahead = Readahead(BIG)
    read(ahead, 4 * KIB, 124 * KIB)
    later, earlier = read(ahead, 256 * KIB), read(ahead, 128 * KIB)
    assert later == Plan(384 * KIB, 512 * KIB)
    assert earlier == NOTHING
    assert read(ahead, 384 * KIB).start == 512 * KIB


def test_a_small_file_is_wanted_whole_at_the_first_read_from_its_start() -> None:
    assert read(Readahead(SMALL_FILE), 0, 4 * KIB) == Plan(4 * KIB, SMALL_FILE)
    assert read(Readahead(SMALL_FILE + 1), 0, 4 * KIB) == NOTHING
    assert read(Readahead(SMALL_FILE), 4 * KIB, 4 * KIB) == NOTHING
    small = Readahead(SMALL_FILE)
    read(small, 0, 4 * KIB)
    assert read(small, 4 * KIB, 4 * KIB) == NOTHING


@pytest.mark.parametrize(
    ("streams", "rate", "limit", "small"),
    [
        (0, None, MAX_WINDOW, SMALL_FILE),
        (1, None, MAX_WINDOW, SMALL_FILE),
        (7, None, 4 * 1024 * KIB, SMALL_FILE),
        (1, 3000.0, 9000, SMALL_FILE),
        (1, 1_000_000.0, 3_000_000, 2_000_000),
        (1, 1e12, MAX_WINDOW, MAX_WINDOW),
    ],
)
def test_readahead_limits(streams: int, rate: float | None, limit: int, small: int) -> None:
    cache = BlockCache(64 * 1024 * KIB, clock=lambda: 0.0, patience=1.0)
    if rate is not None:
        for step in range(4):
            cache.meter.on_bytes(int(rate / 8), step / 8, LOG)
    assert cache.readahead_limits(streams) == (limit, small)


def test_the_rate_counts_only_the_time_between_bytes_that_follow_each_other() -> None:
    meter = RateMeter()
    assert meter.rate is None
    for second in (0, 100, 200):
        meter.on_bytes(10**9, second, LOG)  # what came after a pause says nothing about the link
        for step in range(1, 11):
            meter.on_bytes(1000, second + step / 10, LOG)
    assert meter.rate == pytest.approx(10_000)


def test_the_time_between_two_files_is_not_counted() -> None:
    """Small files tell of round trips: three chunks of each come at the speed of the link."""
    meter = RateMeter()
    for file in range(100):
        for chunk in range(3):
            meter.on_bytes(100, 0.5 * file + 0.01 * chunk, file)
    assert meter.rate == pytest.approx(10_000)


def test_the_rate_follows_the_link() -> None:
    meter = RateMeter()
    for step in range(100):
        meter.on_bytes(1000, step / 10, LOG)
    for step in range(100, 400):
        meter.on_bytes(100, step / 10, LOG)
    assert meter.rate == pytest.approx(1000, rel=0.1)


def test_a_glimpse_is_not_a_rate() -> None:
    meter = RateMeter()
    meter.on_bytes(1000, 0.0, LOG)
    meter.on_bytes(1000, 0.1, LOG)
    assert meter.rate is None


def test_people_are_told_a_rate_when_it_is_known() -> None:
    """The first ACKs come at the speed of the buffers on the way, also after a link was frozen."""
    speed, now = Speed(), 100.0

    def carry(seconds: float, rate: int) -> list[float | None]:
        nonlocal now
        told = []
        for _ in range(round(seconds * 10)):
            now += 0.1
            speed.on_bytes(rate // 10, now)
            told.append(speed.at(now))
        return told

    speed.on_bytes(500_000, now)
    assert carry(2.8, 60_000) == [None] * 28
    assert carry(20.0, 60_000)[4:] == [pytest.approx(60_000, rel=0.01)] * 196
    now += 9.0
    assert speed.at(now) is None
    speed.on_bytes(500_000, now)
    after = carry(20.0, 60_000)
    assert after[:28] == [None] * 28
    assert after[32:] == [pytest.approx(60_000, rel=0.01)] * 168
    assert carry(30.0, 6_000)[-1] == pytest.approx(6_000, rel=0.05)


@pytest.mark.parametrize("rate", [1_000.0, 500_000.0, 20_000_000.0])
def test_acked_bytes_are_measured_at_any_rate(rate: float) -> None:
    now = 0.0
    throttle, file = Throttle((), RateMeter(), None, lambda: now), cast(File, LOG)
    while now < 4.0:
        now += 239 / rate
        throttle.on_acked(file, 239)
    assert throttle.meter.rate == pytest.approx(rate, rel=0.02)
    assert throttle.speed == pytest.approx(rate, rel=0.1)
