"""Links over real sockets and ptys; the other end is a bare descriptor."""

from __future__ import annotations

import os
import socket
import tty
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from pathlib import Path

import pytest
import trio
import trio.testing

from mavftpfs.link.base import MAX_DATAGRAM, Link, PipeLink
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address, Heartbeat
from mavftpfs.link.opening import open_link
from mavftpfs.link.stream import StreamLink
from mavftpfs.link.udp import UdpLink
from mavftpfs.link.uri import parse_source
from mavftpfs.shared.errors import LinkClosed
from tests.support.frames import feed
from tests.support.vehicles import free_udp_port, has_ipv6

pytestmark = pytest.mark.real_time

US = Address(254, 191)
DRONE = Address(1, 1)
PAYLOAD = bytes(range(1, 252))
HOST = "127.0.0.1"


@asynccontextmanager
async def opened(source: str) -> AsyncIterator[Link]:
    """Open a link; a time-out ends a test that hangs."""
    with trio.fail_after(120):
        async with open_link(parse_source(source)) as link:
            yield link


@asynccontextmanager
async def udpin() -> AsyncIterator[tuple[UdpLink, int]]:
    async with opened(f"udpin:{HOST}:0") as link:
        assert isinstance(link, UdpLink)
        yield link, parse_source(link.description).port


@contextmanager
def udp_socket(host: str = HOST, port: int = 0) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((host, port))
        sock.settimeout(60)
        yield sock


async def read_bytes(link: Link, size: int) -> bytes:
    data = b""
    with trio.fail_after(60):
        while len(data) < size:
            data += b"".join(await pieces(link))
    return data


async def pieces(link: Link) -> list[bytes]:
    """Return what arrived; b"" for "reopened"."""
    return [data for data, _ in await link.receive()]


# ---------------------------------------------------------------------- UDP


async def test_frames_are_packed_below_the_limit() -> None:
    async with udpin() as (link, port):
        with udp_socket() as peer:
            peer.sendto(b"hello", (HOST, port))
            await link.receive()
            frames = [bytes([n]) * 266 for n in range(12)]
            link.send(frames)
            datagrams = [peer.recv(65535) for _ in range(3)]
        assert b"".join(datagrams) == b"".join(frames)
        assert [len(d) for d in datagrams] == [5 * 266, 5 * 266, 2 * 266]
        assert max(map(len, datagrams)) <= MAX_DATAGRAM
        assert link.stats.sent_bytes == 12 * 266


async def test_answers_the_latest_sender_or_whom_it_is_told() -> None:
    async with udpin() as (link, port):
        with udp_socket() as vehicle, udp_socket() as stranger:
            vehicle.sendto(b"beat", (HOST, port))
            stranger.sendto(b"noise", (HOST, port))
            assert await read_bytes(link, 9) == b"beatnoise"
            link.send([b"to the latest"])
            assert stranger.recv(100) == b"to the latest"

            vehicle.sendto(b"beat", (HOST, port))
            stranger.sendto(b"noise", (HOST, port))
            await trio.sleep(0.05)
            assert await link.receive() == [
                (b"beat", vehicle.getsockname()),
                (b"noise", stranger.getsockname()),
            ]
            link.send([b"to the vehicle"], vehicle.getsockname())
            assert vehicle.recv(100) == b"to the vehicle"


@pytest.mark.holds("rule 14.37")
async def test_udpout_keeps_one_port_and_does_not_mind_a_closed_one() -> None:
    port, ours = free_udp_port(), free_udp_port()
    async with open_link(parse_source(f"udpout:{HOST}:{port}"), source_port=ours) as link:
        for _ in range(3):  # each is answered by ICMP "port unreachable"
            link.send([b"anybody?"])
            with trio.move_on_after(0.05):
                await link.receive()
                pytest.fail("there is nobody")
        with udp_socket(port=port) as vehicle:
            link.send([b"hello"])
            data, sender = vehicle.recvfrom(100)
            assert (data, sender[1]) == (b"hello", ours)
            vehicle.sendto(b"welcome", sender)
            assert await pieces(link) == [b"welcome"]
        assert link.stats.dropped_sends == 0


async def test_udpout_listens_to_its_host_only() -> None:
    with udp_socket() as vehicle, udp_socket("127.0.0.2") as stranger:
        async with opened(f"udpout:{HOST}:{vehicle.getsockname()[1]}") as link:
            link.send([b"hello"])
            _, sender = vehicle.recvfrom(100)
            stranger.sendto(b"evil", sender)
            vehicle.sendto(b"good", sender)
            assert await pieces(link) == [b"good"]


async def test_ipv6() -> None:
    if not has_ipv6():  # then the link has to say so
        with pytest.raises(LinkClosed, match="not an address of this computer"):
            async with opened("udpin:[::1]:0"):
                pytest.fail("it opened")
        return
    async with opened("udpin:[::1]:0") as link, opened(link.description.replace("udpin", "udpout")) as other:
        other.send([b"six"])
        assert await pieces(link) == [b"six"]
        link.send([b"back"])
        assert await pieces(other) == [b"back"]


