"""When what delivers a file may be called off."""

from __future__ import annotations

import pytest
import trio

from mavftpfs.cache.nodes import Node


@pytest.mark.parametrize("firm", [False, True])
async def test_a_rest_ends_before_the_last_step_or_after_it(firm: bool) -> None:
    node, done = Node(b"/f"), False
    with trio.CancelScope() as node.resting:
        if firm:
            async with node.firmly():
                node.end_rest()
                await trio.lowlevel.checkpoint()
                done = True
        else:
            node.end_rest()
            await trio.lowlevel.checkpoint()
            done = True
    assert done is firm


async def test_without_a_rest_there_is_nothing_to_end() -> None:
    Node(b"/f").end_rest()
