"""The frames in what a side brings, each with its place. Layer: hub; pure."""

from __future__ import annotations

from mavftpfs.hub.senders import Place
from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.frames import Frame, Splitter

_MOST_SPLITTERS = 64


class Inlet:
    """Finds the frames of one side. stream: it brings a stream, else datagrams, of which each address has its
    own."""

    def __init__(self, side: int, *, stream: bool) -> None:
        self._side = side
        self._stream = Splitter(stream=True) if stream else None
        self._splitters: dict[NetAddress | None, Splitter] = {}

    @property
    def waiting(self) -> bool:
        """Whether a stream ended in what may be the beginning of a frame."""
        return self._stream is not None and self._stream.waiting

    def feed(self, piece: bytes, address: NetAddress | None) -> list[tuple[Place, Frame]]:
        """Take a piece that came from an address."""
        place = Place(self._side, address)
        return [(place, frame) for frame in self._splitter(address).feed(piece)]

    def on_silence(self, address: NetAddress | None) -> list[tuple[Place, Frame]]:
        """The stream fell silent within a frame. Return what is found in the rest."""
        place = Place(self._side, address)
        return [(place, frame) for frame in self._splitter(address).on_silence()]

    def reset(self) -> None:
        """Forget half frames: the link was reopened."""
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
