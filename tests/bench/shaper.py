"""One slow, long or lossy UDP link between any vehicle and any client, as its own process.

    python -m tests.bench.shaper VEHICLE_PORT CLIENT_PORT --rate 625000 --delay 0.015 --loss 0.01 --seed 1

The vehicle sends to VEHICLE_PORT, where this listens; the client listens on CLIENT_PORT; answers go back to
whoever spoke last on VEHICLE_PORT. Datagrams are taken apart into MAVLink frames, each of which takes its own
way through the simulator's model of a link: a client that packs many requests into one datagram neither gains
nor loses by it. On SIGTERM it prints its counters as JSON and exits 0.
"""

from __future__ import annotations

import argparse
import json
import random
import select
import signal
import socket
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict

from mavftpfs.sim.linkmodel import Direction, LinkModel, LinkSettings

HOST = "127.0.0.1"
BATCH = 256
"""Datagrams taken from one socket before the other has its turn."""

_MAVLINK2, _MAVLINK1 = 0xFD, 0xFE
_SIGNED = 0x01


def frames_of(datagram: bytes) -> Iterator[bytes]:
    """Yield the MAVLink frames of a datagram by their length fields; what is not MAVLink is one piece."""
    start = 0
    while start < len(datagram):
        stop = start + _frame_size(datagram, start)
        yield datagram[start:stop]
        start = stop


def _frame_size(datagram: bytes, start: int) -> int:
    left = len(datagram) - start
    if left < 3:
        return left
    magic, payload, flags = datagram[start : start + 3]
    if magic == _MAVLINK2:
        return payload + (25 if flags & _SIGNED else 12)
    return payload + 8 if magic == _MAVLINK1 else left


class Shaper:
    """Two sockets with a model of a link between them."""

    def __init__(self, vehicle_port: int, client_port: int, model: LinkModel) -> None:
        self.model = model
        self._vehicle = _socket(vehicle_port)
        self._client = _socket(0)
        self._client_address = (HOST, client_port)
        self._vehicle_address: tuple[str, int] | None = None

    def run(self) -> None:
        """Forward until a signal ends it."""
        while True:
            due = self.model.next_deadline()
            timeout = None if due is None else max(0.0, due - time.monotonic())
            select.select([self._vehicle, self._client], [], [], timeout)
            self._take()
            self._deliver()

    def _take(self) -> None:
        for sock, direction in ((self._vehicle, Direction.TO_CLIENT), (self._client, Direction.TO_VEHICLE)):
            for _ in range(BATCH):
                try:
                    datagram, sender = sock.recvfrom(65536)
                except BlockingIOError:
                    break
                if sock is self._vehicle:
                    self._vehicle_address = sender
                now = time.monotonic()
                for frame in frames_of(datagram):
                    self.model.push(direction, frame, now)

    def _deliver(self) -> None:
        now = time.monotonic()
        for frame in self.model.pop(Direction.TO_CLIENT, now):
            _send(self._client, frame, self._client_address)
        for frame in self.model.pop(Direction.TO_VEHICLE, now):
            if self._vehicle_address is not None:
                _send(self._vehicle, frame, self._vehicle_address)


def _send(sock: socket.socket, frame: bytes, address: tuple[str, int]) -> None:
    try:
        sock.sendto(frame, address)
    except OSError:  # nobody listens yet, or no longer: a loss like any other
        return


def _socket(port: int) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)  # losses are the model's business alone
    sock.setblocking(False)
    sock.bind((HOST, port))
    return sock


def main() -> int:
    """Run as a process until SIGTERM."""
    parser = argparse.ArgumentParser(prog="tests.bench.shaper")
    parser.add_argument("vehicle_port", type=int)
    parser.add_argument("client_port", type=int)
    parser.add_argument("--rate", type=float, required=True, help="bytes per second each way")
    parser.add_argument("--delay", type=float, default=0.0, help="seconds one way")
    parser.add_argument("--loss", type=float, default=0.0, help="share of frames, each way")
    parser.add_argument("--queue", type=int, default=65_536, help="bytes that wait for the transmitter")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    settings = LinkSettings(rate=args.rate, delay=args.delay, loss=args.loss, queue=args.queue)
    model = LinkModel(random.Random(args.seed), settings)

    def stop(*_: object) -> None:
        raise SystemExit

    signal.signal(signal.SIGTERM, stop)
    try:
        Shaper(args.vehicle_port, args.client_port, model).run()
    except SystemExit:
        print(json.dumps({way.name.lower(): asdict(model.counters(way)) for way in Direction}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
