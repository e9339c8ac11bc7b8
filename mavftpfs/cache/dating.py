"""Finds out the times of files that stay open for writing. Layer: cache.

A program that only writes reads nothing by which a successor of its file could be told. So where listings
tell mtimes, and a file was opened or delivered a while ago, one listing is asked for: what the file has then
is what it has to have when a part of it is changed (`base.require_same`). Files that are closed sooner, as
most are, cost nothing more. One that is delivered again and again has its directory listed for this at most
every 50 times what that takes (`dentries.COST_FACTOR`), which matters where that is long: on a radio.
"""

from __future__ import annotations

import logging

import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.dentries import COST_FACTOR
from mavftpfs.cache.nodes import Node
from mavftpfs.shared.errors import LinkError, MavftpfsError, RequestTimeout, SessionBusy
from mavftpfs.shared.model import DirEntry, split

log = logging.getLogger("mavftpfs.cache")

DATE_AFTER = 2.0
"""Seconds: most files are closed by then."""

RETRY_PAUSE = 5.0


class Dater:
    """Needs the context's nursery; without one only listings asked for otherwise tell."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._not_before: dict[Node, float] = {}

    def on_known(self, node: Node, entry: DirEntry | None) -> None:
        """The vehicle is known to have a file as it is; entry: what a listing since then shows of it."""
        node.known_at = self._context.clock()
        node.mtime = None if entry is None else entry.mtime
        node.may_be_cut = False
        self.watch(node)

    def watch(self, node: Node) -> None:
        """A file is open: find out its mtime by and by, if it is not known."""
        if self._context.nursery is not None and not node.dating and self._is_wanted(node):
            node.dating = True
            self._context.nursery.start_soon(self._date, node)

    def _is_wanted(self, node: Node) -> bool:
        """Return whether somebody may change a part of a file of which listings would tell the mtime."""
        draft = node.draft
        if draft is None or draft.fresh or not node.writers or node.mtime is not None:
            return False
        return self._context.directories.tells_times

    async def _date(self, node: Node) -> None:
        context, pause = self._context, DATE_AFTER
        try:
            while self._is_wanted(node):
                known_at = node.known_at
                begin = max(known_at + DATE_AFTER, self._not_before.get(node, known_at))
                await trio.sleep(max(pause, begin - context.clock()))
                pause = 0.0
                if not self._is_wanted(node) or node.known_at != known_at:
                    continue
                if context.is_changing(node.path):
                    pause = DATE_AFTER  # its delivery is under way, or failed
                elif await self._ask(node):
                    return
        finally:
            node.dating = False

    async def _ask(self, node: Node) -> bool:
        """Return whether no more is to be asked: a listing showed the file as it was last known, which
        Context.on_listed heeds, or there is none."""
        known_at, now = node.known_at, self._context.clock()
        try:
            directory = await self._context.directories.recent(split(node.path)[0], began=now)
        except (RequestTimeout, LinkError, SessionBusy) as error:
            log.debug("when %r was changed last is not known yet: %s", node.path, error)
            await trio.sleep(RETRY_PAUSE)
            return False
        except MavftpfsError as error:
            log.debug("when %r was changed last is not known: %s", node.path, error)
            return True
        self._not_before = {other: at for other, at in self._not_before.items() if at > now}
        self._not_before[node] = now + COST_FACTOR * (directory.ended_at - directory.listed_at)
        return node.known_at == known_at and not self._context.is_changing(node.path)
