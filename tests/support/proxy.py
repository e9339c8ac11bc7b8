"""A bad UDP link between a vehicle and a mount, or a router between it and several, as its own process.

    python -m tests.support.proxy VEHICLE_PORT CLIENT_PORT [CLIENT_PORT...] --seed 1 --loss 0.05 --dup 0.02

The vehicle sends to VEHICLE_PORT (where the proxy listens) and the proxy forwards to each CLIENT_PORT (where
a mount listens). Answers go back to the vehicle that spoke last on VEHICLE_PORT, and to all other clients:
everybody hears everybody, as behind real routers. All on 127.0.0.1. What happens to each datagram is drawn
from the seed, by the simulator's model of a link. SIGTERM ends it.
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
    """A socket for the vehicle, one for each client, and the link between them."""

    def __init__(self, vehicle_port: int, client_ports: list[int], model: LinkModel) -> None:
        self.vehicle = udp_socket(vehicle_port)
        self.clients = {udp_socket(0): (HOST, port) for port in client_ports}
        self.vehicle_address: tuple[str, int] | None = None
        self.model = model

    def run(self) -> None:
        """Forward for ever."""
        selector = selectors.DefaultSelector()
        for sock in (self.vehicle, *self.clients):
            selector.register(sock, selectors.EVENT_READ)
        while True:
            due = self.model.next_deadline()
            for key, _ in selector.select(None if due is None else max(0.0, due - time.monotonic())):
                assert isinstance(key.fileobj, socket.socket)
                self.take(key.fileobj)
            self.forward()

    def take(self, source: socket.socket) -> None:
        """Take one datagram."""
        datagram, address = source.recvfrom(65536)
        if source is self.vehicle:
            self.vehicle_address = address
            self.model.push(Direction.TO_CLIENT, datagram, time.monotonic())
            return
        self.model.push(Direction.TO_VEHICLE, datagram, time.monotonic())
        for sock, client in self.clients.items():
            if sock is not source:
                sock.sendto(datagram, client)

    def forward(self) -> None:
        """Send what has arrived; what nobody listens for yet is lost."""
        now = time.monotonic()
        for datagram in self.model.pop(Direction.TO_CLIENT, now):
            for sock, client in self.clients.items():
                sock.sendto(datagram, client)
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
    parser.add_argument("client_ports", type=int, nargs="+")
    parser.add_argument("--seed", type=int, default=1)
    for what in ("loss", "dup", "reorder", "corrupt"):
        parser.add_argument(f"--{what}", type=float, default=0.0)
    args = parser.parse_args()
    settings = LinkSettings(loss=args.loss, duplicate=args.dup, reorder=args.reorder, corrupt=args.corrupt)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    Proxy(args.vehicle_port, args.client_ports, LinkModel(random.Random(args.seed), settings)).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
