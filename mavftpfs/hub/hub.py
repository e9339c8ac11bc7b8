"""The hub: sockets around the router. Layer: hub.

The hub calls the program that has the port. That program closes the port and becomes the first client. The
hub ends with its last client, with one exception: while a vehicle is armed and an endpoint is heard, the hub
stays, because the link of a ground station outlives the mount.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from typing import Any, TypeAlias

import trio

from mavftpfs.hub.inlet import Inlet
from mavftpfs.hub.outbox import LinePace, Outbox, Waiting
from mavftpfs.hub.routing import Kind, Router
from mavftpfs.hub.senders import PORT, Place
from mavftpfs.link.addresses import NetAddress, readable_address
from mavftpfs.link.base import Link
from mavftpfs.link.frames import Frame
from mavftpfs.link.hublink import (
    PROTOCOL,
    Facts,
    HubLink,
    hear,
    set_buffers,
    tell,
)
from mavftpfs.link.messages import Address
from mavftpfs.link.opening import open_link
from mavftpfs.link.ports import call, is_ours, next_caller, port_name, source_port, take_name
from mavftpfs.link.samelink import same_link
from mavftpfs.link.uri import LinkKind, LinkSpec, parse_source
from mavftpfs.shared.errors import LinkClosed, MavftpfsError

log = logging.getLogger("mavftpfs.hub")

QUIET = 0.1
"""Seconds of silence within a frame after which the hub stops waiting for the rest of a stream's frame."""
ACTIVE = 10.0
"""Seconds for which an endpoint that was heard keeps the hub up, while a vehicle is armed."""
HELLO_PATIENCE = 10.0
"""Seconds for the other end of a connection to send its request."""

_DOUBLE = "%s says that it is %d/%d, too: two vehicles with one system id, or frames that a router sends back"
_POLL = 0.003
_LOOK = 1.0
_COMPONENTS = 249
"""mavftpfs programs have component ids from 1 to 249, each its own; a router's is above."""
_LEAST_OUTBOX = 4096
_OUTBOX = 256 * 1024
_USB = "/dev/ttyACM"
_OTHERS = "{}: the hub of another user has this port; only that user and root may share it or stop the hub"


Sent: TypeAlias = tuple[Place, Frame, NetAddress | None]
"""A frame, the place where it arrived, and the port's address that a client sends it to."""


@dataclass(slots=True)
class _Client:
    """A program that shares the port. number: the link id of its signatures. forward: the endpoints that the
    program asked for. The client's link drops what its socket has no room for, as a port of its own would."""

    side: int
    link: HubLink
    own: Address
    number: int
    name: str
    forward: tuple[str, ...]


@dataclass(slots=True)
class _Endpoint:
    """The side of a ground station, or of another program that `forward=` names. link: None until it is
    open."""

    side: int
    text: str
    scope: trio.CancelScope = field(default_factory=trio.CancelScope)
    link: Link | None = None


async def run_hub(spec: LinkSpec) -> None:
    """Take a port over from the program that has it, and serve until nobody needs the hub.

    Raises:
        LinkClosed: the port cannot be opened. The hub reports this to the program that had it, too.
    """
    name = port_name(spec)
    first = call(name, spec)
    if first is None:
        return  # the program that started the hub ended
    with first:
        set_buffers(first)
        tell(first, {"protocol": PROTOCOL, "hub": os.getpid()})
        hello = await hear(first, HELLO_PATIENCE)  # by then port and name are free
        listening = take_name(name) if hello else None
        if not hello or listening is None:
            return
        with listening:
            try:
                # Patient, because a device or a peer may be away for a moment.
                async with open_link(spec, patient=True, source_port=source_port(spec)) as port:
                    await Hub(spec, port).run(listening, first, hello)
            except LinkClosed as exc:
                tell(first, {"refused": str(exc)})
                raise