# ---------------------------------------------------------------------- closing and failing


@pytest.mark.parametrize("source", [f"udpin:{HOST}:0", f"tcpin:{HOST}:0"])
async def test_closing_wakes_the_receiver(source: str) -> None:
    async with opened(source) as link, trio.open_nursery() as nursery:

        async def receive() -> None:
            with pytest.raises(LinkClosed):
                await link.receive()

        nursery.start_soon(receive)
        await trio.testing.wait_all_tasks_blocked()
        assert isinstance(link, PipeLink)
        await link.aclose()
        await link.aclose()
        link.send([b"into the void"])


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("udpin:198.51.100.1:14550", "is not an address of this computer"),
        ("tcpin:198.51.100.1:5760", "is not an address of this computer"),
        ("/dev/ttyNOPE7", "there is no /dev/ttyNOPE7; is the vehicle plugged in?"),
        (f"tcp:{HOST}:1", "nothing listens on port 1"),
        ("tcp:no-such-host.invalid:1", "no-such-host.invalid"),
        ("udpout:no-such-host.invalid:1", "host 'no-such-host.invalid' is unknown"),
        ("udpin:a..b:5760", "is not a host name"),
        ("tcp:\N{SNOWMAN}.example:5760", "is not a host name"),
        ("/dev/null", "/dev/null is not a serial port"),
        ("/proc", "/proc is not a serial port"),
    ],
)
async def test_what_cannot_be_opened_says_why_in_a_line(source: str, says: str) -> None:
    with pytest.raises(LinkClosed) as caught:
        async with opened(source):
            pytest.fail("it opened")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["udpin", "tcpin", "serial"])
async def test_what_somebody_else_uses(kind: str) -> None:
    async with AsyncExitStack() as stack:
        if kind == "serial":
            link: Link = (await stack.enter_async_context(opened_pty()))[0]
        else:
            link = await stack.enter_async_context(opened(f"{kind}:{HOST}:0"))
        with pytest.raises(LinkClosed, match="is in use by another program"):
            async with opened(link.description):
                pytest.fail("it opened")


# ---------------------------------------------------------------------- TCP


async def accept(listener: socket.socket) -> socket.socket:
    with trio.fail_after(60):
        await trio.lowlevel.wait_readable(listener)
        peer, _ = listener.accept()
        peer.setblocking(True)
        peer.settimeout(60)
        return peer


def listening(port: int = 0) -> socket.socket:
    listener = socket.create_server((HOST, port))
    listener.setblocking(False)
    return listener


async def lose(link: Link) -> None:
    """Receive until the link has noticed that the other end is gone."""
    assert isinstance(link, StreamLink)
    async with trio.open_nursery() as nursery:

        async def receive() -> None:
            await link.receive()
            pytest.fail("nothing was sent")

        nursery.start_soon(receive)
        while link.connected:  # noqa: ASYNC110 (a link tells nobody)
            await trio.sleep(0.01)
        nursery.cancel_scope.cancel()


async def test_tcp_connects_again_and_says_so() -> None:
    with listening() as listener:
        port = listener.getsockname()[1]
        async with opened(f"tcp:{HOST}:{port}") as link:
            with await accept(listener) as peer:
                peer.sendall(b"one")
                assert await pieces(link) == [b"one"]
            listener.close()
            await lose(link)
            link.send([b"lost"])
            assert link.stats.dropped_sends == 1
            with listening(port) as again:
                async with trio.open_nursery() as nursery:
                    chunks: list[list[bytes]] = []

                    async def receive() -> None:
                        chunks.append(await pieces(link))

                    nursery.start_soon(receive)
                    peer = await accept(again)
                with peer:
                    assert chunks == [[b""]]
                    peer.sendall(b"two")
                    assert await pieces(link) == [b"two"]
                    link.send([b"back"])
                    assert peer.recv(100) == b"back"
            assert link.stats.reopened == 1


async def test_tcpin_serves_one_peer_and_then_the_next() -> None:
    async with opened(f"tcpin:{HOST}:0") as link:
        address = (HOST, parse_source(link.description).port)
        link.send([b"nobody there"])
        assert link.stats.dropped_sends == 1
        first = socket.create_connection(address)
        first.sendall(b"first")
        assert await pieces(link) == [b"first"]
        with socket.create_connection(address) as second:
            second.settimeout(60)
            second.sendall(b"second")
            with trio.move_on_after(0.1):
                await link.receive()
                pytest.fail("the first peer is still there")
            first.close()
            assert await pieces(link) == [b""]
            assert await pieces(link) == [b"second"]
            link.send([b"hello second"])
            assert second.recv(100) == b"hello second"


