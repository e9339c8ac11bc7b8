"""The token bucket that holds back what goes out."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.bucket import Bucket
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.networkpath import CHUNK_COST, OVERHEAD


def test_so_much_goes_out_in_the_long_run_and_little_at_once() -> None:
    bucket, sent, now = Bucket(300.0, 0.005), 0.0, 100.0
    bucket.rate = 1000.0
    while now < 110.0:
        if bucket.level(now) >= 100.0:
            bucket.charge(100.0)
            sent += 100.0
        else:
            now = bucket.holds_at(100.0)
    assert sent == pytest.approx(10_000.0, abs=301.0)
    assert bucket.level(200.0) == 300.0, "what was not used is not kept"


def test_without_a_limit_all_goes_out_and_a_fast_path_takes_a_tick_at_once() -> None:
    bucket = Bucket(300.0, 0.005)
    assert bucket.level(0.0) == float("inf")
    bucket.rate = 1_000_000.0
    assert bucket.level(10.0) == 5000.0


def test_short_requests_cost_less_of_a_limit() -> None:
    sizes = {}
    for size in (CHUNK_COST - OVERHEAD, 64):
        flow, now, sent = Flow(bwlimit=5000.0), 10.0, 0
        while now < 70.0:
            flow.begin()
            room = min(4, flow.room(0, now, paced=True))
            if room:
                sent += room
                flow.on_sent(room, room * size, now)
            else:
                assert flow.limited
                now = flow.next_room_at()
        sizes[size] = sent * (OVERHEAD + size)
    assert all(total == pytest.approx(300_000, rel=0.02) for total in sizes.values())
