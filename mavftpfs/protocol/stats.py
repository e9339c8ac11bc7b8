"""Counters of the engine. Layer: protocol; pure."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

from mavftpfs.protocol.lateness import Lateness
from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.protocol.requests import Request


@dataclass(slots=True)
class EngineStats:
    """Plain counters since the engine was made.

    requests: transmissions, by_opcode too. retransmissions: those of them that repeat a request, spurious:
    and those that turned out to be needless. replies: believed ones, burst packets included; naks: those
    of them. unknown: replies that fit nothing outstanding (late, duplicate, not ours). stale: right seq,
    wrong req_opcode. incoherent: right seq, but session, offset or opcode cannot be. strays: answers that
    tell that the path doubles, holds back or mixes what it carries, so that a request may reach the server
    once more, after newer ones. timeouts: operations failed with RequestTimeout. lateness: how late the path
    delivers what it doubled or held back.
    """

    requests: int = 0
    retransmissions: int = 0
    spurious: int = 0
    replies: int = 0
    naks: int = 0
    unknown: int = 0
    stale: int = 0
    incoherent: int = 0
    strays: int = 0
    timeouts: int = 0
    by_opcode: defaultdict[int, int] = field(default_factory=lambda: defaultdict(int))
    lateness: Lateness = field(default_factory=Lateness, compare=False)

    def on_unknown(self, reply: Payload, now: float, *, explained: bool) -> None:
        """An answer fits nothing outstanding; explained: because we asked more than once. So is what comes of
        a burst that was given up."""
        self.unknown += 1
        self.strays += not explained and reply.req_opcode != Opcode.BURST_READ_FILE
        self.lateness.on_stray(reply.seq, now)

    def on_spurious(self, request: Request) -> None:
        """An earlier transmission of a request was answered, whose facts these are, before the last one."""
        self.spurious += 1
        self.strays += request.outrun or self.lateness.overtaken(request.sent_at)