async def test_a_slow_peer_costs_whole_frames_never_parts() -> None:
    framer = Framer(US, stream=True)
    async with opened(f"tcpin:{HOST}:0") as link:
        with socket.socket() as peer:
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            peer.connect((HOST, parse_source(link.description).port))
            peer.sendall(b"x")
            await link.receive()
            built = 0
            while link.stats.dropped_sends < 50:
                link.send([framer.encode_ftp(DRONE, PAYLOAD) for _ in range(7)])
                built += 7
                assert link.backlog <= 64 * 1024 + 7 * 266
                assert built < 100_000
            peer.setblocking(False)
            other = Framer(DRONE, stream=True)
            received = 0
            with trio.fail_after(60):
                while received < built - link.stats.dropped_sends:
                    await trio.lowlevel.wait_readable(peer)
                    received += len(feed(other, peer.recv(65536)))
            assert link.backlog == 0
            link.send([framer.encode_heartbeat(18)])
            await trio.lowlevel.wait_readable(peer)
            assert [type(m) for m in other.feed(peer.recv(65536))] == [Heartbeat]
            assert other.stats.bad_crc == 0


# ---------------------------------------------------------------------- serial


@asynccontextmanager
async def opened_pty(baud: int = 115200) -> AsyncIterator[tuple[StreamLink, int]]:
    """Open a link on a new pty; also returns the other end."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    try:
        async with opened(f"{os.ttyname(slave)},{baud}") as link:
            assert isinstance(link, StreamLink)
            yield link, master
    finally:
        os.close(master)
        os.close(slave)


async def test_frames_that_go_out_together_are_one_write(monkeypatch: pytest.MonkeyPatch) -> None:
    """A system call for each frame is a tenth of what a chunk costs."""
    frames = [bytes([n]) * 266 for n in range(10)]
    write, sizes = os.write, list[int]()

    def noted(descriptor: int, data: bytes) -> int:
        sizes.append(len(data))
        return write(descriptor, data)

    async with opened_pty() as (link, other):
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", noted)
            link.send(frames)
        assert sizes == [link.stats.sent_bytes] == [10 * 266]
        got = b""
        while len(got) < 10 * 266:
            await trio.lowlevel.wait_readable(other)
            got += os.read(other, 4096)
        assert got == b"".join(frames)


async def test_a_frame_that_was_begun_is_finished() -> None:
    """The limit on waiting bytes cuts no frame, because a hole in a stream costs the next frame, too."""
    frames = [bytes([n]) * 1000 for n in range(20)]
    async with opened_pty(9600) as (link, master):
        link.send(frames)
        assert link.backlog > 4096
        link.send([b"too much"])
        got = b""
        while len(got) < 20_000:
            await trio.lowlevel.wait_readable(master)
            got += os.read(master, 700)
        assert got == b"".join(frames)
        assert (link.backlog, link.stats.dropped_sends) == (0, 1)


@pytest.mark.holds("promise 5")
async def test_serial_comes_back_when_the_device_does(tmp_path: Path) -> None:
    device = tmp_path / "ttyDRONE"
    master, slave = os.openpty()
    device.symlink_to(os.ttyname(slave))
    async with opened(f"{device},57600") as link:
        with trio.move_on_after(0.1):  # a read of nothing must not look like the end (VMIN 0 would)
            await link.receive()
            pytest.fail("nothing was sent")
        os.write(master, b"before")
        assert await read_bytes(link, 6) == b"before"
        device.unlink()
        os.close(slave)
        os.close(master)  # unplugged
        with trio.move_on_after(0.4):
            await link.receive()
            pytest.fail("it is gone")
        link.send([b"lost"])
        assert link.stats.dropped_sends == 1
        master, slave = os.openpty()
        device.symlink_to(os.ttyname(slave))  # plugged in again, under another number
        assert await pieces(link) == [b""]
        os.write(master, b"after")
        assert await read_bytes(link, 5) == b"after"
        assert link.stats.reopened == 1
        os.close(slave)
        os.close(master)


async def test_a_flood_starves_nobody() -> None:
    """A task that receives without end lets other tasks run after each batch."""
    ran = 0

    async def bystander() -> None:
        nonlocal ran
        while True:
            ran += 1
            await trio.lowlevel.checkpoint()

    async with udpin() as (link, port), trio.open_nursery() as nursery:
        with udp_socket() as peer:
            nursery.start_soon(bystander)
            for turn in range(50):
                peer.sendto(b"x", (HOST, port))
                assert await pieces(link) == [b"x"]
                assert ran >= turn
            nursery.cancel_scope.cancel()


async def test_cancelling_receive_loses_nothing() -> None:
    async with udpin() as (link, port):
        got: list[bytes] = []
        with udp_socket() as peer:
            for n in range(200):
                peer.sendto(n.to_bytes(2, "big"), (HOST, port))
                with trio.CancelScope() as scope:
                    if n % 3 == 1:
                        scope.cancel()
                    if n % 3 == 2:  # noticed at the next checkpoint
                        scope.deadline = float("-inf")
                    got += await pieces(link)
            while len(got) < 200:
                got += await pieces(link)
        assert [int.from_bytes(c, "big") for c in got] == list(range(200))
