"""What a server was seen to do, as far as behaviour depends on it. Layer: shared; pure.

None means "not seen yet". Nothing here is derived from a name or a version: the engine fills a field
when an answer proves it, the session layer may fill one that it learned in an earlier session.
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
        burst_size_honoured: burst packets had the size asked for (False: PX4 always sends 239).
        answers_during_burst: another request was answered between the packets of a burst.
        write_ack_counts: WriteFile ACKs say how many bytes were written.
    """

    ack_carries_own_session: bool | None = None
    queue_limit: int | None = None
    burst_size_honoured: bool | None = None
    answers_during_burst: bool | None = None
    write_ack_counts: bool | None = None

    def learn_session_echo(self, echoed: bool) -> None:
        """Note whether an Open ACK carried the id asked for; an echoing server has the shared queue."""
        self.ack_carries_own_session = echoed
        if echoed and self.queue_limit is None:
            self.queue_limit = SHARED_QUEUE_WINDOW
