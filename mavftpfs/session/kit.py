"""What every user of the server session works with. Layer: session."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from mavftpfs.protocol.chunking import ChunkSize
from mavftpfs.protocol.engine import Engine
from mavftpfs.session.doubt import Doubt
from mavftpfs.session.driver import Driver
from mavftpfs.session.echoes import Echoes
from mavftpfs.session.gate import Gate
from mavftpfs.session.holder import SessionHolder
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.shared.traits import WriteTraits


@dataclass(frozen=True, slots=True)
class Kit:
    """The session and what it runs on. write_chunks: the size of WriteFiles."""

    holder: SessionHolder
    driver: Driver
    engine: Engine
    vehicle: Vehicle
    gate: Gate
    clock: Callable[[], float]
    echoes: Echoes
    write_chunks: ChunkSize
    doubt: Doubt


class Queue(Protocol):
    """The others who want the session, as whoever has it sees them."""

    write_traits: WriteTraits

    def rival_use(self, user: object) -> float | None:
        """Return how much the lightest of those who wait used of the session lately; None if nobody waits."""
        ...

    def expire_waiters(self) -> None:
        """Fail those who have waited too long."""
        ...

    def require_link(self) -> None:
        """Raise VehicleLost while the vehicle is silent."""
        ...
