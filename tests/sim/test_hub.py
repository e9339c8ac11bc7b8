"""The hub between real sockets: endpoints that cannot be opened, clients that come and go."""

from __future__ import annotations

import socket
import tracemalloc
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import pytest
import trio
import trio.testing

from mavftpfs.hub.hub import run_hub
from mavftpfs.link.base import REOPENED, plain_nursery
from mavftpfs.link.framing import Framer
from mavftpfs.link.hublink import (
    PROTOCOL,
    Facts,
    HubLink,
    PortRequest,
    hear,
    join,
    pack_facts,
    pack_frames,
    set_buffers,
    tell,
)
from mavftpfs.link.messages import Address
from mavftpfs.link.ports import connect, next_caller, port_name, take_name
from mavftpfs.link.sharing import open_shared
from mavftpfs.link.uri import parse_source
from mavftpfs.shared.errors import LinkClosed
from tests.support.vehicles import free_udp_port
from tests.unit.test_ports import as_nobody

pytestmark = pytest.mark.real_time

HOST = "127.0.0.1"
US = Address(254, 191)


@pytest.fixture
def autojump_clock() -> trio.testing.MockClock:
    """Virtual time that leaves the kernel and name servers a moment to answer."""
    return trio.testing.MockClock(autojump_threshold=0.05)


class Running:
    """A hub that runs, with one client."""

    def __init__(self, source: str, ended: trio.Event) -> None:
        self.source = source
        self.ended = ended
        self._name = port_name(parse_source(source))

    def call(self) -> socket.socket:
        """Return a new connection to the hub."""
        return connect(self._name)

    async def joined(self, *forward: str, source: str = "") -> HubLink:
        """Return another client."""
        return await join(self.call(), parse_source(source or self.source), PortRequest(US, forward), None)

    async def asked(self, request: Facts) -> Facts:
        """Return what the hub replies to a request."""
        with self.call() as sock:
            tell(sock, request)
            return await hear(sock, 60) or {}

    async def status(self) -> Facts:
        return await self.asked({"protocol": PROTOCOL, "status": True})


@asynccontextmanager
async def running(*forward: str, source: str = "") -> AsyncIterator[Running]:
    """Run a hub of a port, with one client that had the port and asks for these endpoints."""
    source = source or f"udpin:{HOST}:{free_udp_port()}"
    spec = parse_source(source)
    ended = trio.Event()

    async def run() -> None:
        await run_hub(spec)
        ended.set()

    async with plain_nursery() as nursery:
        name = take_name(port_name(spec))
        assert name is not None
        with name:
            nursery.start_soon(run)
            sock = await next_caller(name)
            sock.setblocking(False)
            assert "hub" in (await hear(sock, 60) or {})
        first = await join(sock, spec, PortRequest(US, forward), None)
        yield Running(source, ended)
        await first.aclose()


class SlowNames(trio.abc.HostnameResolver):
    """A name server that takes three seconds for a name that is known, and for one that is not."""

    async def getaddrinfo(self, host: Any, port: Any, *args: Any, **kwargs: Any) -> Any:
        if host == b"slow.example":
            await trio.sleep(3)
            host = HOST
        elif host == b"nowhere.example":
            await trio.sleep(3)
            raise socket.gaierror(socket.EAI_NONAME, "unknown")
        return socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)

    async def getnameinfo(self, sockaddr: Any, flags: int) -> Any:
        raise NotImplementedError


async def test_endpoints_stay_while_the_client_that_wants_them_waits_for_another_one(
    autojump_clock: trio.testing.MockClock,
) -> None:
    trio.socket.set_custom_hostname_resolver(SlowNames())
    async with running() as here:
        places = f"udpout:{HOST}:{free_udp_port()}", f"udpout:slow.example:{free_udp_port()}"
        client = await here.joined(*places)
        assert {facts["endpoint"] for facts in (await here.status())["endpoints"]} == set(places)
        await client.aclose()
        await trio.sleep(5)
        assert (await here.status())["endpoints"] == []


async def test_of_two_programs_that_want_an_endpoint_that_cannot_be_both_are_told(
    autojump_clock: trio.testing.MockClock,
) -> None:
    trio.socket.set_custom_hostname_resolver(SlowNames())

    async def is_refused() -> None:
        with pytest.raises(LinkClosed, match="unknown"):
            await here.joined(endpoint)

    endpoint = f"udpout:nowhere.example:{free_udp_port()}"
    async with running() as here:
        async with trio.open_nursery() as nursery:
            nursery.start_soon(is_refused)
            nursery.start_soon(is_refused)
        assert (await here.status())["endpoints"] == []


async def test_a_hub_may_be_asked_and_stopped_by_another_version_but_not_joined(
    autojump_clock: trio.testing.MockClock,
) -> None:
    async with running() as here:
        for request, reply in ({"join": here.source}, "refused"), ({"status": True}, "clients"):
            assert reply in await here.asked({"protocol": PROTOCOL + 1, **request})
        await here.asked({"protocol": PROTOCOL + 1, "stop": True})
        await here.ended.wait()


