"""The frames in the bytes of a side, each with its place. Layer: hub; pure."""

from __future__ import annotations

from mavftpfs.hub.senders import Place
from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.frames import Frame, Splitter

_MOST_SPLITTERS = 64


class Inlet:
    """Finds the frames of one side. stream: the side is a stream; otherwise it receives datagrams, and each
    address has frames of its own."""

    def __init__(self, side: int, *, stream: bool) -> None:
        self._side = side
        self._stream = Splitter(stream=True) if stream else None
        self._splitters: dict[NetAddress | None, Splitter] = {}

    @property
    def waiting(self) -> bool:
        """Whether a stream ended in a possible beginning of a frame."""
        return self._stream is not None and self._stream.waiting

    def feed(self, piece: bytes, address: NetAddress | None) -> list[tuple[Place, Frame]]:
        """Take a piece that arrived from an address; return the frames that it completes."""
        place = Place(self._side, address)
        return [(place, frame) for frame in self._splitter(address).feed(piece)]

    def on_silence(self, address: NetAddress | None) -> list[tuple[Place, Frame]]:
        """Note that the stream fell silent within a frame. Return the frames that the rest holds."""
        place = Place(self._side, address)
        return [(place, frame) for frame in self._splitter(address).on_silence()]

    def reset(self) -> None:
        """Drop half frames, because the link was reopened."""
        self._splitters.clear()
        if self._stream is not None:
            self._stream.reset()

    def _splitter(self, address: NetAddress | None) -> Splitter:
        if self._stream is not None:
            return self._stream
        splitter = self._splitters.get(address)
        if splitter is None:
            if len(self._splitters) >= _MOST_SPLITTERS:
                self._splitters.clear()
            splitter = self._splitters[address] = Splitter(stream=False)
        return splitter
