"""Whether a directory is empty as far as programs see it, and what of ours is in the way. Layer: cache.

A directory with nothing but reserved names looks empty, and its removal should say so. What the listing's
repair knew for dead is gone by then (`cleaning`); a file that was unlinked while it is read moves up. What is
left belongs to a mount that may be at work this moment: removing it could cost that mount's user the only
copy of a file. So the directory is busy (EBUSY) until those names were seen unchanged for
`asides.STALE_AFTER` seconds, unlinked files for DELETED_AFTER.
"""

from __future__ import annotations

import logging

from mavftpfs.cache.asides import Kind, is_reserved, parse
from mavftpfs.cache.context import Context
from mavftpfs.cache.sure import Sure
from mavftpfs.shared.errors import DirectoryNotEmpty, FileBusy
from mavftpfs.shared.model import join, split

log = logging.getLogger("mavftpfs.cache")


class Emptier:
    """Prepares the removal of directories."""

    def __init__(self, context: Context, sure: Sure) -> None:
        self._context = context
        self._sure = sure

    async def require_empty(self, path: bytes) -> list[bytes]:
        """Return our unlinked files in a directory that holds nothing else, by a listing asked for just now.

        Raises:
            DirectoryNotEmpty: programs see something in it. FileBusy: another mount has something in it.
            Else as Directories.ask.
        """
        if self._context.nodes.below(path):
            raise DirectoryNotEmpty(f"{path!r} is not empty")
        names = (await self._context.directories.ask(path)).entries
        if not all(is_reserved(name) for name in names):
            raise DirectoryNotEmpty(f"{path!r} is not empty")
        unlinked = [join(path, name) for name in names if self._is_unlinked_file(join(path, name))]
        if len(unlinked) < len(names):
            log.warning("%r holds files of another mount that is perhaps at work: %r", path, list(names))
            raise FileBusy(f"{path!r} holds temporary files of another mount")
        return unlinked

    async def vacate(self, path: bytes) -> None:
        """Move our unlinked files out of a directory that is about to be removed.

        Raises:
            As require_empty; as Sure.rename; PathTooLong: there is no shorter name for one.
        """
        for name in await self.require_empty(path):
            await self._move_up(name, split(path)[0])

    def _is_unlinked_file(self, path: bytes) -> bool:
        name = parse(split(path)[1])
        if name is None or name.kind is not Kind.DELETED:
            return False
        return path in self._context.live and name.owner == self._context.namer.owner

    async def _move_up(self, unlinked: bytes, directory: bytes) -> None:
        context, node = self._context, self._context.hidden.get(unlinked)
        better = context.namer.hidden(join(directory, b"x"))
        context.live.add(better)
        try:
            await self._sure.rename(unlinked, better)
        except BaseException:
            context.live.discard(better)
            raise
        context.live.discard(unlinked)
        context.files.on_renamed(unlinked, better)
        if node is not None:
            context.hide(node, better)
