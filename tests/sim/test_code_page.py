"""Names beyond ASCII on a card that takes their bytes for a code page. Virtual time.

To ArduPilot's FatFs, which has page 850 (servers.md 9), the UTF-8 of the first two is one name in two cases.
"""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.shared.errors import AlreadyExists
from mavftpfs.sim.profiles import PROFILES, Storage
from tests.support.fake_writer import write_file
from tests.support.mounting import mounted
from tests.support.worlds import ROOTS, World

FATFS = [name for name, profile in PROFILES.items() if profile.storage is Storage.FATFS]
ONE, OTHER, THIRD = "/d/ä".encode(), "/d/å".encode(), "/d/ö".encode()
OLD, NEW = b"old" * 500, b"new" * 400


@pytest.mark.parametrize("profile", FATFS)
async def test_a_new_name_empties_none_that_the_card_takes_for_it(profile: str, autojump: MockClock) -> None:
    world = World(profile)
    world.tree.add(ONE, OLD)
    world.tree.add(b"/d/plain", NEW)
    async with mounted(world, b"/d") as (_, tree):
        with pytest.raises(AlreadyExists):
            await tree.create(OTHER, exclusive=False)
        with pytest.raises(AlreadyExists):
            await tree.rename(b"/d/plain", OTHER)
        await write_file(tree, THIRD, NEW)
        await write_file(tree, ONE, NEW)
    assert [world.tree.data(path) for path in (ONE, THIRD, b"/d/plain")] == [NEW] * 3


@pytest.mark.parametrize("profile", FATFS)
async def test_nor_one_that_others_made_meanwhile(profile: str, autojump: MockClock) -> None:
    world = World(profile)
    world.tree.add(b"/d/plain", NEW)
    async with mounted(world, b"/d") as (_, tree):
        file = await tree.create(OTHER, exclusive=True)
        await file.write(0, NEW)
        world.tree.add(ONE, OLD)
        await tree.list(b"/d")
        await trio.sleep(21.0)
        await tree.list(b"/d")
        with pytest.raises(AlreadyExists):
            await file.release()
        assert world.tree.data(ONE) == OLD


@pytest.mark.parametrize("profile", sorted(PROFILES))
async def test_other_cards_have_both(profile: str, autojump: MockClock) -> None:
    if profile in FATFS:
        return
    world = World(profile)
    root = ROOTS.get(profile, b"")
    world.tree.add(root + ONE, OLD)
    async with mounted(world, root + b"/d") as (_, tree):
        await write_file(tree, root + OTHER, NEW)
        assert [world.tree.data(root + path) for path in (ONE, OTHER)] == [OLD, NEW]
