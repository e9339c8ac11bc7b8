"""What the loss of any one packet costs whoever waits, from the first moment of a mount on."""

from __future__ import annotations

import random

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.protocol.payload import Opcode
from mavftpfs.sim.linkmodel import Direction, LinkModel, LinkSettings
from tests.support.memory import MemoryLink
from tests.support.mounting import mounted
from tests.support.worlds import content, path, world

pytestmark = pytest.mark.holds("rule 14.38")

WIFI = LinkSettings(rate=625_000.0, delay=0.015, queue=300_000)
FTP = 110
OPCODE, REQ_OPCODE = 16, 18
"""Where they are in a frame."""

LONGEST = 0.6
SMALL = 600


class OneLoss(LinkModel):
    """Loses one of the frames that carry FTP, or just those about one opcode; counts them from 0."""

    def __init__(self, victim: int, about: int | None = None) -> None:
        super().__init__(random.Random(1), WIFI)
        self.victim = victim
        self.about = about
        self.ftp = 0

    def push(self, direction: Direction, frame: bytes, now: float) -> bool:
        asked = frame[OPCODE if direction is Direction.TO_VEHICLE else REQ_OPCODE]
        if int.from_bytes(frame[7:10], "little") != FTP or self.about not in (None, asked):
            return super().push(direction, frame, now)
        self.ftp += 1
        return self.ftp - 1 == self.victim or super().push(direction, frame, now)


async def first_steps(profile: str, victim: int) -> tuple[float, int]:
    """Mount, list and read a small file at once; return how long that took, and how many frames it was."""
    here, model = world(profile, WIFI, f=content(SMALL)), OneLoss(victim)
    here.link = MemoryLink(here.vehicle, model)
    target = path(profile, "f")
    async with mounted(here) as (_, tree):
        began = trio.current_time()
        assert dict(await tree.list(target[:-2])).keys() == {b"f"}
        handle = await tree.open(target)
        assert await handle.read(0, SMALL) == content(SMALL)
        took, frames = trio.current_time() - began, model.ftp
        await handle.release()
    return took, frames


@pytest.mark.parametrize("profile", ["ardupilot", "mavsdk", "px4"])
async def test_no_one_loss_costs_a_second(profile: str, autojump: MockClock) -> None:
    """The very first listing, of a server of which no round trip was known, was asked for again after 1 s."""
    usual, frames = await first_steps(profile, -1)
    assert frames > 6
    cost = [(await first_steps(profile, victim))[0] - usual for victim in range(frames)]
    assert max(cost) <= LONGEST


async def upload(profile: str, victim: int) -> float:
    """Return how long a close takes of a new file; victim: which frame about its checksum is lost."""
    data = content(600_000)
    here = world(profile, WIFI)
    here.link = MemoryLink(here.vehicle, model := OneLoss(victim, Opcode.CALC_FILE_CRC32))
    target = path(profile, "new")
    async with mounted(here, target[:-4]) as (_, tree):
        file = await tree.create(target, exclusive=False)
        await file.write(0, data)
        began = trio.current_time()
        await file.flush()
        took = trio.current_time() - began
        assert here.tree.data(target) == data
        await file.release()
    assert model.ftp > max(1, victim)
    return took


@pytest.mark.parametrize("victim", [0, 1], ids=["question", "answer"])
@pytest.mark.parametrize("profile", ["ardupilot", "mavsdk", "px4"])
async def test_nor_does_that_of_a_checksum_cost_what_the_slowest_card_takes(
    profile: str, victim: int, autojump: MockClock
) -> None:
    """It was asked for again after 6.3 s, where the whole copy takes one or two."""
    usual = await upload(profile, -1)
    assert await upload(profile, victim) - usual <= 1.0
