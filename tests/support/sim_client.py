"""Talk to a simulated FTP server by hand, request by request, on a clock of one's own."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.pseudo import VirtualTrees
from mavftpfs.sim.tree import MemoryTree, Tree
from mavftpfs.sim.vehicle import FtpServer
from tests.support.replies import decode_reply, request

CLIENT = Address(255, 190)
OTHER = Address(254, 191)

A, FIVE, DIR = (b"/fs/microsd/" + name for name in (b"a.bin", b"five", b"dir"))
"""Of `small_tree`."""


def small_tree() -> MemoryTree:
    """A tree with a few files, below /fs/microsd where PX4 on NuttX may write."""
    tree = MemoryTree()
    tree.add(A, bytes(range(256)) * 4)
    tree.add(FIVE, b"\x05")
    tree.add(b"/fs/microsd/empty")
    tree.add_directory(DIR)
    return tree


class Client:
    """A client of a simulated server. Time moves only when told to."""

    def __init__(
        self,
        profile: str,
        tree: Tree | None = None,
        *,
        virtual: VirtualTrees | None = None,
        start: float = 100.0,
        **changes: Any,
    ) -> None:
        self.tree = small_tree() if tree is None else tree
        chosen = replace(PROFILES[profile], **changes) if changes else PROFILES[profile]
        self.server = FtpServer(self.tree, chosen, rng=random.Random(7), virtual=virtual)
        self.now = start
        self.seq = 1000
        self.source = CLIENT

    def send(
        self,
        opcode: int,
        data: bytes = b"",
        *,
        session: int = 0,
        offset: int = 0,
        size: int | None = None,
        seq: int | None = None,
    ) -> int:
        """Hand a request over and return its seq."""
        if seq is None:
            self.seq = seq = (self.seq + 1) % 65536
        made = request(seq, opcode, session=session, offset=offset, data=data, size=size)
        self.server.handle(made.encode(), self.source, self.now)
        return seq

    def receive(self, seconds: float = 1.0) -> list[Payload]:
        """Let time pass and return the replies of that time."""
        stop = self.now + seconds
        wires: list[bytes] = []
        while (due := self.server.next_deadline()) is not None and due <= stop:
            self.now = max(self.now, due)
            wires += [wire for _, wire in self.server.outgoing(self.now)]
        self.now = stop
        wires += [wire for _, wire in self.server.outgoing(stop)]
        return [decode_reply(wire) for wire in wires]

    def ask(self, opcode: int, data: bytes = b"", **fields: Any) -> Payload:
        """Send a request and return its one reply."""
        replies = self.ask_all(opcode, data, **fields)
        assert len(replies) == 1, replies
        return replies[0]

    def ask_all(self, opcode: int, data: bytes = b"", *, wait: float = 0.05, **fields: Any) -> list[Payload]:
        """Send a request and return what comes within `wait` seconds."""
        self.send(opcode, data, **fields)
        return self.receive(wait)

    def open(self, path: bytes, opcode: int = Opcode.OPEN_FILE_RO, session: int = 0) -> Payload:
        """Open a file and insist that it works."""
        reply = self.ask(opcode, path, session=session)
        assert reply.opcode == Opcode.ACK, reply
        return reply


def nak(reply: Payload) -> bytes:
    """Insist on a NAK and return its data."""
    assert reply.opcode == Opcode.NAK, reply
    return reply.data


def ack(reply: Payload) -> bytes:
    """Insist on an ACK and return its data."""
    assert reply.opcode == Opcode.ACK, reply
    return reply.data
