"""What others wait beside a copy by a telemetry radio on a serial port (docs/benchmarks.md, promise 7).

There the window grew until nothing was answered any faster, and stayed as wide: a listing waited in its
queue, 0.74 s beside a download and 1.56 s beside an upload.
"""

from __future__ import annotations

import pytest
from trio.testing import MockClock

from mavftpfs.sim.linkmodel import LinkSettings
from tests.sim.test_latency import RADIO, Copy, p95
from tests.support.worlds import World

pytestmark = pytest.mark.holds("promise 7")

FAR_RADIO = LinkSettings(rate=5760.0, delay=0.15, queue=8192)


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


@pytest.mark.parametrize("profile", ["px4", "px4-nuttx"])
@pytest.mark.parametrize("upload", [False, True], ids=["download", "upload"])
async def test_nor_behind_what_a_copy_sends_at_once(upload: bool, profile: str, autojump: MockClock) -> None:
    """Who comes while the copy's file is opened again waits for what the copy then sends at once. That was
    four chunks, 0.18 s of the link: 1.44 s where 1.38 are allowed."""
    copy = Copy(profile, FAR_RADIO, samples=40)
    copy.world = World(profile, FAR_RADIO, serial=True, tree=copy.world.tree)
    async with copy.world.connection() as connection:
        waits = await (copy.waits_beside_upload if upload else copy.waits)(connection, "read")
    assert p95(waits) <= copy.allowed(3)
