"""Programs that speak UDP beside a mount, as threads of the test."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from functools import partial
from typing import Self

from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address
from tests.support.vehicles import HOST


class Neighbour:
    """A program with a socket, which works in the body of a `with` until `_over` is set.

    port: of its socket; 0: any. timeout: seconds for which it waits for a datagram.

    Attributes:
        sent: how many frames or datagrams it sent.
    """

    def __init__(self, port: int = 0, timeout: float = 0.5) -> None:
        self.sent = 0
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.bind((HOST, port))
        self._sock.settimeout(timeout)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._sock.close()

    def _run(self) -> None:
        raise NotImplementedError


class Beating(Neighbour):
    """Components that know nothing but heartbeats, and speak to a port of the mount's."""

    def __init__(self, port: int, *senders: tuple[Address, int, int]) -> None:
        """senders: address, MAV_TYPE and MAV_AUTOPILOT of each."""
        super().__init__()
        framers = [(Framer(address, stream=False), kinds) for address, *kinds in senders]
        self._beats = [partial(framer.encode_heartbeat, *kinds) for framer, kinds in framers]
        self._sock.connect((HOST, port))

    def _run(self) -> None:
        while not self._over.wait(0.3):
            for beat in self._beats:
                with suppress(ConnectionRefusedError):
                    self._sock.send(beat())
