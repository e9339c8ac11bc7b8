"""The hub: sockets around the router. Layer: hub.

It ends with its last client. But it stays while a vehicle is armed and an endpoint is heard: the link of a
ground station outlives the mount.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from typing import Any

import trio

from mavftpfs.hub.outbox import Line, Outbox, Waiting
from mavftpfs.hub.routing import BEATS, Kind, Router
from mavftpfs.hub.senders import PORT, Place
from mavftpfs.link.addresses import NetAddress, readable_address
from mavftpfs.link.base import Link
from mavftpfs.link.frames import Frame, Splitter
from mavftpfs.link.hublink import (
    PROTOCOL,
    Facts,
    make_tag,
    pack_facts,
    pack_frames,
    set_buffers,
    unpack_facts,
    unpack_frames,
)
from mavftpfs.link.messages import Address
from mavftpfs.link.opening import open_link
from mavftpfs.link.rendezvous import Door
from mavftpfs.link.samelink import leads_back, same_link
from mavftpfs.link.uri import LinkKind, LinkSpec, parse_source
from mavftpfs.shared.errors import LinkClosed, MavftpfsError, UsageError

log = logging.getLogger("mavftpfs.hub")

QUIET = 0.1
"""Seconds of silence within a frame after which the rest of a stream's frame is not waited for."""
ACTIVE = 10.0
"""Seconds for which an endpoint that was heard keeps the hub up, while a vehicle is armed."""
HELLO_PATIENCE = 10.0
"""Seconds for a connection to say what it wants."""

_DOUBLE = "%s says that it is %d/%d, too: two vehicles with one system id, or frames that a router sends back"
_POLL = 0.003
_LOOK = 1.0
_RETRY = 2.0
_MESSAGES = 64
_LEAST_OUTBOX = 4096
_OUTBOX = 256 * 1024
_USB = "/dev/ttyACM"
_MOST_SPLITTERS = 64


@dataclass(slots=True)
class _Client:
    """A program of ours. forward: the endpoints that it asked for."""

    side: int
    sock: socket.socket
    own: Address
    number: int
    name: str
    forward: tuple[str, ...]
    dropped: int = 0


@dataclass(slots=True)
class _Endpoint:
    """The side of a ground station, or of another program that `forward=` names. link: None while it cannot
    be opened."""

    side: int
    text: str
    spec: LinkSpec
    scope: trio.CancelScope = field(default_factory=trio.CancelScope)
    link: Link | None = None
    problem: str = ""


