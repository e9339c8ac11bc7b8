"""The lying server lies as it is told, in memory and over every link; the frames by hand are MAVLink."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from trio.testing import MockClock

from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address, FtpFrame, Heartbeat
from mavftpfs.link.opening import open_link
from mavftpfs.link.uri import parse_source
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.session.connection import ConnectOptions, connected
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.sim.tree import MemoryTree
from tests.support.lying import LyingVehicle, ack, ftp, heartbeat, lie_for, nak
from tests.support.vehicles import HOST, free_udp_port
from tests.support.worlds import read_file, world


async def test_replies_are_changed_in_memory(autojump: MockClock) -> None:
    made = world("px4", f=b"honest")
    server = lie_for(made)

    def change(request: Payload, reply: Payload) -> Iterable[Payload]:
        return [ack(request, b"forged") if request.opcode == Opcode.READ_FILE else reply]

    async with made.connection() as connection:
        assert await read_file(connection, b"/d/f") == b"honest"
        server.change = change
        assert await read_file(connection, b"/d/f") == b"forged"
        server.answer = lambda request: [nak(request, NakCode.FILE_PROTECTED)]
        with pytest.raises(MavftpfsError):
            await read_file(connection, b"/d/f")


@pytest.mark.parametrize("kind", ["udpin", "udpout", "tcpin", "tcp"])
async def test_it_speaks_over_any_link(kind: str) -> None:
    tree = MemoryTree()
    tree.add(b"/d/f", b"honest")
    with LyingVehicle(tree, f"{kind}:{HOST}:{free_udp_port()}") as vehicle:
        async with open_link(parse_source(vehicle.source)) as link, connected(link, ConnectOptions()) as made:
            await made.ready(30.0)
            assert await read_file(made, b"/d/f") == b"honest"
            vehicle.server.change = lambda request, reply: [
                reply._replace(data=reply.data.replace(b"honest", b"forged"))
            ]
            assert await read_file(made, b"/d/f") == b"forged"


def test_frames_by_hand_are_mavlink() -> None:
    framer = Framer(Address(254, 191), stream=False)
    (beat,) = framer.feed(heartbeat(armed=True))
    assert isinstance(beat, Heartbeat)
    assert beat.armed
    assert framer.feed(ftp(bytes(range(251)), Address(254, 191))) == [
        FtpFrame(Address(1, 1), Address(254, 191), bytes(range(251)))
    ]
