"""A file that a close could not deliver, and an outage that no news tells of. Virtual time."""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.sim.profiles import PROFILES
from tests.sim.test_arming_replacement import Scene
from tests.support.faults import Faults


@pytest.mark.holds("promise 3")
@pytest.mark.parametrize("patience", [5.0, 100.0])
@pytest.mark.parametrize("profile", list(PROFILES))
async def test_requests_unanswered_beside_heartbeats(
    profile: str, patience: float, autojump: MockClock
) -> None:
    """patience: of whoever waits for the close; if it is less than a request has, no error is left."""
    scene = Scene(profile)
    faults = Faults(scene.world)
    target = scene.root + b"/new"
    async with scene.mounted() as tree:
        await tree.list(scene.root)
        file = await tree.create(target, exclusive=True)
        await file.write(0, b"content" * 100)
        faults.cut_after(0)
        with trio.move_on_after(patience):
            with pytest.raises(MavftpfsError):
                await file.release()
        assert tree.undelivered() == [target]
        faults.cut_after(None)
        await trio.sleep(60)
        assert tree.undelivered() == []
        assert scene.world.tree.data(target) == b"content" * 100
