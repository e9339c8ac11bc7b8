"""Counters of the engine. Layer: protocol; pure."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field


@dataclass(slots=True)
class EngineStats:
    """Plain counters since the engine was made.

    requests: transmissions, by_opcode too. retransmissions: those of them that repeat a request, spurious:
    and those that turned out to be needless. replies: believed ones, burst packets included; naks: those
    of them. unknown: replies that fit nothing outstanding (late, duplicate, not ours). stale: right seq,
    wrong req_opcode. incoherent: right seq, but session, offset or opcode cannot be. unexplained: unknown
    ones that no repetition of ours explains. timeouts: operations failed with RequestTimeout.
    """

    requests: int = 0
    retransmissions: int = 0
    spurious: int = 0
    replies: int = 0
    naks: int = 0
    unknown: int = 0
    stale: int = 0
    incoherent: int = 0
    unexplained: int = 0
    timeouts: int = 0
    by_opcode: defaultdict[int, int] = field(default_factory=lambda: defaultdict(int))
