"""Whatever a server answers, a file is open, or may be open, or none is: never two at once."""

from __future__ import annotations

import random
from contextlib import suppress
from typing import cast

import trio
from hypothesis import given, settings
from hypothesis import strategies as st
from trio.testing import MockClock

from mavftpfs.link.messages import Address
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.operations import OpenRequest, Simple
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.protocol.requests import Operation
from mavftpfs.session.driver import Driver
from mavftpfs.session.scheduler import Scheduler
from mavftpfs.session.serversession import ServerSession
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.shared.errors import FtpNak, MavftpfsError, RequestTimeout

ANSWERS = st.sampled_from(["ack", "ack", "ack", "taken", "silence", "forever", 1, 4, 5, 8, 10])
ACTS = st.sampled_from(["read", "write", "close", "abandon", "restart", "close maybe open", "exclude"])


class Answering:
    """Stands in for the driver: answers as it is told, then acknowledges."""

    def __init__(self, answers: list[str | int]) -> None:
        self._answers = answers
        self.engine = Engine(random.Random(1), Flow())
        self.vehicle = Vehicle(0, 0, Address(254, 191))
        self.server: ServerSession

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
            operation.on_opened(operation)
            if answer == "taken":  # another client has it, before the caller goes on
                self.server.leave()

    async def be_silent(self, seconds: float) -> None:
        await trio.sleep(seconds)


@given(st.lists(st.tuples(ACTS, st.lists(ANSWERS, max_size=6)), max_size=12))
@settings(max_examples=200, deadline=None)
def test_what_is_open_is_known_or_in_doubt(acts: list[tuple[str, list[str | int]]]) -> None:
    trio.run(_play, acts, clock=MockClock(autojump_threshold=0))


async def _play(acts: list[tuple[str, list[str | int]]]) -> None:
    driver = Answering([])
    scheduler = Scheduler(
        cast(Driver, driver), clock=trio.current_time, rng=random.Random(1), op_deadline=10.0
    )
    server = driver.server = scheduler.server
    for number, (act, answers) in enumerate(acts):
        driver._answers = list(answers)
        with trio.move_on_after(60), suppress(MavftpfsError):
            await _do(scheduler, act, b"/f%d" % (number % 3))
        session = server.opened
        assert session is None or not server.maybe_open
        assert server.engine.session == (server.engine.home_session if session is None else session.id)
        if act == "close maybe open" and not answers:
            assert not server.maybe_open


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
            server.leave()
        case "restart":
            server.leave()
            server.engine.forget_server()
        case "exclude":
            async with trio.open_nursery() as nursery:
                nursery.start_soon(_change, scheduler, path)
                await trio.sleep(1)
                await scheduler.tidy()
                nursery.cancel_scope.cancel()


async def _change(scheduler: Scheduler, path: bytes) -> None:
    async with scheduler.excluded(path):
        session = scheduler.server.opened
        assert session is None or session.path != path
