"""A card that pauses makes us ask twice; that is no reason to fear the path (unit/test_duplicates)."""

from __future__ import annotations

import pytest
import trio
from trio.testing import MockClock

from mavftpfs.cache.tree import Tree
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.mounting import mounted
from tests.support.trees import content
from tests.support.worlds import World

pytestmark = pytest.mark.holds("fault duplicate")

FOLDER = b"/fs/microsd/"
LINKS = {"usb": LinkSettings(rate=1e6, delay=0.001, queue=100_000), "far": LinkSettings(rate=1e5, delay=0.03)}
FILES = 20


async def make(tree: Tree, name: bytes, data: bytes) -> None:
    """Make a file, and close it."""
    file = await tree.create(name, exclusive=True)
    try:
        await file.write(0, data)
        await file.flush()
    finally:
        file.close()


@pytest.mark.parametrize("link", LINKS)
async def test_small_files_do_not_wait_for_each_other(link: str, autojump: MockClock) -> None:
    here = World("px4-nuttx", LINKS[link])
    here.tree.add(FOLDER + b"log", content("log", 400_000))
    async with mounted(here) as (connection, tree):
        file = await tree.open(FOLDER + b"log")
        assert await file.read(0, 400_000) == content("log", 400_000)
        file.close()
        await make(tree, FOLDER + b"large", content("large", 400_000))
        stats = connection.engine.stats
        assert stats.unknown + stats.spurious > 0
        assert stats.strays == 0
        begun = trio.current_time()
        for number in range(FILES):
            await make(tree, FOLDER + b"%d" % number, content(f"small {number}", 500))
        took = trio.current_time() - begun
        assert stats.strays == 0
    for number in range(FILES):
        assert here.tree.data(FOLDER + b"%d" % number) == content(f"small {number}", 500)
    # Five round trips for each, and the card's own pauses; each waited for 0.25 to 1 s more.
    assert took < FILES * (7 * 2 * LINKS[link].delay + 0.1)
