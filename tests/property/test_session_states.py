"""Whatever a server answers, the session goes through the states of its table and nothing else."""

from __future__ import annotations

import random
from contextlib import suppress
from typing import cast

import pytest
import trio
from hypothesis import given, settings
from hypothesis import strategies as st
from trio.testing import MockClock

from mavftpfs.link.messages import Address
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.operations import OpenRequest, Operation, Simple
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.session.doubt import Doubt
from mavftpfs.session.driver import Driver
from mavftpfs.session.scheduler import Scheduler
from mavftpfs.session.serversession import SESSION_NEXT, ServerSession, State
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.shared.errors import FtpNak, MavftpfsError, RequestTimeout

ANSWERS = st.sampled_from(["ack", "ack", "ack", "silence", "forever", 1, 4, 5, 8, 10])
ACTS = st.sampled_from(["read", "write", "close", "abandon", "restart", "close maybe open", "exclude"])


class Answering:
    """Stands in for the driver: answers as it is told, then acknowledges."""

    def __init__(self, answers: list[str | int]) -> None:
        self._answers = answers
        self.engine = Engine(random.Random(1), Flow())
        self.vehicle = Vehicle(0, 0, Address(254, 191))

    async def run(self, operation: Operation) -> None:
        await trio.lowlevel.checkpoint()
        answer = self._answers.pop(0) if self._answers else "ack"
        if answer == "silence":
            raise RequestTimeout("no answer")
        if answer == "forever":
            await trio.sleep_forever()
        opcode = Opcode.OPEN_FILE_RO
        if isinstance(operation, Simple):
            opcode = Opcode(operation.opcode)
        if isinstance(answer, int):
            raise FtpNak(opcode, NakCode(answer), retransmitted=answer % 2 == 1)
        if isinstance(operation, OpenRequest):
            operation.session, operation.reply = 1, Payload(1, 0, Opcode.ACK, 0, opcode)

    async def be_silent(self, seconds: float) -> bool:
        await trio.sleep(seconds)
        return True


@given(st.lists(st.tuples(ACTS, st.lists(ANSWERS, max_size=6)), max_size=12))
@settings(max_examples=200, deadline=None)
def test_all_goes_by_the_table(acts: list[tuple[str, list[str | int]]]) -> None:
    trio.run(_play, acts, clock=MockClock(autojump_threshold=0))


async def _play(acts: list[tuple[str, list[str | int]]]) -> None:
    driver = Answering([])
    scheduler = Scheduler(cast(Driver, driver), clock=trio.current_time, op_deadline=10.0)
    server = scheduler.server
    for number, (act, answers) in enumerate(acts):
        driver._answers = list(answers)
        with trio.move_on_after(60), suppress(MavftpfsError):
            await _do(scheduler, act, b"/f%d" % (number % 3))
        assert (server.session is not None) == (server.state is State.OPEN)
        if server.state in (State.CLOSED, State.MAYBE_OPEN):
            assert bool(server.maybe_open) == (server.state is State.MAYBE_OPEN)


async def _do(scheduler: Scheduler, act: str, path: bytes) -> None:
    server = scheduler.server
    match act:
        case "read":
            await server.open(path)
        case "write":
            await server.open(path, Opcode.CREATE_FILE)
        case "close":
            await server.close()
        case "close maybe open":
            await server.close_maybe_open()
        case "abandon":
            server.abandon()
        case "restart":
            server.abandon()
            server.engine.forget_server()
        case "exclude":
            async with trio.open_nursery() as nursery:
                nursery.start_soon(_change, scheduler, path)
                await trio.sleep(1)
                await scheduler._close_excluded()
                nursery.cancel_scope.cancel()


async def _change(scheduler: Scheduler, path: bytes) -> None:
    async with scheduler.excluded(path):
        session = scheduler.server.session
        assert session is None or session.path != path


def test_a_step_that_is_not_in_the_table_is_a_bug() -> None:
    assert set(SESSION_NEXT) == set(State)
    server = ServerSession(cast(Driver, Answering([])), Doubt(lambda: 0.0), lambda: 0.0)
    with pytest.raises(AssertionError):
        server._enter(State.CLOSING)
