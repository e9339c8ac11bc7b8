"""The gate that lets everybody be silent at once."""

from __future__ import annotations

import trio
from trio.testing import MockClock

from mavftpfs.session.gate import Gate


async def test_shut_means_that_nobody_is_inside_and_nobody_enters(autojump_clock: MockClock) -> None:
    gate, log = Gate(), []

    async def pass_through(name: str, begin: float, stay: float) -> None:
        await trio.sleep(begin)
        async with gate.passing():
            log.append((name, trio.current_time() - start))
            await trio.sleep(stay)

    async with trio.open_nursery() as nursery:
        start = trio.current_time()
        nursery.start_soon(pass_through, "early", 0, 2)
        nursery.start_soon(pass_through, "late", 1, 0)
        await trio.sleep(0.5)
        async with gate.held_shut(5) as silent:
            assert silent
            assert trio.current_time() - start == 2
            await trio.sleep(3)
    assert log == [("early", 0), ("late", 5)]


async def test_somebody_who_stays_inside_does_not_keep_the_others_out(autojump_clock: MockClock) -> None:
    gate, entered = Gate(), []

    async def pass_through(stay: float) -> None:
        async with gate.passing():
            entered.append(trio.current_time())
            await trio.sleep(stay)

    async with trio.open_nursery() as nursery:
        start = trio.current_time()
        nursery.start_soon(pass_through, 100)
        await trio.sleep(1)
        nursery.start_soon(pass_through, 0)
        async with gate.held_shut(5) as silent:
            assert not silent
            assert not gate.shut
            nursery.start_soon(pass_through, 0)
            await trio.sleep(1)
    assert [moment - start for moment in entered] in ([0, 1, 6], [0, 6, 6])
