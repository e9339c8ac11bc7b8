"""What the loss of any one packet costs whoever waits, from the first moment of a mount on."""

from __future__ import annotations

import random

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.sim.linkmodel import Direction, LinkModel, LinkSettings
from mavftpfs.sim.memory import MemoryLink
from tests.support.mounting import mounted
from tests.support.worlds import content, path, world

WIFI = LinkSettings(rate=625_000.0, delay=0.015, queue=300_000)
FTP = 110
LONGEST = 0.6
SMALL = 600


class OneLoss(LinkModel):
    """Loses one of the frames that carry FTP; counts them from 0."""

    def __init__(self, victim: int) -> None:
        super().__init__(random.Random(1), WIFI)
        self.victim = victim
        self.ftp = 0

    def push(self, direction: Direction, frame: bytes, now: float) -> bool:
        if int.from_bytes(frame[7:10], "little") != FTP:
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
