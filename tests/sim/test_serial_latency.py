"""What others wait beside a copy by a telemetry radio on a serial port (design section 5, promise 7).

There the window grew until nothing was answered any faster, and stayed as wide: a listing waited in its
queue, 0.74 s beside a download and 1.56 s beside an upload.
"""

from __future__ import annotations

import pytest
from trio.testing import MockClock

from tests.sim.test_latency import RADIO, Copy, p95
from tests.support.worlds import World


@pytest.mark.parametrize("profile", ["px4", "px4-nuttx"])
@pytest.mark.parametrize(("kind", "frames"), [("ls", 2), ("read", 3)])
@pytest.mark.parametrize("upload", [False, True], ids=["download", "upload"])
async def test_nobody_waits_long_at_a_serial_port(
    upload: bool, kind: str, frames: int, profile: str, autojump: MockClock
) -> None:
    copy = Copy(profile, RADIO)
    copy.world = World(profile, RADIO, serial=True, tree=copy.world.tree)
    async with copy.world.connection() as connection:
        waits = await (copy.waits_beside_upload if upload else copy.waits)(connection, kind)
    assert p95(waits) <= copy.allowed(frames)
