"""A bad UDP link between a vehicle and the mount, as its own process.

    python -m tests.support.proxy VEHICLE_PORT CLIENT_PORT --seed 1 --loss 0.05 --dup 0.02 --corrupt 0.01

The vehicle sends to VEHICLE_PORT (where the proxy listens) and the proxy forwards to CLIENT_PORT (where the
mount listens); answers go back to whoever spoke last on VEHICLE_PORT. All on 127.0.0.1. What happens to each
datagram is drawn from the seed. On SIGTERM it prints its counters as JSON and exits 0.
"""

from __future__ import annotations

import argparse
import json
import random
import selectors
import signal
import socket
import sys
from collections import Counter
from dataclasses import dataclass, field

HOST = "127.0.0.1"
MAX_HELD = 0.05
"""Seconds after which a held-back (reordered) datagram is sent in any case."""


@dataclass
class Mischief:
    """Decides the fate of each datagram."""

    rng: random.Random
    loss: float
    dup: float
    reorder: float
    corrupt: float
    counts: Counter[str] = field(default_factory=Counter)
    held: list[bytes] = field(default_factory=list)

    def pass_on(self, datagram: bytes) -> list[bytes]:
        """Return what to forward now in place of `datagram`, the held-back ones behind it."""
        self.counts["datagrams"] += 1
        if self.happens("loss", self.loss):
            return self.release()
        if self.happens("corrupt", self.corrupt):
            datagram = self.flip_a_bit(datagram)
        copies = 2 if self.happens("dup", self.dup) else 1
        if self.happens("reorder", self.reorder):
            self.held += [datagram] * copies
            return []
        return [datagram] * copies + self.release()

    def happens(self, what: str, probability: float) -> bool:
        """Draw, and count what happened."""
        hit = self.rng.random() < probability
        self.counts[what] += hit
        return hit

    def flip_a_bit(self, datagram: bytes) -> bytes:
        """Return the datagram with one bit changed."""
        changed = bytearray(datagram)
        changed[self.rng.randrange(len(changed))] ^= 1 << self.rng.randrange(8)
        return bytes(changed)

    def release(self) -> list[bytes]:
        """Return what was held back."""
        held, self.held = self.held, []
        return held


class Proxy:
    """Two sockets and the mischief in each direction."""

    def __init__(self, vehicle_port: int, client_port: int, down: Mischief, up: Mischief) -> None:
        self.vehicle = udp_socket(vehicle_port)
        self.client = udp_socket(0)
        self.client_address = (HOST, client_port)
        self.vehicle_address: tuple[str, int] | None = None
        self.down = down
        self.up = up

    def run(self) -> None:
        """Forward until interrupted."""
        selector = selectors.DefaultSelector()
        selector.register(self.vehicle, selectors.EVENT_READ, self.from_vehicle)
        selector.register(self.client, selectors.EVENT_READ, self.from_client)
        while True:
            ready = selector.select(MAX_HELD)
            for key, _ in ready:
                key.data()
            if not ready:
                self.to_client(self.down.release())
                self.to_vehicle(self.up.release())

    def from_vehicle(self) -> None:
        """Take one datagram of the vehicle."""
        datagram, self.vehicle_address = self.vehicle.recvfrom(65536)
        self.to_client(self.down.pass_on(datagram))

    def from_client(self) -> None:
        """Take one datagram of the mount."""
        self.to_vehicle(self.up.pass_on(self.client.recv(65536)))

    def to_client(self, datagrams: list[bytes]) -> None:
        """Send towards the mount; nobody listening yet is a loss."""
        for datagram in datagrams:
            self.client.sendto(datagram, self.client_address)

    def to_vehicle(self, datagrams: list[bytes]) -> None:
        """Send towards the vehicle, if it spoke before."""
        for datagram in datagrams:
            if self.vehicle_address is not None:
                self.vehicle.sendto(datagram, self.vehicle_address)


def udp_socket(port: int) -> socket.socket:
    """Return a bound socket with a roomy buffer: losses are the seed's business alone."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    sock.bind((HOST, port))
    return sock


def main() -> int:
    """Run as a process until SIGTERM."""
    parser = argparse.ArgumentParser()
    parser.add_argument("vehicle_port", type=int)
    parser.add_argument("client_port", type=int)
    parser.add_argument("--seed", type=int, default=1)
    for what in ("loss", "dup", "reorder", "corrupt"):
        parser.add_argument(f"--{what}", type=float, default=0.0)
    args = parser.parse_args()
    chances = (args.loss, args.dup, args.reorder, args.corrupt)
    down = Mischief(random.Random(args.seed), *chances)
    up = Mischief(random.Random(args.seed + 1), *chances)

    def stop(*_: object) -> None:
        raise SystemExit

    signal.signal(signal.SIGTERM, stop)
    try:
        Proxy(args.vehicle_port, args.client_port, down, up).run()
    except SystemExit:
        print(json.dumps({"down": down.counts, "up": up.counts}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
