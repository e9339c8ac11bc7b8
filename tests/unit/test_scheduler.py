"""The next user of the session and the end of a turn, as tables; the ranges that a reader wants."""

from __future__ import annotations

import random
from typing import cast

import pytest
import trio

from mavftpfs.link.messages import Address
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.session.driver import Driver
from mavftpfs.session.reader import FileStream
from mavftpfs.session.scheduler import (
    LEAST_TURN,
    LONGEST_TURN,
    MOST_USE,
    USE_MEMORY,
    Scheduler,
    SessionUser,
    Turn,
)
from mavftpfs.session.vehicle import Vehicle
from tests.support.transfers import MemorySink


class NoLink:
    """Stands in for the driver: nobody reads."""

    engine = Engine(random.Random(1), Flow())
    vehicle = Vehicle(0, 0, Address(254, 191))


def scheduler() -> Scheduler:
    return Scheduler(cast(Driver, NoLink()), clock=lambda: 0.0, rng=random.Random(1))


def user_of(seconds: float, waiting_since: float | None = None) -> SessionUser:
    """Return a user that had the session for so long until 100."""
    user = SessionUser(b"/f")
    user.on_turn(100.0 - seconds, 100.0)
    user.waiting_since = waiting_since
    return user


def test_use_fades_but_not_while_it_waits() -> None:
    user = user_of(2.0)
    assert user.used(100.0) == 2.0
    assert user.used(100.0 + USE_MEMORY / 2) == pytest.approx(1.0)
    assert user.used(100.0 + 2 * USE_MEMORY) == 0.0
    user.waiting_since = 100.0
    assert user.used(100.0 + USE_MEMORY / 2) == 2.0
    user.on_turn(130.0, 131.0)
    user.waiting_since = None
    assert user.used(131.0) == 3.0


def test_a_user_that_used_little_goes_first_until_another_waited_three_seconds() -> None:
    copy, small = user_of(5.0, 100.0), user_of(0.0, 102.9)
    assert small.score(102.9) < copy.score(102.9)
    small.waiting_since = 103.1
    assert copy.score(103.1) < small.score(103.1)


@pytest.mark.parametrize(
    ("use", "waited", "rival_use", "rival_waited", "rtt", "lasts"),
    [
        (5.0, 0.0, 0.0, 0.0, 0.02, 0.0),  # an editor beside a copy goes first
        (5.0, 0.9, 0.0, 0.0, 0.3, 0.0),
        (5.0, 3.5, 0.0, 0.0, 0.02, LEAST_TURN),  # but not before one that waited long
        (5.0, 3.5, 0.0, 0.4, 0.02, LEAST_TURN),
        (5.0, 6.0, 0.0, 0.0, 0.02, LEAST_TURN),
        (5.0, 0.0, 5.0, 0.0, 0.02, LEAST_TURN),  # two copies alternate
        (5.0, 0.5, 5.0, 0.0, 0.02, LEAST_TURN),
        (5.0, 0.0, 5.0, 0.0, 0.2, 2.0),
        (5.0, 0.0, 5.0, 0.0, 5.0, LONGEST_TURN),
        (0.0, 0.0, 0.0, 0.0, 0.02, MOST_USE),  # two newcomers
        (0.0, 0.0, 5.0, 0.0, 0.02, 0.6),
    ],
)
async def test_how_long_a_turn_lasts_while_another_user_waits(
    use: float, waited: float, rival_use: float, rival_waited: float, rtt: float, lasts: float
) -> None:
    now, engine = 100.0, Engine(random.Random(1), Flow())
    engine.__class__ = type("Engine", (Engine,), {"rtt": rtt})
    link = NoLink()
    link.engine = engine
    one = Scheduler(cast(Driver, link), clock=lambda: now, rng=random.Random(1))
    turn = Turn(one, user_of(use, 100.0 - waited))
    one._queue[user_of(rival_use, 100.0 - rival_waited)] = None
    while not turn.is_over():
        now += 0.01
        assert now < 110.0
    assert now - 100.0 == pytest.approx(lasts, abs=0.11)


async def test_a_turn_without_a_rival_goes_on() -> None:
    turn = Turn(scheduler(), user_of(5.0))
    await trio.lowlevel.checkpoint()
    assert not turn.is_over()


# --- a reader


def test_only_what_the_cache_lacks_is_wanted() -> None:
    sink = MemorySink(1000)
    stream = FileStream(b"/f", sink, 1000, scheduler())
    sink.on_data(100, bytes(100))
    stream.want(100, 200, demand=True)
    assert stream.idle
    stream.want(0, 300, demand=True)
    assert list(stream._wants.demand.todo) == [(0, 100), (200, 300)]


def test_a_closed_stream_wants_nothing() -> None:
    stream = FileStream(b"/f", MemorySink(1000), 1000, scheduler())
    stream.want(0, 100, demand=True)
    stream.close()
    stream.want(0, 100, demand=True)
    assert stream._wants.idle
