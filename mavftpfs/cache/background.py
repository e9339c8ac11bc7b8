"""Delivering what nobody waits for, and the end of a mount. Layer: cache."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import trio

from mavftpfs.cache import delivery, uploads, writing
from mavftpfs.cache.card import Card
from mavftpfs.cache.file import File, State
from mavftpfs.cache.recovery import move
from mavftpfs.cache.uploads import PASSING, may_pass
from mavftpfs.shared import readonly
from mavftpfs.shared.errors import Armed, LinkClosed, MavftpfsError, NoSpace, SpoolFailed
from mavftpfs.shared.readable import readable

log = logging.getLogger("mavftpfs.cache")

RETRY_PAUSE = 1.0
"""Seconds between two rounds of delivering everything."""

PAUSES = (2.0, 30.0)
"""Seconds between two attempts to deliver what no program has open: at first, and at most."""


class Background:
    """Tries again to deliver files that no program is writing."""

    def __init__(self, card: Card) -> None:
        self._card = card
        self._retrying, self._news = False, trio.Event()
        card.retry_later = self.retry_later

    # --- what is not on the vehicle

    def undelivered(self) -> list[File]:
        """Return the files of which the vehicle does not provably have every byte."""
        return [file for file in self._card.live if file.undelivered]

    async def break_unfinished(self) -> None:
        """See Tree.break_unfinished. A file that did not change since a close or an fsync of it failed is
        whole."""
        reason = LinkClosed("the mount was taken away while a program wrote it")
        for file in sorted(self._card.live, key=lambda file: file.lock.locked()):  # the wait may be cut short
            if file.writers and file.undelivered and file.failed_changes != file.changes:
                async with file.lock:
                    if file.undelivered and file.state is State.DIRTY:
                        await writing.break_off(self._card, file, reason)
        await self._remove_parts()

    async def drain(self, timeout: float) -> None:
        """See Tree.drain."""
        with trio.move_on_after(timeout):
            await self._deliver_each(lambda file: True)
            while any(map(may_pass, self.undelivered())):
                await trio.sleep(RETRY_PAUSE)
                await self._deliver_each(may_pass)

    async def tidy_up(self) -> None:
        """See Tree.tidy_up."""
        await self._remove_parts()
        if self._card.store.why_lost() is None:
            await self._card.repair.finish()

    async def _remove_parts(self) -> None:
        """Remove from the card what broken files left there, while their bytes are here to compare it."""
        if self._card.store.why_lost() is None:
            with suppress(MavftpfsError):
                await uploads.remove_parts(self._card)

    def recover_to(self, directory: Path) -> list[Path]:
        """See Tree.recover_to."""
        card, kept = self._card, []
        failed: OSError | NoSpace | SpoolFailed | None = None
        for file in [*self.undelivered(), *card.broken]:
            spooled = file.content.spooled
            if spooled is None:
                continue
            facts = writing.describe(file, card.wall)
            try:
                kept.append(move(Path(spooled.persist(facts)), facts, directory))
            except (OSError, NoSpace, SpoolFailed) as error:
                log.error("%r could not be saved: %s", file.path, error)
                failed = error
            else:
                if file in card.broken:
                    card.broken.remove(file)
                file.forget_content()
                file.state, file.unsure, file.has_part = State.CLEAN, None, False
        if failed is not None and not kept:
            raise failed
        return kept

    def status(self) -> dict[str, object]:
        """Return counters; bytes_... in bytes. bytes_undelivered: of whole files; bytes_held: what they take
        here."""
        card, waiting = self._card, self.undelivered()
        failed = [file for file in card.live if file.error is not None and file.has_name]
        return {
            "bytes_held": card.spool.held,
            "unacked_max": card.throttle.limit,
            "write_rate": card.throttle.speed,
            "files_undelivered": len(waiting),
            "broken": {_shown(file): _reason_then(file.error) for file in card.broken},
            "bytes_undelivered": sum(file.size for file in waiting),
            "errors": {_shown(file): readable(str(file.error)) for file in failed},
            **card.counts,
        }

    # --- trying again

    def armed_changed(self, armed: bool) -> None:
        """See Tree.armed_changed."""
        blocked = armed and not self._card.options.write_armed
        if blocked != self._card.blocked:
            self._card.blocked = blocked
            self._card.throttle.waiting.unpark_all()
            self.retry()

    def retry(self) -> None:
        """Deliver all files that no program is writing: the vehicle is back, or may be written again. Errors
        that may have passed are forgotten."""
        for file in self._card.live:
            if isinstance(file.error, PASSING):
                file.error = None
        self._card.repair.retry()
        if self._card.parts or self.undelivered():
            self._news.set()
            self.retry_later()

    def retry_later(self) -> None:
        """Try again later: something was not delivered, or a broken file left a part on the card."""
        if not self._retrying:
            self._retrying = True
            self._card.nursery.start_soon(self._retry)

    async def _retry(self) -> None:
        """Deliver what no program writes: with growing pauses as long as that may help, because a link may
        fail and return between two heartbeats. When there are news of the vehicle, everything is tried at
        once, also what was refused."""
        card, (pause, longest) = self._card, PAUSES
        try:
            while self._news.is_set() or card.parts or any(map(may_pass, self.undelivered())):
                with trio.move_on_after(pause):
                    await self._news.wait()
                is_new, pause = self._news.is_set(), min(2 * pause, longest)
                if is_new:
                    self._news, pause = trio.Event(), PAUSES[0]
                    for file in card.live:
                        file.start_after = float("-inf")
                with suppress(MavftpfsError):
                    await uploads.remove_parts(card)
                await self._deliver_each(partial(self._is_left_to_us, is_new))
        finally:
            self._retrying = False

    async def _deliver_each(self, wanted: Callable[[File], bool]) -> None:
        """Try once to deliver each file that is wanted, as long as it is; errors are kept with the file."""
        for file in self.undelivered():
            if not file.undelivered or not wanted(file):
                continue
            try:
                await delivery.deliver(self._card, file, wanted=partial(wanted, file))
            except MavftpfsError as error:
                log.debug("%r is still not delivered: %s", file.path, error)
            else:
                self._card.maybe_forget(file)

    @staticmethod
    def _is_left_to_us(is_new: bool, file: File) -> bool:
        """Return whether a file is to be delivered unasked."""
        return not file.writers and (is_new or may_pass(file))


def _shown(file: File) -> str:
    return file.path.decode(errors="replace")


def _reason_then(error: Exception | None) -> str:
    """Return why a write failed, told later: the vehicle may be disarmed meanwhile."""
    return readonly.WAS_ARMED if isinstance(error, Armed) else readable(str(error))
