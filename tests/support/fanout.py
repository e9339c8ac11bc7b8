"""A MAVLink router between one vehicle and several mounts: everybody hears everybody, as behind real routers.

    python -m tests.support.fanout VEHICLE_PORT CLIENT_PORT CLIENT_PORT...

The vehicle sends to VEHICLE_PORT, each mount listens on its CLIENT_PORT; all on 127.0.0.1. SIGTERM ends it.
"""

from __future__ import annotations

import selectors
import signal
import socket
import sys

from tests.support.proxy import HOST, udp_socket


class Fanout:
    """A socket for the vehicle and one for each mount."""

    def __init__(self, vehicle_port: int, client_ports: list[int]) -> None:
        self.vehicle = udp_socket(vehicle_port)
        self.vehicle_address: tuple[str, int] | None = None
        self.clients = {udp_socket(0): (HOST, port) for port in client_ports}

    def run(self) -> None:
        """Forward for ever."""
        selector = selectors.DefaultSelector()
        for sock in (self.vehicle, *self.clients):
            selector.register(sock, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select():
                if isinstance(key.fileobj, socket.socket):
                    self.forward(key.fileobj)

    def forward(self, source: socket.socket) -> None:
        """Take one datagram and give it to all others."""
        datagram, address = source.recvfrom(65536)
        if source is self.vehicle:
            self.vehicle_address = address
        elif self.vehicle_address is not None:
            self.vehicle.sendto(datagram, self.vehicle_address)
        for sock, client in self.clients.items():
            if sock is not source:
                sock.sendto(datagram, client)


def main() -> int:
    """Run as a process until SIGTERM."""
    ports = [int(text) for text in sys.argv[1:]]

    def stop(*_: object) -> None:
        raise SystemExit(0)

    signal.signal(signal.SIGTERM, stop)
    Fanout(ports[0], ports[1:]).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
