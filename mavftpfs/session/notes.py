"""Remarks for the payload trace: what became of a reply, what goes out again. Layer: session; pure."""

from __future__ import annotations

from collections import OrderedDict

from mavftpfs.protocol.payload import Payload
from mavftpfs.protocol.stats import EngineStats

_REMEMBERED = 1024


class Remarks:
    """Only used while somebody traces; costs nothing else."""

    def __init__(self, stats: EngineStats) -> None:
        self._stats = stats
        self._before = (0, 0, 0)
        self._unanswered: OrderedDict[tuple[int, int, int, bytes], int] = OrderedDict()

    def on_request(self, wire: bytes) -> str:
        """Return "", or whether these 251 bytes were sent before and are not answered yet."""
        seq, rest = int.from_bytes(wire[:2], "little"), (wire[2], wire[3], wire[4], wire[8:])
        earlier = self._unanswered.get(rest)
        self._unanswered[rest] = seq
        if len(self._unanswered) > _REMEMBERED:
            self._unanswered.popitem(last=False)
        if earlier is None:
            return ""
        return "retransmit" if earlier == seq else f"retransmit of {earlier}"

    def before_reply(self) -> None:
        """The engine is about to see a reply."""
        stats = self._stats
        self._before = (stats.unknown, stats.stale, stats.incoherent)

    def after_reply(self, reply: Payload) -> str:
        """Return "" for a believed reply, else why it was not."""
        stats, (unknown, stale, incoherent) = self._stats, self._before
        if stats.unknown > unknown:
            return "late, duplicate or not ours"
        if stats.stale > stale:
            return "stale replay"
        if stats.incoherent > incoherent:
            return "does not fit its request"
        asked = (reply.seq - 1) & 0xFFFF
        for rest, seq in list(self._unanswered.items()):
            if seq == asked:
                del self._unanswered[rest]
        return ""
