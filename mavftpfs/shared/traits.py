"""What a server was seen to do, as far as behaviour depends on it. Layer: shared; pure.

None means "not seen yet". Nothing here is derived from a name or a version: a field is filled when an answer
proves it, and forgotten when the vehicle restarts.
"""

from __future__ import annotations

from dataclasses import dataclass

SHARED_QUEUE_WINDOW = 4
"""Requests in flight where the server has a queue of five for everybody (servers.md 3, ArduPilot)."""


@dataclass(slots=True)
class Traits:
    """Observed facts about one server; dropped when the vehicle reboots.

    Attributes:
        ack_carries_own_session: an Open ACK carried the non-zero id we had asked for (servers.md 14.6);
            then every reply echoes the request's session, and it is checked.
        queue_limit: the most requests that may be in flight; None where no limit is known.
        write_ack_counts: WriteFile ACKs say how many bytes were written.
        write_ack_offset: they say where (MAVSDK's say 0), and are believed only if that is the place.
        paths_disarm: a path operation made it refuse the next write (PX4 on NuttX, servers.md 8).
        lists_times: it answers opcode 16. time_silences: how often it did not, and then answered opcode 3.
    """

    ack_carries_own_session: bool | None = None
    queue_limit: int | None = None
    write_ack_counts: bool | None = None
    write_ack_offset: bool | None = None
    paths_disarm: bool = False
    lists_times: bool | None = None
    time_silences: int = 0

    def learn_session_echo(self, echoed: bool) -> None:
        """Note whether an Open ACK carried the id asked for; an echoing server has the shared queue."""
        self.ack_carries_own_session = echoed
        if echoed and self.queue_limit is None:
            self.queue_limit = SHARED_QUEUE_WINDOW


@dataclass(slots=True)
class WriteTraits:
    """What one server was seen to do when written to; forgotten when the vehicle reboots.

    Attributes:
        wo_truncates: OpenFileWO empties the file (servers.md 8). Filled by the session.
        rename_works: a rename succeeded (False: LittleFS has none). Filled by the cache.
        rename_replaces: a rename onto an existing file worked (False: FAT refuses it). Filled by the cache.
    """

    wo_truncates: bool | None = None
    rename_works: bool | None = None
    rename_replaces: bool | None = None

    def forget(self) -> None:
        """The vehicle rebooted, perhaps with other firmware."""
        self.wo_truncates = self.rename_works = self.rename_replaces = None
