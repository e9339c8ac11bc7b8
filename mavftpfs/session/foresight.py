"""How many strings a directory probably holds, so that a sweep can ask for its end at once, and whether its
names moved up while a sweep went on. Layer: session.

A server says that a listing is over only when it is asked for what follows, which costs a round trip more
than the names do. Where they probably end is known from the last sweep and our own changes since then; who
else changes the directory makes that wrong, which costs one request and proves nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mavftpfs.shared.model import split, wire_path

_MOST = 512


class Foresight:
    """Remembers directories by path, the latest swept ones."""

    def __init__(self) -> None:
        self._strings: dict[bytes, int] = {}
        self._moves = 0
        self._moved: dict[bytes, int] = {}
        self._moved_before = 0
        self._moving: list[bytes] = []

    @contextmanager
    def moving_up(self, *paths: bytes) -> Iterator[None]:
        """The body sends a request that takes these names away: servers count names, so that one of those
        behind them comes to lie before the place where a sweep goes on."""
        directories = [wire_path(split(path)[0]) for path in paths]
        self._moving += directories
        try:
            yield
        finally:
            for directory in directories:
                self._moving.remove(directory)
                self._note_moved(directory)

    def _note_moved(self, directory: bytes) -> None:
        self._moves += 1
        self._moved.pop(directory, None)
        self._moved[directory] = self._moves
        if len(self._moved) > _MOST:
            oldest = next(iter(self._moved))
            self._moved_before = self._moved.pop(oldest)

    def moves(self, directory: bytes) -> int | None:
        """Return a number that grows when its names move up, None while they may be moving."""
        return None if directory in self._moving else self._moved.get(directory, self._moved_before)

    def learn(self, directory: bytes, strings: int) -> None:
        """A sweep came to its end after so many strings."""
        self._strings.pop(directory, None)
        self._strings[directory] = strings
        if len(self._strings) > _MOST:
            del self._strings[next(iter(self._strings))]

    def strings(self, directory: bytes) -> int:
        """Return how many a sweep will probably bring, 0 if nobody knows."""
        return max(0, self._strings.get(directory, 0))

    def made(self, path: bytes) -> None:
        """We make this name."""
        self._count(path, 1)

    def took(self, path: bytes) -> None:
        """We took this name away."""
        self._count(path, -1)

    def lose(self, *paths: bytes) -> None:
        """These names may be there now, or not."""
        for path in paths:
            self._strings.pop(wire_path(split(path)[0]), None)

    def forget(self) -> None:
        """It may be another card."""
        self._strings.clear()

    def _count(self, path: bytes, names: int) -> None:
        directory = wire_path(split(path)[0])
        if directory in self._strings:
            self._strings[directory] += names
