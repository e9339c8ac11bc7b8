"""A bad UDP link between a vehicle and the mount, as its own process.

    python -m tests.support.proxy VEHICLE_PORT CLIENT_PORT --seed 1 --loss 0.05 --dup 0.02 --corrupt 0.01

The vehicle sends to VEHICLE_PORT (where the proxy listens) and the proxy forwards to CLIENT_PORT (where the
mount listens); answers go back to whoever spoke last on VEHICLE_PORT. All on 127.0.0.1. What happens to each
datagram is drawn from the seed, by the simulator's model of a link. SIGTERM ends it.
"""

from __future__ import annotations

import argparse
import random
import selectors
import signal
import socket
import sys
import time

from mavftpfs.sim.linkmodel import Direction, LinkModel, LinkSettings

HOST = "127.0.0.1"


class Proxy:
    """Two sockets and the link between them."""

    def __init__(self, vehicle_port: int, client_port: int, model: LinkModel) -> None:
        self.vehicle = udp_socket(vehicle_port)
        self.client = udp_socket(0)
        self.client_address = (HOST, client_port)
        self.vehicle_address: tuple[str, int] | None = None
        self.model = model

    def run(self) -> None:
        """Forward for ever."""
        selector = selectors.DefaultSelector()
        selector.register(self.vehicle, selectors.EVENT_READ, Direction.TO_CLIENT)
        selector.register(self.client, selectors.EVENT_READ, Direction.TO_VEHICLE)
        while True:
            due = self.model.next_deadline()
            for key, _ in selector.select(None if due is None else max(0.0, due - time.monotonic())):
                self.take(key.data)
            self.forward()

    def take(self, direction: Direction) -> None:
        """Take one datagram."""
        if direction is Direction.TO_CLIENT:
            datagram, self.vehicle_address = self.vehicle.recvfrom(65536)
        else:
            datagram = self.client.recv(65536)
        self.model.push(direction, datagram, time.monotonic())

    def forward(self) -> None:
        """Send what has arrived; what nobody listens for yet is lost."""
        now = time.monotonic()
        for datagram in self.model.pop(Direction.TO_CLIENT, now):
            self.client.sendto(datagram, self.client_address)
        for datagram in self.model.pop(Direction.TO_VEHICLE, now):
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
    settings = LinkSettings(loss=args.loss, duplicate=args.dup, reorder=args.reorder, corrupt=args.corrupt)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    Proxy(args.vehicle_port, args.client_port, LinkModel(random.Random(args.seed), settings)).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
