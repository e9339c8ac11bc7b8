"""Counters of the engine. Layer: protocol; pure."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

from mavftpfs.protocol.lateness import Lateness


@dataclass(slots=True)
class EngineStats:
    """Plain counters since the engine was made.

    requests: transmissions, by_opcode too. retransmissions: those of them that repeat a request, spurious:
    and those that turned out to be needless. replies: believed ones, burst packets included; naks: those
    of them. unknown: replies that fit nothing outstanding (late, duplicate, not ours). stale: right seq,
    wrong req_opcode. incoherent: right seq, but session, offset or opcode cannot be. timeouts: operations
    failed with RequestTimeout. lateness: how late the path delivers what it doubled or held back.
    """

    requests: int = 0
    retransmissions: int = 0
    spurious: int = 0
    replies: int = 0
    naks: int = 0
    unknown: int = 0
    stale: int = 0
    incoherent: int = 0
    timeouts: int = 0
    by_opcode: defaultdict[int, int] = field(default_factory=lambda: defaultdict(int))
    lateness: Lateness = field(default_factory=Lateness, compare=False)

    def on_unknown(self, seq: int, now: float) -> None:
        """An answer fits nothing outstanding."""
        self.unknown += 1
        self.lateness.on_stray(seq, now)

    @property
    def strays(self) -> int:
        """Answers that nobody waited for any more: the path doubles or holds back what it carries, so that a
        request may reach the server once more, after newer ones."""
        return self.unknown + self.spurious