class Hub:
    """The owner of the port that a SOURCE names."""

    def __init__(self, spec: LinkSpec, port: Link) -> None:
        self.spec = spec
        self.router = Router()
        self._port = port
        self._clients: dict[int, _Client] = {}
        self._endpoints: dict[str, _Endpoint] = {}
        self._sides = count(PORT + 1)
        self._one_by_one = trio.Lock()
        self._ended = trio.Event()
        self._work = trio.lowlevel.ParkingLot()
        serial = spec.kind is LinkKind.SERIAL
        # The baud rate of a USB port has no effect; its symbolic links are under /dev/serial.
        is_line = serial and not os.path.realpath(spec.device).startswith(_USB)
        self._line = LinePace(spec.baud if is_line else None)
        self._outbox = Outbox(max(_LEAST_OUTBOX, spec.baud // 10) if serial else _OUTBOX)
        self._said_doubles: set[Address] = set()
        self.router.add(PORT, Kind.PORT, fixed=spec.kind is not LinkKind.UDP_IN)

    async def run(self, name: socket.socket, first: socket.socket, hello: Facts) -> None:
        """Serve until nobody needs the hub. name: where programs call; first: the first client's connection;
        hello: its request."""
        async with trio.open_nursery() as nursery:
            nursery.start_soon(self._answer, first, hello, nursery)
            nursery.start_soon(self._accept, name, nursery)
            nursery.start_soon(self._read, PORT, self._port)
            nursery.start_soon(self._write)
            nursery.start_soon(self._watch)
            await self._ended.wait()
            nursery.cancel_scope.cancel()

    # -- clients

    async def _accept(self, name: socket.socket, nursery: trio.Nursery) -> None:
        while True:
            nursery.start_soon(self._receive, await next_caller(name), nursery)

    async def _receive(self, sock: socket.socket, nursery: trio.Nursery) -> None:
        """Serve a connection: of a client, or of a program that asks for the status or the hub's end."""
        with sock:
            set_buffers(sock)
            await self._answer(sock, await hear(sock, HELLO_PATIENCE) or {}, nursery)

    async def _answer(self, sock: socket.socket, request: Facts, nursery: trio.Nursery) -> None:
        if "join" in request:
            client = await self._join(sock, request, nursery)
            if client is not None:
                await self._serve(client)
        elif request.keys() & {"stop", "may_stop"} and not is_ours(sock):
            tell(sock, {"refused": _OTHERS.format(self.spec.description)})
        elif "status" in request or "stop" in request:
            tell(sock, self.status())
            if "stop" in request:
                self._ended.set()

    async def _join(self, sock: socket.socket, hello: Facts, nursery: trio.Nursery) -> _Client | None:
        """Accept a program, or send it the reason why not."""
        try:
            async with self._one_by_one:  # opens an endpoint once, even if two programs want it
                client = self._admitted(sock, hello)
                try:
                    await self._open_endpoints(client.forward, nursery)
                except BaseException:
                    self._forget(client)
                    raise
        except (MavftpfsError, KeyError, TypeError, ValueError) as exc:
            tell(sock, {"refused": str(exc)})
            return None
        tell(sock, {"own": client.own, "number": client.number})
        self.router.add(client.side, Kind.CLIENT)
        log.info("%s joined as %d/%d", client.link.description, *client.own)
        return client

    def _admitted(self, sock: socket.socket, hello: Facts) -> _Client:
        """Return a new client, already counted.

        Raises:
            MavftpfsError: the client has another version, wants another port, or is one too many.
            KeyError, TypeError, ValueError: its request makes no sense.
        """
        if hello.get("protocol") != PROTOCOL:
            raise LinkClosed(
                "another version of mavftpfs has the port; end its mounts, or: mavftpfs hub --stop --force"
            )
        spec = parse_source(str(hello["join"]))
        if not same_link(spec, self.spec):
            raise LinkClosed(
                f"{self.spec.description} is shared already, so {spec.description} cannot be opened"
            )
        if not is_ours(sock):
            raise LinkClosed(_OTHERS.format(spec.description))
        own, number = self._granted(Address(*map(int, hello["own"])), hello.get("number"))
        forward = tuple(map(str, hello.get("forward", ())))
        name = str(hello.get("name", ""))
        client = _Client(next(self._sides), HubLink(sock, name or "a client"), own, number, name, forward)
        self._clients[client.side] = client
        return client

    def _granted(self, wanted: Address, number: int | None) -> tuple[Address, int]:
        """Return a client's address and the link id of its signatures: those that it asks for, unless another
        program has them.

        Raises:
            LinkClosed: all addresses are in use.
        """
        owns = {client.own for client in self._clients.values()}
        turns = range(wanted.component, wanted.component + _COMPONENTS)
        choice = [wanted, *(Address(wanted.system, turn % _COMPONENTS + 1) for turn in turns)]
        own = next((one for one in choice if one not in owns and one not in self.router.senders), None)
        if own is None:
            raise LinkClosed(f"{len(owns)} programs share this port, which is the limit; end one of them")
        numbers = {client.number for client in self._clients.values()}
        if number is None or number in numbers:
            number = min(set(range(len(numbers) + 1)) - numbers)
        return own, number

    def _forget(self, client: _Client) -> None:
        del self._clients[client.side]
        self.router.remove(client.side)
        self._end_if_done()

    async def _serve(self, client: _Client) -> None:
        """Pass on a client's frames until it leaves."""
        try:
            with suppress(LinkClosed):
                await self._read(client.side, client.link)
        finally:
            self._forget(client)
            log.info("%s left", client.link.description)

    # -- endpoints

    async def _open_endpoints(self, texts: Sequence[str], nursery: trio.Nursery) -> None:
        """Open the endpoints that are not open yet.

        Raises:
            LinkClosed: one cannot be opened; the text gives the reason.
        """
        for text in texts:
            if text not in self._endpoints:
                endpoint = self._endpoints[text] = _Endpoint(next(self._sides), text)
                try:
                    await nursery.start(self._serve_endpoint, endpoint)
                except MavftpfsError as exc:
                    del self._endpoints[text]
                    raise LinkClosed(f"forward={exc}") from exc

    async def _serve_endpoint(self, endpoint: _Endpoint, task_status: trio.TaskStatus[None]) -> None:
        """Open an endpoint, and pass on its frames. A peer of `tcp` may appear later.

        Raises:
            LinkClosed: it cannot be opened.
        """
        spec = parse_source(endpoint.text)
        try:
            with endpoint.scope:
                async with open_link(spec, patient=spec.kind is LinkKind.TCP_OUT) as endpoint.link:
                    self.router.add(endpoint.side, Kind.ENDPOINT, fixed=spec.kind is not LinkKind.UDP_IN)
                    task_status.started()
                    await self._read(endpoint.side, endpoint.link)
        finally:
            self.router.remove(endpoint.side)  # only now: until its end the task may pass on a frame

    def _drop_endpoint(self, endpoint: _Endpoint) -> None:
        del self._endpoints[endpoint.text]
        endpoint.scope.cancel()

    # -- frames

    async def _read(self, side: int, link: Link) -> None:
        """Pass on one side's frames.

        Raises:
            LinkClosed: the other end is gone.
        """
        inlet = Inlet(side, stream=link.is_stream)
        names_target = side in self._clients
        address: NetAddress | None = None
        while True:
            found: list[Sent] = []
            with trio.move_on_after(QUIET if inlet.waiting else float("inf")) as scope:
                for data, address in await link.receive():
                    if not data:
                        inlet.reset()
                        self._tell_reopened(side)
                    elif names_target:
                        found += [(place, frame, address) for place, frame in inlet.feed(data, None)]
                    else:
                        found += [(place, frame, None) for place, frame in inlet.feed(data, address)]
            if scope.cancelled_caught:
                found = [(place, frame, None) for place, frame in inlet.on_silence(address)]
            self._pass_on(found)

    def _tell_reopened(self, side: int) -> None:
        for client in self._clients.values() if side == PORT else ():
            client.link.send(())

    def _pass_on(self, frames: Sequence[Sent]) -> None:
        """Route frames that arrived together, and send each destination its share at once."""
        now = trio.current_time()
        shares: dict[tuple[Place, NetAddress | None], list[bytes]] = {}
        route, push, waiting = self.router.route, self._outbox.push, False
        for place, frame, to in frames:
            for target in route(frame, place, now, to):
                if target.side == PORT:
                    push(place.side, Waiting(target, frame.data))
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
            client.link.send(frames, origin)
        for endpoint in self._endpoints.values():
            if endpoint.side == target.side and endpoint.link is not None:
                endpoint.link.send(frames, target.address)

    # -- out over the port

    def _flush(self, now: float) -> None:
        """Hand the kernel all frames that it accepts now."""
        outbox, port, line = self._outbox, self._port, self._line
        batch: list[bytes] = []
        address: NetAddress | None = None
        while outbox and not port.backlog and line.ready_at() <= now:
            place, frame = outbox.pop()
            if place.address != address and batch:
                port.send(batch, address)
                batch = []
            address = place.address
            batch.append(frame)
            line.sent(len(frame), now)
        if batch:
            port.send(batch, address)
        if outbox:
            self._work.unpark_all()

    async def _write(self) -> None:
        """Send the frames that wait for the line."""
        while True:
            if not self._outbox:
                await self._work.park()
            await trio.sleep(max(_POLL, self._line.ready_at() - trio.current_time()))
            self._flush(trio.current_time())

    # -- the end

    async def _watch(self) -> None:
        """Check each second whether somebody needs the hub, and warn of second vehicles."""
        while True:
            await trio.sleep(_LOOK)
            self._end_if_done()
            for sender, where in self.router.senders.doubles().items():
                if sender not in self._said_doubles:
                    self._said_doubles.add(sender)
                    log.warning(_DOUBLE, readable_address(where), *sender)

    def _end_if_done(self) -> None:
        wanted = {text for client in self._clients.values() for text in client.forward}
        if self._clients:
            for endpoint in [known for text, known in self._endpoints.items() if text not in wanted]:
                if not self._is_active(endpoint):
                    self._drop_endpoint(endpoint)
        elif not self._is_needed():
            self._ended.set()

    def _is_active(self, endpoint: _Endpoint) -> bool:
        heard = self.router.senders.heard_at(endpoint.side)
        return heard is not None and trio.current_time() - heard < ACTIVE

    def _is_needed(self) -> bool:
        """Return whether a ground station controls an armed vehicle through the hub."""
        return any(self.router.armed.values()) and any(map(self._is_active, self._endpoints.values()))

    def status(self) -> dict[str, Any]:
        """Return the hub's facts, JSON-able."""
        now = trio.current_time()
        endpoints = []
        for endpoint in self._endpoints.values():
            heard = self.router.senders.heard_at(endpoint.side)
            ago = None if heard is None else round(now - heard, 1)
            endpoints.append({"endpoint": endpoint.text, "heard_ago": ago})
        return {
            "source": self.spec.description,
            "pid": os.getpid(),
            "clients": [
                {"name": client.name, "address": list(client.own)} for client in self._clients.values()
            ],
            "endpoints": endpoints,
            "armed": sorted(system for system, armed in self.router.armed.items() if armed),
            "doubles": [
                {"system": sender.system, "component": sender.component, "address": readable_address(where)}
                for sender, where in self.router.senders.doubles().items()
            ],
        }
