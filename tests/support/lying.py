"""A vehicle whose answers can be changed, over any link, and frames for forgers.

`LyingServer` is a simulated server with two hooks; each `Rig` has one. `LyingVehicle` runs one in a thread
and speaks UDP or TCP, as a vehicle of the mount tier does. `heartbeat` and `ftp` make frames for a socket
that pretends to be the vehicle.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterable, Sequence
from types import TracebackType
from typing import Any, Self

import trio

from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Payload, decode_request
from mavftpfs.sim.endpoints import Endpoint, client_source, open_endpoint
from mavftpfs.sim.linkmodel import LinkModel
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import Tree
from mavftpfs.sim.vehicle import FtpServer, SimVehicle
from tests.support.memory import MemoryLink
from tests.support.replies import decode_reply

_VEHICLE = Address(1, 1)

Change = Callable[[Payload, Payload], Iterable[Payload]]
Answer = Callable[[Payload], Iterable[Payload] | None]


class LyingServer(FtpServer):
    """Answers as its profile does, but for the hooks. Both may be set at any time, also to None.

    Attributes:
        change: called with a request and one honest reply to it; what it returns is sent instead.
        answer: called with each request; returns the replies to send, or None where the server is to answer.
    """

    change: Change | None = None
    answer: Answer | None = None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._asked: dict[int, Payload] = {}
        self._forged: list[tuple[Address, bytes]] = []

    def handle(self, wire: bytes, source: Address, now: float) -> None:
        """Take a request."""
        if self.change is None and self.answer is None:
            super().handle(wire, source, now)
            return
        request = decode_request(wire)
        self._asked[request.seq] = request
        replies = None if self.answer is None else self.answer(request)
        if replies is None:
            super().handle(wire, source, now)
        else:
            self._forged += [(source, reply.encode()) for reply in replies]

    def handle_run(self, wires: Sequence[bytes], source: Address, now: float) -> None:
        """Take requests."""
        for wire in wires:
            self.handle(wire, source, now)

    def outgoing(self, now: float) -> list[tuple[Address, bytes]]:
        """Return the replies to send now, as the hooks want them."""
        forged, self._forged = self._forged, []
        honest = super().outgoing(now)
        if self.change is None:
            return forged + honest
        out = forged
        for target, wire in honest:
            reply = decode_reply(wire)
            request = self._asked.get((reply.seq - 1) & 0xFFFF)
            if request is None:
                out.append((target, wire))
            else:
                out += [(target, changed.encode()) for changed in self.change(request, reply)]
        return out


class CrowdedLink(MemoryLink):
    """A UDP port in memory: the vehicle speaks from `address`, and so may others.

    Attributes:
        address: where the vehicle is now; what is sent elsewhere it does not hear.
        mirrors: further addresses that everything the vehicle says comes from, too.
        answered: where our frames went last.
    """

    def __init__(self, vehicle: SimVehicle, model: LinkModel, address: NetAddress) -> None:
        super().__init__(vehicle, model)
        self.address = address
        self.mirrors: list[NetAddress] = []
        self.answered: NetAddress | None = None

    def intrude(self, address: NetAddress, frame: bytes) -> None:
        """Let somebody else send a datagram."""
        self._inbox.append((frame, address))
        self.kick()

    def send(self, frames: Sequence[bytes], to: NetAddress | None = None) -> None:
        """See link.base.Link."""
        self.answered = to
        if to in (None, self.address, *self.mirrors):
            super().send(frames)

    def _arrive(self, frame: bytes) -> None:
        self._inbox += [(frame, address) for address in (self.address, *self.mirrors)]


class LyingVehicle:
    """A simulated vehicle in a thread of this process: `with LyingVehicle(tree, "udpout:127.0.0.1:14550")`.

    link: as the vehicle writes it (`udpin:`, `udpout:`, `tcpin:`, `tcp:`). seed: two vehicles with different
    seeds have different unique ids.

    Attributes:
        server: its hooks may be set while it runs.
        source: SOURCE for mavftpfs.
        vehicle: its state may be read; change it only by `do`.
    """

    def __init__(self, tree: Tree, link: str, *, profile: str = "px4", seed: int = 1) -> None:
        rng = random.Random(seed)
        self.vehicle = SimVehicle(tree, PROFILES[profile], rng=rng)
        self.server = LyingServer(tree, PROFILES[profile], rng=rng)
        self.vehicle.server = self.server
        self.source = ""
        self._link = link
        self._ready = threading.Event()
        self._thread = threading.Thread(target=trio.run, args=(self._serve,), daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        assert self._ready.wait(30.0)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.do(self._scope.cancel)
        self._thread.join()

    def do(self, function: Callable[[], object]) -> None:
        """Have something done in the vehicle's thread, soon, and then what follows from it sent."""

        def call() -> None:
            function()
            self._endpoint.kick()

        self._token.run_sync_soon(call)

    async def _serve(self) -> None:
        with trio.CancelScope() as self._scope:
            async with open_endpoint(self._link) as link:
                self.vehicle.set_stream(link.is_stream)
                self._endpoint = Endpoint(self.vehicle, link)
                self._token = trio.lowlevel.current_trio_token()
                self.source = client_source(link)
                self._ready.set()
                await self._endpoint.run()


def heartbeat(source: Address = _VEHICLE, *, armed: bool = False) -> bytes:
    """Return the heartbeat of a PX4 quadrotor."""
    return Framer(source, stream=False).encode_heartbeat(2, 12, 0x80 if armed else 0)


def ftp(payload: bytes, target: Address) -> bytes:
    """Return a FILE_TRANSFER_PROTOCOL frame of the vehicle with a payload of 251 bytes."""
    return Framer(_VEHICLE, stream=False).encode_ftp(target, payload)
