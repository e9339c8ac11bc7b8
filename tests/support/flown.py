"""A simulated vehicle that a ground station can work with: telemetry and parameters; as a process.

    python -m tests.support.flown DIR --link pty --rate 5760 --record FILE

The arguments are those of `mavftpfs sim`. --record: each frame that went out or came in, a line each: `>` or
`<`, and the frame in hex. Parameters speak the classic protocol, by pymavlink.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
from collections.abc import Callable
from typing import Any, ClassVar, TextIO

import trio
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavftpfs.link.base import Link
from mavftpfs.link.frames import Splitter
from mavftpfs.link.messages import Address
from mavftpfs.sim.arguments import add_arguments, link_settings
from mavftpfs.sim.endpoints import Endpoint, client_source, open_endpoint
from mavftpfs.sim.linkmodel import LinkModel, LinkSettings
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import DirectoryTree
from mavftpfs.sim.vehicle import SimVehicle

PARAMETERS = {f"TEST_{number:03d}": number * 1.5 for number in range(120)}
_PARAMETER_PERIOD = 0.012
"""Seconds between two PARAM_VALUE of a download, as autopilots pace them."""


class FlownVehicle(SimVehicle):
    """Answers what ground stations ask for, too."""

    def __init__(self, *args: Any, **keywords: Any) -> None:
        super().__init__(*args, **keywords)
        self._splitter = Splitter(stream=False)
        self._parser = dialect.MAVLink(None)
        self._to_tell: list[int] = []
        self._tell_at = float("inf")

    def set_stream(self, stream: bool) -> None:
        super().set_stream(stream)
        self._splitter = Splitter(stream=stream)

    def receive(self, data: bytes, now: float) -> None:
        super().receive(data, now)
        for frame in self._splitter.feed(data):
            if frame.target.system in (0, self.address.system) and frame.id in self._ANSWERS:
                message = self._parser.decode(bytearray(frame.data))
                self._ANSWERS[frame.id](self, message, now)

    def outgoing(self, now: float) -> list[bytes]:
        frames = super().outgoing(now)
        if self.address.component != 1:
            frames = [frame for frame in frames if int.from_bytes(frame[7:10], "little") != 0]
        while self._to_tell and self._tell_at <= now:
            frames.append(self._parameter(self._to_tell.pop(0)))
            self._tell_at += _PARAMETER_PERIOD
        if not self._to_tell:
            self._tell_at = float("inf")
        return frames

    def next_deadline(self) -> float:
        return min(super().next_deadline(), self._tell_at)

    def _parameter(self, number: int) -> bytes:
        name = list(PARAMETERS)[number]
        value = PARAMETERS[name]
        return self.framer.encode("param_value", name.encode(), value, 9, len(PARAMETERS), number)

    def _on_parameter_list(self, message: Any, now: float) -> None:
        self._to_tell, self._tell_at = list(range(len(PARAMETERS))), now

    def _on_parameter_read(self, message: Any, now: float) -> None:
        number = message.param_index
        if number < 0:
            number = list(PARAMETERS).index(message.param_id)
        self._ready.append(self._parameter(number))

    _ANSWERS: ClassVar[dict[int, Callable[[Any, Any, float], None]]] = {
        20: _on_parameter_read,
        21: _on_parameter_list,
    }


class RecordedEndpoint(Endpoint):
    """Writes down each frame that goes over its link."""

    def __init__(self, vehicle: SimVehicle, link: Link, model: LinkModel | None, record: TextIO) -> None:
        super().__init__(vehicle, link, model)
        self._record = record
        self._hearing = Splitter(stream=link.is_stream)

    def _exchange(self, chunks: list[bytes], now: float) -> None:
        self._note(chunks)
        super()._exchange(chunks, now)

    def _exchange_through(self, model: LinkModel, chunks: list[bytes], now: float) -> None:
        self._note(chunks)
        super()._exchange_through(model, chunks, now)

    def _note(self, chunks: list[bytes]) -> None:
        for chunk in chunks:
            for frame in self._hearing.feed(chunk):
                print("<", frame.data.hex(), file=self._record)

    def _send(self, frames: list[bytes]) -> None:
        for frame in frames:
            print(">", frame.hex(), file=self._record)
        super()._send(frames)


async def serve(
    args: argparse.Namespace, vehicle: SimVehicle, model: LinkModel | None, record: TextIO
) -> None:
    """Serve until SIGTERM."""
    with trio.open_signal_receiver(signal.SIGTERM) as ending:
        async with open_endpoint(args.link, args.rate) as link, trio.open_nursery() as nursery:
            vehicle.set_stream(link.is_stream)
            endpoint = RecordedEndpoint(vehicle, link, model, record)
            print(f"mavftpfs {client_source(link)} MOUNTPOINT", flush=True)
            nursery.start_soon(endpoint.run)
            async for _ in ending:
                nursery.cancel_scope.cancel()
    print(f"open sessions: {vehicle.server.open_sessions}", flush=True)


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    parser.add_argument("--record", required=True)
    parser.add_argument("--component", type=int, default=1, help="another sends no heartbeats")
    parser.add_argument("--key", type=bytes.fromhex, default=None)
    args = parser.parse_args()
    rng = random.Random(args.seed)
    settings = link_settings(args)
    model = None if settings == LinkSettings(queue=settings.queue) else LinkModel(rng, settings)
    vehicle = FlownVehicle(
        DirectoryTree(args.directory),
        PROFILES[args.profile],
        rng=rng,
        address=Address(args.system, args.component),
        telemetry=args.telemetry,
        armed=args.armed,
        signing_key=args.key,
    )
    with open(args.record, "w", encoding="ascii") as record:
        trio.run(serve, args, vehicle, model, record)
    return 0


if __name__ == "__main__":
    sys.exit(main())