@pytest.mark.needs("root")
@pytest.mark.holds("promise 10")
async def test_another_user_neither_joins_a_hub_nor_stops_it(autojump_clock: trio.testing.MockClock) -> None:
    async with running() as here:
        for request in {"protocol": PROTOCOL, "join": here.source}, {"stop": True}:
            with as_nobody():
                sock = here.call()
            with sock:
                tell(sock, request)
                assert "another user" in (await hear(sock, 60) or {}).get("refused", "")
        assert not here.ended.is_set()


async def test_no_more_programs_are_let_in_than_there_are_addresses(
    autojump_clock: trio.testing.MockClock,
) -> None:
    async with running() as here, AsyncExitStack() as stack:
        for _ in range(248):
            stack.push_async_callback((await here.joined()).aclose)
        with pytest.raises(LinkClosed, match="249 programs"):
            await here.joined()
        clients = (await here.status())["clients"]
        assert len({tuple(client["address"]) for client in clients}) == 249


HELLO = {"protocol": PROTOCOL, "own": US, "number": None, "forward": [], "join": "udpin:127.0.0.1:1"}
WRONG: list[dict[str, Any]] = [
    *({"join": 5}, {"join": None}, {"join": "udpin"}, {"forward": 5}, {"forward": [None]}),
    *({"own": 5}, {"own": [1]}, {"own": ["a", "b"]}, {"own": [[], {}]}, {"number": [1]}, {"protocol": {}}),
]
GARBAGE = [
    *(b"", b"\0", b"{", b"{}", b"\xff\xfe", b'{"\xff": 1}', b"F", b"F\xff", b"[]", b"0"),
    b'{"join": ' + b"[" * 60_000,
    *(pack_facts(HELLO | wrong) for wrong in WRONG),
]
NONSENSE: list[Any] = ["x", -1, True, (), 5, None, "host", (5, 5), ("x", 70_000), ("x", "y"), ("x",)]


async def test_a_program_that_talks_nonsense_disturbs_nobody(
    autojump_clock: trio.testing.MockClock,
) -> None:
    async with running() as here:
        for message in GARBAGE:
            with here.call() as sock:
                sock.send(message)
                await trio.sleep(0.1)
        client = await here.joined()
        for fact in NONSENSE:
            client.send([Framer(US, stream=False).encode_heartbeat(18)], fact)
            await trio.sleep(0.1)
        assert len((await here.status())["clients"]) == 2
        await client.aclose()


async def test_a_port_is_shared_while_its_vehicle_restarts(
    autojump_clock: trio.testing.MockClock,
) -> None:
    with socket.create_server((HOST, 0)) as server:
        source = f"tcp:{HOST}:{server.getsockname()[1]}"
    async with running(source=source) as here:
        assert len((await here.status())["clients"]) == 1


async def test_only_the_same_port_is_shared(autojump_clock: trio.testing.MockClock) -> None:
    async with running() as here:
        anywhere, elsewhere = (here.source.replace(HOST, host) for host in ("0.0.0.0", "127.0.0.2"))
        await (await here.joined(source=anywhere)).aclose()
        with pytest.raises(LinkClosed, match="is shared already"):
            await here.joined(source=elsewhere)


# -- clients ----------------------------------------------------------------------------


async def test_frames_from_made_up_addresses_take_no_memory() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    set_buffers(ours)
    link = HubLink(ours, f"udpin:{HOST}:14550")
    tracemalloc.start()
    try:
        for turn in range(3000):
            if turn == 1000:
                before = tracemalloc.get_traced_memory()[0]
            address = (f"10.0.{turn >> 8}.{turn & 255}", 14550)
            (message,) = pack_frames([b"frame"], address)
            theirs.send(message)
            assert await link.receive() == [(b"frame", address)]
        assert tracemalloc.get_traced_memory()[0] - before < 1 << 17
    finally:
        tracemalloc.stop()
        theirs.close()
        await link.aclose()


async def test_that_the_port_was_reopened_is_told_between_what_came_before_and_after() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    set_buffers(ours)
    link = HubLink(ours, f"udpin:{HOST}:14550")
    with theirs:
        for message in (*pack_frames([b"1"]), *pack_frames([]), *pack_frames([b"2"])):
            theirs.send(message)
        assert await link.receive() == [(b"1", None), REOPENED, (b"2", None)]
    await link.aclose()


async def test_a_port_without_a_number_cannot_be_shared() -> None:
    wish = PortRequest(US, (f"udpout:{HOST}:{free_udp_port()}",))
    with pytest.raises(LinkClosed, match="name a port"):
        async with open_shared(parse_source(f"udpin:{HOST}:0"), wish):
            pass
