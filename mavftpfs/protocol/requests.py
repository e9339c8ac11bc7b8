"""One request in flight, and the retry policy of each opcode. Layer: protocol; pure.

A retry policy says how a request is repeated after its answer was lost. Reads, writes and listings may be
executed twice. So their operations supply a new request with a seq of its own, and the answers can be told
apart. Any other request goes out again under the *same* seq, because PX4 and ArduPilot recognise it by the
seq and replay their reply, if this is still their last one (servers.md 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import frexp, inf
from struct import Struct
from typing import NamedTuple, Protocol, TypeAlias

from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload
from mavftpfs.shared.errors import FtpNak, MavftpfsError
from mavftpfs.shared.model import Traits

_pack = Struct(f"<HBBBBBxI{MAX_DATA}s").pack  # fills up with zeros


class RetryPolicy(NamedTuple):
    """The timing and retransmission of requests with one opcode.

    Attributes:
        floor: the least seconds to wait for an answer.
        same_seq: the request is repeated under the same seq.
        bulk: the request carries a chunk of a file. Round trips of chunks and of single requests are measured
            apart.
        ordered: servers answer in order, so answers to later requests prove a loss.
        echoes_offset: an ACK carries the request's offset; None: where the server was seen to do so.
        backoff: a transmission waits at least this share of the time without progress.
        work: seconds that the slowest server works at the request, beyond the round trip (CalcFileCRC32).
        usual_work: seconds that a usual server does; the first transmission waits for so long.
    """

    floor: float
    same_seq: bool
    bulk: bool = False
    ordered: bool = False
    echoes_offset: bool | None = False
    backoff: float = 0.5
    work: float = 0.0
    usual_work: float = 0.0


READ_POLICY = RetryPolicy(0.05, same_seq=False, bulk=True, ordered=True, echoes_offset=True, backoff=0.25)
WRITE_POLICY = READ_POLICY._replace(echoes_offset=None)
_LIST = RetryPolicy(0.25, same_seq=False, ordered=True, backoff=1.0)
_PATH = RetryPolicy(0.1, same_seq=True)
WORK_FLOOR = 0.3
"""The least seconds to wait for an answer where the server has work to do."""

RETRY_POLICIES: dict[int, RetryPolicy] = dict.fromkeys(range(256), _PATH) | {
    Opcode.READ_FILE: READ_POLICY,
    Opcode.WRITE_FILE: WRITE_POLICY,
    Opcode.LIST_DIRECTORY: _LIST,
    Opcode.LIST_DIRECTORY_WITH_TIME: _LIST,
}
"""The retransmission of requests with each opcode; all others count as having side effects."""


@dataclass(slots=True, eq=False)
class Request:
    """A request under one seq, and what became of it so far.

    | state | outstanding | owed |
    |---|---|---|
    | in flight | yes | one for each transmission without an answer |
    | lost: its operation asks again, or the same request goes out again | no | more than 0 |
    | answered, and a repetition may be answered, too | no | more than 0 |
    | forgotten | no | 0 |

    Attributes:
        follows: the request carries the engine's session.
        outstanding: the request is in flight: neither answered nor lost.
        owed: how many answers may still come, one for each transmission.
        stale: no answer will come under this seq, because the server replays another reply.
        seq, order, sent_at, timer: of the last transmission. first_sent: of the first one.
    """

    op: Operation
    opcode: int
    policy: RetryPolicy
    session: int
    offset: int
    size: int
    data: bytes = b""
    follows: bool = False
    outstanding: bool = False
    owed: int = 0
    stale: bool = False
    # Set by each transmission.
    seq: int = field(init=False)
    order: int = field(init=False)
    sent_at: float = field(init=False)
    first_sent: float = field(init=False)
    timer: float = field(init=False)

    @property
    def stop(self) -> int:
        """Return the offset behind the last byte."""
        return self.offset + self.size

    def anew(self) -> Request:
        """Return the same request, to go out under another seq."""
        return Request(
            self.op, self.opcode, self.policy, self.session, self.offset, self.size, self.data, self.follows
        )

    def fits(self, reply: Payload, traits: Traits) -> bool:
        """Return whether this may be an answer to this request, whose seq and opcode it carries."""
        if traits.ack_carries_own_session and reply.session != self.session and not self.follows:
            return False
        if reply.opcode == Opcode.ACK:
            echoed = self.policy.echoes_offset
            echoed = traits.write_ack_offset if echoed is None else echoed
            return reply.offset == self.offset or not echoed
        return reply.opcode == Opcode.NAK


def encode(requests: Sequence[Request], *, waits: float) -> list[bytes]:
    """Return the 251 wire bytes of each under its seq; its data must fit. waits: how many usual waits for an
    answer passed without progress.

    After a frame whose length was damaged, a parser takes up to 255 bytes of the next frames for the rest of
    it. Requests therefore have full length, by a last byte that no server reads, from the second to the
    fourth wait, from the eighth to the sixteenth, and so on. They are short between, because some radios drop
    long frames.
    """
    long = waits >= 2.0 and frexp(waits)[1] % 2 == 0
    wires = []
    for r in requests:
        wire = _pack(r.seq, r.session, r.opcode, r.size, 0, 0, r.offset, r.data)
        if long and len(r.data) < MAX_DATA - 1:
            wire = wire[:-1] + b"\xff"
        wires.append(wire)
    return wires


NO_FILE_CODES = frozenset((NakCode.FAIL, NakCode.INVALID_SESSION, NakCode.FILE_NOT_FOUND))
"""Refusals of a read or a write that mean "no file is open": MAVSDK says 1, PX4 4, ArduPilot 10 (servers.md
1)."""

Run: TypeAlias = list[tuple[Request, bytes]]
"""Requests of one operation and opcode that went out together, with the data of their ACKs."""


def nak_of(request: Request, reply: Payload, *, retransmitted: bool = False) -> FtpNak:
    """Return the error that a NAK stands for; one without data has code 0."""
    data = reply.data
    code = data[0] if data else NakCode.NONE
    errno = data[1] if code == NakCode.FAIL_ERRNO and len(data) > 1 else None
    return FtpNak(request.opcode, code, errno, retransmitted=retransmitted)


class Port(Protocol):
    """The part of the engine that an operation may know."""

    traits: Traits

    def timeout(self, policy: RetryPolicy) -> float:
        """Return the present wait for an answer, in seconds."""
        ...

    def learn_session_echo(self, echoed: bool) -> None:
        """Note whether an Open ACK carried the requested session id."""
        ...


class Operation:
    """A state machine that supplies the engine with requests and receives the replies.

    The operation reports its `progress`; `progress_at` is inf while it is idle. The engine fails an operation
    with RequestTimeout if there was no progress for `patience` seconds (inf: the engine's deadline). `timer`
    is the time at which the engine calls `on_timer`. `sent`: how often requests went out. An operation ends
    by `finish` or `fail`, once.
    """

    urgent = True
    """Urgent operations go first when there is room. All are urgent except the transfers of bytes."""

    opcode = -1
    """The opcode of all its requests; -1: they have several."""

    bulk = -1
    """The opcode whose ACKs may come as an `on_run`; -1: none."""

    paced = True
    """Whether more requests may be in flight than a server queues, evenly spread (see `flow`)."""

    exclusive = False
    """Exclusive: the engine sends nothing else until this operation ends. The server remembers only its last
    reply, so it answers a repetition from memory in place of executing it again (servers.md 2)."""

    done = False
    error: MavftpfsError | None = None
    patience = inf
    progress_at = inf
    timer = inf
    sent = 0
    started = False

    port: Port
    """The engine, once this was started."""

    @property
    def idle(self) -> bool:
        """Whether the operation needs nothing from the server, so that silence is no failure."""
        return False

    def update_patience(self, now: float) -> bool:
        """Stop the patience of an idle operation, and start that of one that needs the server again; return
        whether it runs."""
        if self.idle:
            self.progress_at = inf
            return False
        if self.progress_at == inf:
            self.progress_at = now
        return True

    def progress(self, now: float) -> None:
        """Note that the operation got further, or waited for something else than the server: its patience
        starts anew."""
        self.progress_at = now

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return at most `most` (at least one) requests to send now, all of one opcode; an empty list if
        there is none for now. A request that went out before goes out again under its seq."""
        raise NotImplementedError

    def on_lost(self, request: Request, now: float) -> None:
        """Note that a request is lost, and supply it again by `next_requests`."""

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Take the believed ACK or NAK to `request`, which may have been declared lost before."""
        raise NotImplementedError

    def on_run(self, run: Run, now: float) -> None:
        """Take believed ACKs to requests with the opcode `bulk`, in the order in which they came."""
        raise NotImplementedError

    def on_paths(self) -> None:
        """Note that requests with a path go out or are in flight beside this operation. Called only if the
        server mixes them up with writes (see `pathgate`)."""

    def on_burst_sent(self, request: Request, now: float) -> int:
        """Note that a BurstReadFile of this operation went out; return how many packets may come."""
        return 0

    def on_burst(self, reply: Payload, now: float) -> bool:
        """Take a packet with req_opcode BurstReadFile; return False if it belongs to no running burst."""
        return False

    def on_timer(self, now: float) -> None:
        """Act, because `timer` has passed, and set the next one."""
        self.timer = inf

    def finish(self) -> None:
        """End well."""
        self.done = True
        self.timer = inf

    def fail(self, error: MavftpfsError) -> None:
        """End with an error; the first one counts."""
        if not self.done:
            self.error = error
            self.finish()
