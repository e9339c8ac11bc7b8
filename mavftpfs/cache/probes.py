"""Has the vehicle show on files of our own what it does to those opened to be written. Layer: cache."""

from __future__ import annotations

import logging

from mavftpfs.cache.context import Context
from mavftpfs.shared.errors import FtpNak, PathTooLong
from mavftpfs.shared.model import split

log = logging.getLogger("mavftpfs.cache")


class Prober:
    """Fills the traits of writing."""

    def __init__(self, context: Context) -> None:
        self._context = context

    async def probe(self, path: bytes) -> None:
        """Find out what OpenFileWO does to files like the one at `path`; what does not show itself is taken
        to empty them.

        Raises:
            As WriteStore.probe_open_for_write.
        """
        try:
            await self._probe_beside(path)
        except PathTooLong as error:
            log.info("what the vehicle does to open files stays unknown: %s", error)
        traits = self._context.writer.traits
        if traits.wo_truncates is None:
            traits.wo_truncates = True

    async def _probe_beside(self, path: bytes) -> None:
        live, names = self._context.live, self._context.namer.probes(path)
        live.update(names)
        try:
            await self._context.writer.probe_open_for_write(*names)
        except FtpNak as nak:
            if split(names[0])[0] == split(path)[0]:
                raise
            log.info("nothing can be tried out in a directory above %r: %s", path, nak)
        finally:
            live.difference_update(names)  # what is left there by an interruption is litter from now on
