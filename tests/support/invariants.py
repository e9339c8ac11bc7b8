"""What holds of every file of a card whenever no task runs: the states that cannot occur, written down.

It holds after each step of a task, because one thread changes all state, and leaves none half changed at an
await. A `Rig` watches every tree that it mounts.
"""

from __future__ import annotations

import trio

from mavftpfs.cache.card import Card
from mavftpfs.cache.file import File, State


def check_file(card: Card, file: File) -> None:
    """Raise AssertionError if a file is in a state that cannot occur."""
    content, is_live = file.content, file in card.live
    if file.is_local:
        content.check_invariants()
    # A file that is sent, or was, is whole, and remembered until the vehicle has it, or nobody wants it.
    if file.attempt is not None:
        assert is_live
        assert (file.is_local and content.whole) or not file.attempt.sending.has_more()
    if file.unsure is not None:
        assert is_live
        assert file.has_name
        assert file.state is State.DIRTY
        assert content.whole
    if file.has_part:
        assert file.state is not State.CLEAN
    # The states.
    if file.state in (State.DIRTY, State.STALE):
        assert file.is_local
        assert is_live
    if file.state is State.CLEAN and file.is_local:
        assert content.whole
    if file.state is State.STALE:
        assert file.has_name
    if file.state in (State.DEAD, State.BROKEN):
        assert not file.has_name
        assert file.attempt is None
    if file.is_local:  # bytes that are not here are the base's
        end = 0 if file.base is None else min(file.base.size, content.size)
        assert content.held.covers(end, content.size)
        assert file.base is not None or not content.keeps_base
    assert file.writers <= file.handles
    assert not file.handles or is_live or file.state is State.BROKEN


def check_card(card: Card) -> None:
    """Raise AssertionError if the books of a card are wrong."""
    for file in card.live:
        check_file(card, file)
    for file in card.broken:
        check_file(card, file)
        assert file.state is State.BROKEN
        assert file not in card.live
    for file in card.closed:
        check_file(card, file)
        assert file.state is State.CLEAN
        assert file.has_name
        assert not file.is_local
        assert not file.handles


class Invariants(trio.abc.Instrument):
    """Checks a card after each step of a task."""

    def __init__(self, card: Card) -> None:
        self._card = card
        self._failure: AssertionError | None = None

    def after_task_step(self, task: trio.lowlevel.Task) -> None:
        """Check. trio would swallow an exception, so the first one is kept."""
        if self._failure is None:
            try:
                check_card(self._card)
            except AssertionError as failure:
                self._failure = failure

    def require_none_broken(self) -> None:
        """Raise the first AssertionError that was found."""
        if self._failure is not None:
            raise self._failure
