"""Which tasks want the session, which goes first, when a turn ends, as tables; what a reader wants of a
file."""

from __future__ import annotations

import random
from typing import cast

import pytest

from mavftpfs.link.messages import Address
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.session.driver import Driver
from mavftpfs.session.reader import FileStream
from mavftpfs.session.scheduler import (
    LONG_WAIT,
    MAX_TURN,
    MIN_TURN,
    RELIEF,
    USE_MEMORY,
    Scheduler,
    SessionUser,
)
from mavftpfs.session.vehicle import Vehicle
from tests.support.transfers import MemorySink


class NoLink:
    """Stands in for the driver: nobody reads."""

    engine = Engine(random.Random(1), Flow())
    vehicle = Vehicle(0, 0, Address(254, 191))


def scheduler() -> Scheduler:
    return Scheduler(cast(Driver, NoLink()), clock=lambda: 0.0)


def heavy(seconds: float = 5.0) -> SessionUser:
    user = SessionUser(b"/f")
    user.on_turn(100.0 - seconds, 100.0)
    return user


def test_use_fades_but_not_while_it_waits() -> None:
    user = heavy(2.0)
    assert user.used(100.0) == 2.0
    assert user.used(100.0 + USE_MEMORY / 2) == pytest.approx(1.0)
    assert user.used(100.0 + 2 * USE_MEMORY) == 0.0
    user.waiting_since = 100.0
    assert user.used(100.0 + USE_MEMORY / 2) == 2.0
    user.on_turn(130.0, 131.0)
    user.waiting_since = None
    assert user.used(131.0) == 3.0


def test_who_used_little_goes_first_until_another_waited_long() -> None:
    busy, light = heavy(), SessionUser(b"/g")
    busy.waiting_since = 100.0
    light.waiting_since = 101.0
    assert light.rank(101.0, 0.02) < busy.rank(101.0, 0.02)
    late = 100.0 + LONG_WAIT
    assert busy.rank(late, 0.02) < light.rank(late, 0.02)
    assert light.rank(late, 1.0) < busy.rank(late, 1.0)


def test_who_waited_long_keeps_the_session_for_a_while() -> None:
    user = heavy()
    user.waiting_since = 100.0
    began = 100.0 + LONG_WAIT
    assert user.gives_way(0.0, began - 0.1, began, 0.02)
    assert not user.gives_way(0.0, began, began + 0.1, 0.02)
    assert user.gives_way(0.0, began, began + RELIEF, 0.02)


@pytest.mark.parametrize(
    ("slice_", "use", "rival", "rtt", "gives_way"),
    [
        (0.0, 5.0, 0.0, 0.02, True),  # an editor beside a copy goes first
        (0.1, 0.0, 0.0, 0.02, False),  # two newcomers do not alternate all the time
        (0.4, 0.0, 0.0, 0.02, True),
        (0.9 * MIN_TURN, 5.0, 5.0, None, False),  # two copies alternate
        (1.1 * MIN_TURN, 5.0, 5.0, None, True),
        (1.1 * MIN_TURN, 5.0, 5.0, 0.2, False),
        (2.1, 5.0, 5.0, 0.2, True),
        (1.1 * MAX_TURN, 5.0, 5.0, 5.0, True),
    ],
)
def test_when_a_turn_ends(
    slice_: float, use: float, rival: float, rtt: float | None, gives_way: bool
) -> None:
    assert heavy(use).gives_way(rival, 100.0, 100.0 + slice_, rtt) is gives_way


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
