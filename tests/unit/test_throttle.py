"""How much may wait for the link: a close cannot be killed, so it is what ten seconds bring (promise 4)."""

from __future__ import annotations

import pytest
import trio

from mavftpfs.cache.throttle import LEAST, MOST, SECONDS, UNMEASURED
from tests.support.fake_writer import FakeWriter, card, make_writable

pytestmark = pytest.mark.holds("promise 4")

store = card({b"/card/there": b"x"})


async def rate_and_limit(store: FakeWriter, delay: float, size: int) -> tuple[float, int]:
    """Write a file of `size` bytes whose chunks take `delay` seconds; return its rate and what may wait."""
    store.write_delay = delay
    tree = make_writable(store)
    assert tree.status()["dirty_max"] == UNMEASURED
    file = await tree.create(b"/card/new", exclusive=True)
    began = trio.current_time()
    await file.write(0, bytes(size))
    await file.flush()
    took = trio.current_time() - began
    await file.release()
    limit = tree.status()["dirty_max"]
    assert isinstance(limit, int)
    return size / took, limit


async def test_it_is_what_ten_seconds_bring(autojump_clock: object, store: FakeWriter) -> None:
    rate, limit = await rate_and_limit(store, 0.02, 400_000)
    assert LEAST < limit < MOST
    assert limit == pytest.approx(SECONDS * rate, rel=0.2)


@pytest.mark.parametrize(("delay", "expected"), [(0.5, LEAST), (0.0002, MOST)])
async def test_within_bounds(autojump_clock: object, store: FakeWriter, delay: float, expected: int) -> None:
    rate, limit = await rate_and_limit(store, delay, 400_000)
    assert limit == expected
    assert (SECONDS * rate < LEAST) == (expected == LEAST)
