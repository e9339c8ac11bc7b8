"""One request on its way, and the manner in which each opcode is repeated. Layer: protocol; pure.

A manner says how a request is repeated after its answer was lost. Reads, writes and listings may be executed
twice. So each of their transmissions has its own seq, and can be told apart. A request that changes the
server goes out again under the *same* seq first, because PX4 and ArduPilot replay their last reply, if this
is still their last one (servers.md 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf
from struct import Struct
from typing import NamedTuple, Protocol, TypeAlias

from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload
from mavftpfs.shared.errors import FtpNak, MavftpfsError
from mavftpfs.shared.model import Traits

_pack = Struct(f"<HBBBBBxI{MAX_DATA}s").pack  # fills up with zeros

_LONG_FROM = 3
"""From this transmission on, every second one of a short request has full length (see `encode`)."""


class Manner(NamedTuple):
    """How requests of one opcode are timed and repeated.

    family: opcodes with similar round trips. same_seq: repeat under the same seq. ordered: servers answer
    in order, so answers to later requests prove a loss. echoes_offset: an ACK carries the request's
    offset. free_sends: transmissions before the waits double. slowest: seconds that the slowest server works
    at it, beyond the round trip in the family "work". slow_from: the transmission from which on so long is
    waited, because a slow server carries out each one (servers.md 14.38).
    """

    family: str
    same_seq: bool
    ordered: bool = False
    echoes_offset: bool = False
    free_sends: int = 1
    slow_from: int = 1 << 30
    slowest: float = 0.0


FLOORS = {"data": 0.05, "write": 0.05, "list": 0.25, "path": 0.1, "slow": 10.0, "work": 0.3}
"""Least retransmission timeout of each family in seconds."""

READ_MANNER = Manner("data", same_seq=False, ordered=True, echoes_offset=True, free_sends=20)
WRITE_MANNER = Manner("write", same_seq=False, ordered=True, free_sends=20)
_LIST = Manner("list", same_seq=False, ordered=True, slow_from=4, slowest=2.5)
_PATH = Manner("path", same_seq=True, free_sends=4)
_SLOW = Manner("slow", same_seq=True, slow_from=2, slowest=40.0)

MANNERS: dict[int, Manner] = dict.fromkeys(range(256), _PATH) | {
    Opcode.READ_FILE: READ_MANNER,
    Opcode.WRITE_FILE: WRITE_MANNER,
    Opcode.LIST_DIRECTORY: _LIST,
    Opcode.LIST_DIRECTORY_WITH_TIME: _LIST,
    Opcode.CALC_FILE_CRC32: _SLOW,
}
"""How requests with each opcode are repeated; those not named here are taken to have side effects."""


class Transmission(NamedTuple):
    """An earlier transmission: its order and time, whether its seq was sent once only, and whether later
    answers had seemed to prove it lost."""

    order: int
    sent_at: float
    single: bool
    outrun: bool


@dataclass(slots=True, eq=False)
class Request:
    """A request, and what became of it so far.

    follows: carries the engine's session. aliases: earlier transmissions by the seq of their replies.
    seq, order, sent_at, single, outrun: of the present transmission (see Transmission).
    """

    op: Operation
    opcode: int
    manner: Manner
    session: int
    offset: int
    size: int
    data: bytes = b""
    follows: bool = False
    aliases: dict[int, Transmission] | None = None
    flying: bool = False
    fresh_seq: bool = False
    sends: int = 0
    replays: int = 0
    single: bool = True
    outrun: bool = False
    # Set by each transmission.
    seq: int = field(init=False)
    order: int = field(init=False)
    sent_at: float = field(init=False)
    first_sent: float = field(init=False)
    timer: float = field(init=False)

    def fits(self, reply: Payload, traits: Traits) -> bool:
        """Whether this may be an answer to this request, whose seq and opcode it carries."""
        if traits.ack_carries_own_session and reply.session != self.session and not self.follows:
            return False
        if reply.opcode == Opcode.ACK:
            echoed = self.manner.echoes_offset or (self.manner.family == "write" and traits.write_ack_offset)
            return reply.offset == self.offset or not echoed
        return reply.opcode == Opcode.NAK


def encode(requests: Sequence[Request]) -> list[bytes]:
    """Return the 251 wire bytes of each under its present seq; its data must fit.

    After a frame whose length was damaged, a parser takes up to 255 bytes of the next frames for the rest of
    it. So every second of the later repetitions has full length, by a last byte that no server reads.
    """
    wires = []
    for r in requests:
        wire = _pack(r.seq, r.session, r.opcode, r.size, 0, 0, r.offset, r.data)
        if r.sends >= _LONG_FROM and r.sends % 2 and len(r.data) < MAX_DATA - 1:
            wire = wire[:-1] + b"\xff"
        wires.append(wire)
    return wires


Run: TypeAlias = list[tuple[Request, bytes]]
"""Requests of one operation and opcode that went out together, once, with the data of their ACKs."""


def nak_of(request: Request, reply: Payload) -> FtpNak:
    """Return the error that a NAK stands for; one without data has code 0."""
    data = reply.data
    code = data[0] if data else NakCode.NONE
    errno = data[1] if code == NakCode.FAIL_ERRNO and len(data) > 1 else None
    return FtpNak(request.opcode, code, errno, retransmitted=request.sends > 1)


class Port(Protocol):
    """What an operation may know of the engine it runs in."""

    session: int
    traits: Traits

    def timeout(self, family: str) -> float:
        """Return the present retransmission timeout of a family, in seconds."""
        ...

    def learn_session_echo(self, echoed: bool) -> None:
        """An Open ACK carried the session id asked for, or another."""
        ...


class Operation:
    """A state machine which the engine asks for requests and tells of replies.

    The engine sets `progress_at` (inf while nothing is wanted of the server) and fails the operation
    with RequestTimeout when there was no progress for `patience` seconds (inf: the engine's deadline).
    `timer` is the time at which `on_timer` is to be called. An operation ends by `finish` or `fail`, once.
    """

    urgent = True
    """Whether it goes first when there is room. The transfers of bytes are not urgent."""

    opcode = -1
    """That of the one request it makes, again and again or once; -1: it makes several kinds."""

    bulk = -1
    """The opcode whose ACKs may come as an `on_run`; -1: none."""

    paced = True
    """Whether more may be on the way than a server queues, evenly spread (see `pacing`)."""

    alone = False
    """Whether nothing else goes out until it is answered: then a repetition is answered by the reply to the
    first one, which the server still has (servers.md 2), and is not carried out again."""

    done = False
    error: MavftpfsError | None = None
    patience = inf
    progress_at = inf
    timer = inf
    sent = False
    started = False

    port: Port
    """The engine, once this was started."""

    @property
    def idle(self) -> bool:
        """Whether nothing is wanted of the server, so that silence is no failure."""
        return False

    def waits(self, now: float) -> bool:
        """Return whether something is wanted of the server. If nothing was before, its patience starts
        now."""
        if self.idle:
            self.progress_at = inf
            return False
        if self.progress_at == inf:
            self.progress_at = now
        return True

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return some of the next new requests, at most `most` (at least one) and all of one opcode; none if
        there is none for now."""
        raise NotImplementedError

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Take the believed ACK or NAK to `request`."""
        raise NotImplementedError

    def on_run(self, run: Run, now: float) -> None:
        """Take believed ACKs to requests with the opcode `bulk`, in the order in which they came."""
        raise NotImplementedError

    def on_paths(self) -> None:
        """Requests with a path go out, or are on their way, beside this one. It is told only where these
        disturb it (see `pathgate`)."""

    def takes_back(self, request: Request, now: float) -> bool:
        """Return whether the bytes of a lost request are asked for by other requests in its place."""
        return False

    def on_burst_sent(self, request: Request, now: float) -> int:
        """A BurstReadFile of this operation went out under request.seq; return how many packets may come."""
        return 0

    def on_burst(self, reply: Payload, now: float) -> bool:
        """Take a packet with req_opcode BurstReadFile; return False if it is not of the running burst."""
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
