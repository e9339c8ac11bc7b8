"""The remedies for an open that is refused, against a scripted server."""

from __future__ import annotations

import random
from typing import cast

import pytest
import trio

from mavftpfs.link.messages import Address
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.operations import OpenRequest, Operation, Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.doubt import Doubt
from mavftpfs.session.driver import Driver
from mavftpfs.session.serversession import SILENCE_ARDUPILOT, SILENCE_PX4, ServerSession
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.shared.errors import FtpNak, SessionBusy


class Refusing:
    """Stands in for the driver: refuses every open with one code, acknowledges the rest."""

    def __init__(self, code: int) -> None:
        self.code = code
        self.retransmitted = False
        self.log: list[tuple[float, Opcode]] = []
        self.engine = Engine(random.Random(1), Flow())
        self.vehicle = Vehicle(0, 0, Address(254, 191))

    async def run(self, operation: Operation) -> None:
        await trio.lowlevel.checkpoint()
        opcode = operation.opcode if isinstance(operation, Simple) else Opcode.LIST_DIRECTORY
        self.log.append((trio.current_time(), Opcode(opcode)))
        if isinstance(operation, OpenRequest):
            raise FtpNak(operation.opcode, self.code, retransmitted=self.retransmitted)

    async def be_silent(self, seconds: float) -> bool:
        await trio.sleep(seconds)
        return True


def server(code: int) -> tuple[ServerSession, Refusing, Vehicle]:
    driver = Refusing(code)
    made = ServerSession(cast(Driver, driver), Doubt(trio.current_time), trio.current_time)
    return made, driver, driver.vehicle


async def test_a_taken_session_is_waited_out_in_silence_then_reset_then_given_up() -> None:
    made, driver, _ = server(NakCode.NO_SESSIONS_AVAILABLE)
    with pytest.raises(SessionBusy):
        await made.open(b"/f")
    opcodes = [opcode for _, opcode in driver.log]
    assert opcodes == [Opcode.OPEN_FILE_RO] * 3 + [Opcode.RESET_SESSIONS, Opcode.OPEN_FILE_RO]
    assert driver.log[1][0] - driver.log[0][0] == pytest.approx(SILENCE_ARDUPILOT)
    assert driver.log[2][0] - driver.log[1][0] == pytest.approx(SILENCE_PX4)
    assert not made.maybe_open


async def test_sessions_are_not_reset_while_another_client_is_heard() -> None:
    made, driver, vehicle = server(NakCode.INVALID_SESSION)
    vehicle.foreign_at = trio.current_time() + SILENCE_PX4
    with pytest.raises(SessionBusy):
        await made.open(b"/f")
    assert driver.log[-1][0] - driver.log[0][0] == pytest.approx(SILENCE_ARDUPILOT + SILENCE_PX4)


@pytest.mark.parametrize("resent", [False, True])
async def test_a_plain_failure_costs_no_silence(resent: bool) -> None:
    """Asked twice, it may have worked the first time: that is closed before it is asked again."""
    made, driver, _ = server(NakCode.FAIL)
    driver.retransmitted = resent
    with pytest.raises(FtpNak):
        await made.open(b"/f")
    assert (len(driver.log) > 1 and driver.log[1][1] is Opcode.TERMINATE_SESSION) is resent
    assert driver.log[-1][0] == driver.log[0][0]
