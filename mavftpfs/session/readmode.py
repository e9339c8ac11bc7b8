"""Remembers how fast reading was and steers transfers by the policy. Layer: session."""

from __future__ import annotations

from mavftpfs.protocol.chunks import Chunks
from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.protocol.transfers import ReadTransfer
from mavftpfs.session.policy import ReadMode, Strategy, choose_strategy


class ReadSteering:
    """Chooses strategy and chunk for each transfer, and remembers what they measured.

    chunk: bytes a request asks for, 1..239; None = the most that fits, or less where that brings more.

    Attributes:
        most: bytes of the longest chunk. chunks, write_chunks: choose their size, None where it was given.
    """

    def __init__(self, engine: Engine, mode: ReadMode = "auto", chunk: int | None = None) -> None:
        self.mode: ReadMode = mode
        self.most = MAX_DATA if chunk is None else chunk
        auto = chunk is None
        self.chunks = Chunks(explained=self._lost_in_pauses) if auto else None
        self.write_chunks = Chunks(self._has_room, self._lost_in_pauses) if auto else None
        self._engine = engine
        self._window_rate: float | None = None
        self._burst_rate: float | None = None
        self._chosen: Strategy | None = None

    @property
    def chunk(self) -> int:
        """Bytes that a ReadFile asks for."""
        return self.most if self.chunks is None else self.chunks.size

    def _has_room(self) -> bool:
        return self._engine.flow.window < self._engine.flow.cap

    def _lost_in_pauses(self) -> float:
        return self._engine.flow.stalls.share

    def status(self) -> dict[str, object]:
        """Return how files are read, and how fast; bytes per second, None for what was not measured."""
        return {
            "reading_by": self._chosen,
            "window": self._engine.flow.window,
            "in_flight": self._engine.in_flight,
            "chunk": self.chunk,
            "loss": round(self._engine.flow.loss, 4),
            "window_rate": self._window_rate,
            "burst_rate": self._burst_rate,
        }

    def steer(self, transfer: ReadTransfer) -> None:
        """Let a running transfer go on by what is the better strategy now."""
        self.learn(transfer)
        # A keep-alive of a burst counts for a moment, too, which costs nothing.
        others_ask = self._engine.in_flight > transfer.in_flight
        strategy = self._chosen = choose_strategy(self.mode, others_ask=others_ask)
        if strategy != transfer.strategy:
            transfer.set_strategy(strategy)

    def learn(self, transfer: ReadTransfer) -> None:
        """Take over what a transfer measured."""
        self._window_rate = transfer.window_rate or self._window_rate
        self._burst_rate = transfer.burst_rate or self._burst_rate

    def forget(self) -> None:
        """The server may be another one now."""
        self._window_rate = self._burst_rate = None
        self._chosen = None
