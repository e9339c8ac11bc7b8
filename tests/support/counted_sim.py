"""A simulated vehicle that writes down every FTP request it gets.

    python -m tests.support.counted_sim DIR PROFILE LINK JOURNAL

Each line of JOURNAL is a JSON object: opcode by name, session, offset, size (bytes of payload data), and the
path where the request carries one. It is written before the request is worked on. JOURNAL.sessions holds how
many sessions are open at the server.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

import trio

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import PAYLOAD_SIZE, Opcode, decode_request
from mavftpfs.sim.endpoints import Endpoint, client_source, open_endpoint
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import DirectoryTree
from mavftpfs.sim.vehicle import FtpServer, SimVehicle

NAMES = {opcode.value: opcode.name for opcode in Opcode}
BY_SESSION = ("NONE", "TERMINATE_SESSION", "RESET_SESSIONS", "READ_FILE", "WRITE_FILE", "BURST_READ_FILE")
"""Opcodes whose data is not a path."""


class JournalServer(FtpServer):
    """Keeps a journal of what it is asked."""

    journal: TextIO
    sessions: Path
    written = 0

    def handle(self, wire: bytes, source: Address, now: float) -> None:
        """Write the request down, then do as it says."""
        if len(wire) == PAYLOAD_SIZE:
            print(json.dumps(described(wire)), file=self.journal, flush=True)
        super().handle(wire, source, now)

    def handle_run(self, wires: Sequence[bytes], source: Address, now: float) -> None:
        """Write each request down, too."""
        for wire in wires:
            self.handle(wire, source, now)

    def outgoing(self, now: float) -> list[tuple[Address, bytes]]:
        """Write down how many sessions are open before the replies that tell of it go out."""
        replies = super().outgoing(now)
        if self.open_sessions != self.written:
            self.written = self.open_sessions
            self.sessions.write_text(str(self.written))
        return replies


def described(wire: bytes) -> dict[str, object]:
    """Return what a request asks for."""
    request = decode_request(wire)
    name = NAMES.get(request.opcode, str(request.opcode))
    facts: dict[str, object] = {
        "opcode": name,
        "session": request.session,
        "offset": request.offset,
        "size": request.size,
    }
    if name not in BY_SESSION:
        facts["path"] = request.data.rstrip(b"\0").replace(b"\0", b" -> ").decode(errors="replace")
    return facts


async def serve(root: Path, profile: str, link_text: str, journal: TextIO, sessions: Path) -> None:
    """Serve until SIGTERM or SIGINT."""
    tree, rng = DirectoryTree(root), random.Random(0)
    vehicle = SimVehicle(tree, PROFILES[profile], rng=rng)
    server = JournalServer(tree, PROFILES[profile], rng=rng)
    server.journal, server.sessions = journal, sessions
    vehicle.server = server
    with trio.open_signal_receiver(signal.SIGTERM, signal.SIGINT) as arriving:
        async with open_endpoint(link_text) as link:
            vehicle.set_stream(link.is_stream)
            print(f"mavftpfs {client_source(link)} MOUNTPOINT", flush=True)
            async with trio.open_nursery() as nursery:
                nursery.start_soon(Endpoint(vehicle, link).run)
                async for _ in arriving:
                    nursery.cancel_scope.cancel()
                    break
    print(f"ended after {server.requests.total()} FTP requests, open sessions: {server.open_sessions}")


def main() -> int:
    """Run as a process."""
    parser = argparse.ArgumentParser()
    parser.add_argument("directory", type=Path)
    parser.add_argument("profile")
    parser.add_argument("link")
    parser.add_argument("journal", type=Path)
    args = parser.parse_args()
    with args.journal.open("a") as journal:
        sessions = args.journal.with_suffix(".sessions")
        trio.run(serve, args.directory, args.profile, args.link, journal, sessions)
    return 0


if __name__ == "__main__":
    sys.exit(main())