class Hub:
    """Owns a port.

    Args:
        spec: the port.
        inherited: its open descriptors; without any it is opened.
        door: where clients knock.
    """

    def __init__(self, spec: LinkSpec, inherited: Sequence[int], door: Door) -> None:
        self.spec = spec
        self.router = Router()
        self._inherited = inherited
        self._door = door
        self._port: Link | None = None
        self._clients: dict[int, _Client] = {}
        self._joining: list[tuple[str, ...]] = []
        self._endpoints: dict[str, _Endpoint] = {}
        self._sides = 0
        self._ended = trio.Event()
        self._came = trio.Event()
        self._work = trio.Event()
        serial = spec.kind is LinkKind.SERIAL
        # The baud rate of a USB port means nothing; its symbolic links are under /dev/serial.
        is_line = serial and not os.path.realpath(spec.device).startswith(_USB)
        self._line = Line(spec.baud if is_line else None)
        self._outbox = Outbox(max(_LEAST_OUTBOX, spec.baud // 10) if serial else _OUTBOX)
        self._said_doubles: set[Address] = set()

    async def run(self, first: socket.socket, on_ready: Callable[[], None]) -> None:
        """Serve until the hub is not needed any more. first: the connection of the program that started it.

        Until that program has joined, port and door are its own.
        """
        async with AsyncExitStack() as stack:
            # Patient: what was handed over may have no connection at the moment.
            opening = open_link(self.spec, self._inherited, patient=True)
            port = self._port = await stack.enter_async_context(opening)
            fixed = self.spec.kind is not LinkKind.UDP_IN
            self.router.add(PORT, Kind.PORT, fixed=fixed)
            async with trio.open_nursery() as nursery:
                nursery.start_soon(self._serve, first, nursery)
                on_ready()
                await self._came.wait()
                if not self._ended.is_set():
                    stack.callback(self._door.remove)
                    self._door.is_hubs()
                    nursery.start_soon(self._accept, nursery)
                    nursery.start_soon(self._read, PORT, port)
                    nursery.start_soon(self._write)
                    nursery.start_soon(self._watch)
                    await self._ended.wait()
                nursery.cancel_scope.cancel()

    # -- clients

    async def _accept(self, nursery: trio.Nursery) -> None:
        while True:
            nursery.start_soon(self._serve, await self._door.accept(), nursery)

    async def _serve(self, sock: socket.socket, nursery: trio.Nursery) -> None:
        """Answer one connection: a client that stays, or a question."""
        client: _Client | None = None
        set_buffers(sock)
        try:
            hello: Facts | None = None
            with trio.move_on_after(HELLO_PATIENCE):
                await trio.lowlevel.wait_readable(sock)
                hello = unpack_facts(sock.recv(65536))
            if hello is None:
                return
            client = await self._answered(sock, hello, nursery)
            if client is not None:
                await self._read_client(client)
        except OSError:
            pass  # it is gone
        finally:
            trio.lowlevel.notify_closing(sock)
            sock.close()
            if client is not None:
                self._leave(client)
            elif not self._came.is_set():
                self._ended.set()  # the client that started the hub does not stay
                self._came.set()

    async def _answered(self, sock: socket.socket, hello: Facts, nursery: trio.Nursery) -> _Client | None:
        """Reply to the first message of a connection; return the client if it is let in."""
        if "join" in hello:
            try:
                client = await self._joined(sock, hello, nursery)
            except (MavftpfsError, KeyError, TypeError, ValueError) as exc:
                sock.send(pack_facts({"refused": str(exc)}))
            else:
                self._came.set()
                try:
                    sock.send(pack_facts({"own": client.own, "number": client.number}))
                except OSError:
                    self._leave(client)  # it was gone before it was let in
                    raise
                return client
        elif "status" in hello:
            sock.send(pack_facts(self.status()))
        elif "stop" in hello:
            sock.send(pack_facts(self.status()))
            self._ended.set()
        return None

    async def _joined(self, sock: socket.socket, hello: Facts, nursery: trio.Nursery) -> _Client:
        """Let a client in.

        Raises:
            MavftpfsError: it is of another version, wants another port, or an endpoint that cannot be opened.
        """
        if hello.get("protocol") != PROTOCOL:
            raise LinkClosed(
                "another version of mavftpfs has the port; end its mounts, or: mavftpfs hub --stop --force"
            )
        spec = parse_source(hello["join"])
        if not same_link(spec, self.spec):
            raise LinkClosed(
                f"{self.spec.description} is shared already, so {spec.description} cannot be opened"
            )
        forward = tuple(map(str, hello.get("forward", ())))
        self._joining.append(forward)
        try:
            await self._open_endpoints(forward, nursery, patient=bool(hello.get("again")))
        finally:
            self._joining.remove(forward)
        own, number = self._granted(Address(*hello["own"]), hello.get("number"))
        self._sides += 1
        side = self._sides
        self.router.add(side, Kind.CLIENT, fixed=True)
        if hello.get("beats"):
            self.router.focus(side, BEATS)
        client = _Client(side, sock, own, number, str(hello.get("name", "")), forward)
        self._clients[side] = client
        log.info("%s joined as %d/%d", client.name or "a client", *own)
        return client

    def _granted(self, wanted: Address, number: int | None) -> tuple[Address, int]:
        """Return the address that a client gets, and the link id of its signatures: those that it asks for,
        unless another client has them.

        Raises:
            LinkClosed: all link ids are in use.
        """
        owns = {client.own for client in self._clients.values()}
        for _ in range(255):
            if wanted not in owns and wanted not in self.router.senders:
                break
            wanted = Address(wanted.system, wanted.component % 249 + 1)
        numbers = {client.number for client in self._clients.values()}
        if number is None or number in numbers:
            number = next((free for free in range(256) if free not in numbers), None)
        if number is None:
            raise LinkClosed(f"{len(numbers)} programs share this port already, and no more can")
        return wanted, number

    def _leave(self, client: _Client) -> None:
        self._clients.pop(client.side, None)
        self.router.remove(client.side)
        log.info("%s left", client.name or "a client")
        self._end_if_done()

    async def _read_client(self, client: _Client) -> None:
        splitter = Splitter(stream=False)
        while True:
            await trio.lowlevel.wait_readable(client.sock)
            frames: list[tuple[Place, Frame]] = []
            ended = False
            for _ in range(_MESSAGES):
                try:
                    message = client.sock.recv(65536)
                except BlockingIOError:
                    break
                if not message:
                    ended = True
                    break
                facts = unpack_facts(message)
                if facts is not None:
                    self._on_wish(client, facts)
                else:
                    place = Place(client.side, None)
                    frames += [(place, frame) for frame in splitter.feed(unpack_frames(message)[1])]
            self._pass_on(frames, forwarded=False)
            if ended:
                return

    def _on_wish(self, client: _Client, facts: Facts) -> None:
        if isinstance(facts.get("focus"), int):
            self.router.focus(client.side, facts["focus"])
        if isinstance(facts.get("answer"), list):
            self.router.answer(client.side, tuple(facts["answer"]))

    # -- endpoints

    async def _open_endpoints(self, texts: Sequence[str], nursery: trio.Nursery, *, patient: bool) -> None:
        for text in texts:
            if text in self._endpoints:
                continue
            spec = parse_source(text)
            if leads_back(spec, self.spec):
                raise UsageError(f"forward={text} is SOURCE itself")
            self._sides += 1
            endpoint = self._endpoints[text] = _Endpoint(self._sides, text, spec)
            self.router.add(endpoint.side, Kind.ENDPOINT, fixed=endpoint.spec.kind is not LinkKind.UDP_IN)
            if patient:
                nursery.start_soon(self._serve_endpoint, endpoint, True)
                continue
            try:
                await nursery.start(self._serve_endpoint, endpoint, False)
            except LinkClosed as exc:
                del self._endpoints[text]
                raise LinkClosed(f"forward={exc}") from exc

    async def _serve_endpoint(
        self,
        endpoint: _Endpoint,
        patient: bool,
        task_status: trio.TaskStatus[None] = trio.TASK_STATUS_IGNORED,
    ) -> None:
        """Open an endpoint, and pass on what comes from it. patient: if it cannot be opened, try again."""
        try:
            with endpoint.scope:
                while True:
                    try:
                        async with open_link(endpoint.spec, patient=True) as link:
                            endpoint.link, endpoint.problem = link, ""
                            task_status.started()
                            await self._read(endpoint.side, link)
                    except LinkClosed as exc:
                        if not patient:
                            raise
                        if not endpoint.problem:
                            log.warning("forward=%s", exc)
                        endpoint.problem = str(exc)
                    await trio.sleep(_RETRY)
        finally:
            self.router.remove(endpoint.side)  # only now: until it ended the task may pass on a last frame

    def _drop_endpoint(self, endpoint: _Endpoint) -> None:
        del self._endpoints[endpoint.text]
        endpoint.scope.cancel()

    # -- frames

    async def _read(self, side: int, link: Link) -> None:
        """Pass on what comes from the port or an endpoint."""
        splitters: dict[NetAddress | None, Splitter] = {}
        stream, forwarded = link.is_stream, side != PORT
        if stream:
            splitters[None] = Splitter(stream=True)
        while True:
            quiet = QUIET if stream and splitters[None].waiting else float("inf")
            pieces: list[bytes] | None = None
            with trio.move_on_after(quiet):
                pieces = await link.receive()
            frames: list[tuple[Place, Frame]] = []
            if pieces is None:
                frames = [(Place(side, link.sender(-1)), frame) for frame in splitters[None].give_up()]
            elif not pieces:
                self._on_reopened(side, splitters)
            for index, piece in enumerate(pieces or ()):
                address = link.sender(index)
                key = None if stream else address
                splitter = splitters.get(key)
                if splitter is None:
                    if len(splitters) >= _MOST_SPLITTERS:
                        splitters.clear()
                    splitter = splitters[key] = Splitter(stream=False)
                place = Place(side, address)
                frames += [(place, frame) for frame in splitter.feed(piece)]
            if any(frame.crc_fits for _, frame in frames):
                link.keep_peer()
            self._pass_on(frames, forwarded=forwarded)

    def _on_reopened(self, side: int, splitters: dict[NetAddress | None, Splitter]) -> None:
        for splitter in splitters.values():
            splitter.reset()
        if side == PORT:
            for client in self._clients.values():
                self._send_to_client(client, [pack_facts({"reopened": True})])

    def _pass_on(self, frames: Sequence[tuple[Place, Frame]], *, forwarded: bool) -> None:
        """Route frames that came together, and send each destination its share at once."""
        now = trio.current_time()
        shares: dict[tuple[Place, NetAddress | None], list[bytes]] = {}
        route, push, waiting = self.router.route, self._outbox.push, False
        for place, frame in frames:
            for target in route(frame, place, now):
                if target.side == PORT:
                    push(place.side, Waiting(target, frame.data), forwarded=forwarded)
                    waiting = True
                    continue
                origin = place.address if place.side == PORT else None
                shares.setdefault((target, origin), []).append(frame.data)
        if waiting:
            self._flush(now)
        for (target, origin), share in shares.items():
            self._deliver(target, origin, share)

    def _deliver(self, target: Place, origin: NetAddress | None, frames: Sequence[bytes]) -> None:
        client = self._clients.get(target.side)
        if client is not None:
            self._send_to_client(client, pack_frames(frames, make_tag(origin)))
            return
        for endpoint in self._endpoints.values():
            if endpoint.side == target.side and endpoint.link is not None:
                if target.address is not None:
                    endpoint.link.answer(target.address)
                endpoint.link.send_nowait(frames)

    def _send_to_client(self, client: _Client, messages: Sequence[bytes]) -> None:
        """Send messages to a client. It loses those for which its socket is full, as on a port of its own."""
        for message in messages:
            try:
                client.sock.send(message)
            except BlockingIOError:
                client.dropped += 1
            except OSError:
                return  # its own task notices

    # -- out over the port

    def _flush(self, now: float) -> None:
        """Hand the kernel what it takes now."""
        outbox, port, line = self._outbox, self._port, self._line
        assert port is not None
        batch: list[bytes] = []
        target: Place | None = None
        while outbox and not port.backlog and line.ready_at() <= now:
            place, frame = outbox.pop()
            if place != target and batch:
                self._send_out(target, batch)
                batch = []
            target = place
            batch.append(frame)
            line.sent(len(frame), now)
        if batch:
            self._send_out(target, batch)
        if outbox:
            self._work.set()

    def _send_out(self, target: Place | None, frames: list[bytes]) -> None:
        assert self._port is not None
        if target is not None and target.address is not None:
            self._port.answer(target.address)
        self._port.send_nowait(frames)

    async def _write(self) -> None:
        """Send what had to wait for the line."""
        while True:
            await self._work.wait()
            self._work = trio.Event()
            while self._outbox:
                now = trio.current_time()
                await trio.sleep(max(_POLL, self._line.ready_at() - now))
                self._flush(trio.current_time())

    # -- the end

    async def _watch(self) -> None:
        """Check each second whether the hub is still needed, and warn of second vehicles."""
        while True:
            self._end_if_done()
            for sender, where in self.router.senders.doubles().items():
                if sender not in self._said_doubles:
                    self._said_doubles.add(sender)
                    log.warning(_DOUBLE, readable_address(where), *sender)
            await trio.sleep(_LOOK)

    def _end_if_done(self) -> None:
        asked = [*self._joining, *(client.forward for client in self._clients.values())]
        wanted = {text for forward in asked for text in forward}
        if self._clients:
            for endpoint in [known for text, known in self._endpoints.items() if text not in wanted]:
                if not self._is_active(endpoint):
                    self._drop_endpoint(endpoint)
        elif self._came.is_set() and not self._is_needed():
            self._ended.set()

    def _is_active(self, endpoint: _Endpoint) -> bool:
        heard = self.router.senders.heard_at(endpoint.side)
        return heard is not None and trio.current_time() - heard < ACTIVE

    def _is_needed(self) -> bool:
        """Return whether a ground station controls an armed vehicle through the hub."""
        return any(self.router.armed.values()) and any(map(self._is_active, self._endpoints.values()))

    def status(self) -> dict[str, Any]:
        """Return facts, JSON-able."""
        now = trio.current_time()
        endpoints = []
        for endpoint in self._endpoints.values():
            heard = self.router.senders.heard_at(endpoint.side)
            facts = {"endpoint": endpoint.text, "problem": endpoint.problem or None}
            endpoints.append({**facts, "heard_ago": None if heard is None else round(now - heard, 1)})
        return {
            "source": self.spec.description,
            "pid": os.getpid(),
            "clients": [
                {"name": client.name, "address": list(client.own), "dropped": client.dropped}
                for client in self._clients.values()
            ],
            "endpoints": endpoints,
            "armed": sorted(system for system, armed in self.router.armed.items() if armed),
            "doubles": [
                {"system": sender.system, "component": sender.component, "address": readable_address(where)}
                for sender, where in self.router.senders.doubles().items()
            ],
            "dropped": self._outbox.dropped,
        }
