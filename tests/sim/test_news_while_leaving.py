"""News of the vehicle that come while the session is closed, when the tree is gone. Virtual time."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path
from random import Random

import pytest
import trio
from trio.testing import MockClock

from mavftpfs import compose
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.fuse.options import MountOptions
from mavftpfs.link.uri import parse_source
from mavftpfs.protocol.payload import Opcode
from tests.support.faults import Faults
from tests.support.memory import MemoryLink
from tests.support.worlds import World, content, world


def join(monkeypatch: pytest.MonkeyPatch, here: World, folder: Path) -> None:
    """Have whoever opens a link, or a spool, get these."""

    @asynccontextmanager
    async def open_link(_: object) -> AsyncIterator[MemoryLink]:
        yield here.link

    monkeypatch.setattr(compose, "open_link", open_link)
    monkeypatch.setattr(compose, "spool_for", lambda _: closing(SpoolDirectory(folder / "spool", Random(1))))


async def test_a_restart_while_leaving_has_nothing_delivered(
    autojump: MockClock, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    here = world("ardupilot", f=content(100))
    join(monkeypatch, here, tmp_path)
    faults = Faults(here)
    async with compose.attached(parse_source("udpin:127.0.0.1:1"), MountOptions(), writing=True) as up:
        await trio.sleep(60.0)
        file = await up.tree.open(b"/d/f", write=True)
        await file.write(0, b"changed")
        assert bytes(await file.read(50, 10)) == content(100)[50:60]
        assert up.connection.scheduler.server.session is not None

        def restart() -> None:
            faults.ignore(Opcode.TERMINATE_SESSION)
            here.vehicle.reboot(trio.current_time(), 1.0)
            here.link.kick()

        faults.at(Opcode.TERMINATE_SESSION, restart)
    assert up.connection.vehicle.reboots == 1
    assert up.tree.undelivered() == [b"/d/f"]
    assert here.tree.data(b"/d/f") == content(100)
