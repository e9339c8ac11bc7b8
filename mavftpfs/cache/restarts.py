"""Whether an open file is still the same after the vehicle restarted. Layer: cache.

While a vehicle restarts its card may be written elsewhere, or be another one. A file that is open meanwhile
is compared before more of it is given out, also what a read under way brought:
- size and mtime are known and equal: it goes on;
- nothing of it was given out yet: what is held is forgotten, and all is read from what is there now;
- else, if the size is the same, the vehicle's CRC32 must be that of the bytes held and the rest; if it is
  not, or cannot be had (armed, refused, too large), or the file is larger, old handles get FileChanged.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial

from mavftpfs.cache.flights import Flights
from mavftpfs.cache.versions import Fetcher, Version, became_another
from mavftpfs.shared.errors import NotADirectory, NotFound
from mavftpfs.shared.model import DirEntry


class Restarts:
    """Compares versions with what the vehicle holds now."""

    def __init__(
        self,
        fetcher: Fetcher,
        facts: Callable[[bytes], Awaitable[DirEntry]],
        *,
        on_changed: Callable[[Version], None],
    ) -> None:
        """`facts` asks a fresh listing; `on_changed` hears that the file became another."""
        self._fetcher = fetcher
        self._facts = facts
        self._on_changed = on_changed
        self._rechecking: Flights[Version, None] = Flights()

    async def recheck(self, version: Version) -> None:
        """Compare an open version with what the vehicle holds, if that restarted since.

        Raises:
            FileChanged: it is not provably the same. Else as RemoteStore.list_directory and crc32.
        """
        if version.recheck:
            await self._rechecking.run(version, partial(self._recheck_once, version))
        version.require_alive()

    async def _recheck_once(self, version: Version) -> None:
        boot, path = version.boot, version.path
        entry: DirEntry | None = None
        with suppress(NotFound, NotADirectory):
            entry = await self._facts(path)
        async with self._fetcher.paths.steady(lambda: version.path) as present:
            if present != path:
                return  # who reads on has it compared under its new name
        if entry is None or became_another(version.size, version.mtime, entry):
            self._on_changed(version)
        elif _is_the_same(version, entry):
            version.proven_boot = boot
        elif not version.blocks.given:
            version.close_reader()
            version.kept = None
            version.blocks.start_over()
            version.mtime = entry.mtime if entry.size == version.size else None
            version.proven_boot = boot
        elif entry.size not in (None, version.size) or not await self._fetcher.prove(version):
            self._on_changed(version)


def _is_the_same(version: Version, entry: DirEntry) -> bool:
    """Return whether a listing after a restart shows the very file."""
    known = entry.size is not None and entry.mtime is not None
    return known and (entry.size, entry.mtime) == (version.size, version.mtime)
