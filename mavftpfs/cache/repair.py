"""What becomes of reserved names that an interruption left on the card. Layer: cache.

`leftovers` finds them in a listing, `Cleaner` acts on each:
  what was sent                  is removed: no close() reported it to be on the card
  an old file, its name there    is removed: the new one has the name
  an old file, its name missing  gets its name again
  an old file of unknown name    is renamed to `recovered-oSSS`: it may be the only copy
Nothing is touched while the mount that owns it may be alive: see DEAD_AFTER.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from contextlib import suppress

from mavftpfs.cache.context import Context
from mavftpfs.cache.directories import Directory
from mavftpfs.cache.names import Names
from mavftpfs.cache.reserved import Kind, Reserved, is_reserved, parse
from mavftpfs.shared.errors import MavftpfsError, NotADirectory, NotFound
from mavftpfs.shared.model import DirEntry, EntryKind, join, split

log = logging.getLogger("mavftpfs.cache")

MAX_LEFTOVERS = 128
"""Leftovers that are dealt with after one listing."""

DEAD_AFTER = 600.0
"""Another mount's reserved name counts as left behind after it stayed the same for so many seconds."""

MAX_SEEN = 1024
"""How many such names are remembered, each with the time since which it stayed the same."""


def leftovers(
    directory: bytes, entries: Iterable[DirEntry], is_dead: Callable[[bytes, bytes, DirEntry], bool]
) -> list[tuple[bytes, Reserved]]:
    """Return the paths in a listing that an interruption left, old files first: their names may have no file.

    is_dead(path, owner, entry): whether no mount works with that name any more. Directories are never ours.
    """
    found = []
    for entry in entries:
        name, path = parse(entry.name), join(directory, entry.name)
        if name is not None and entry.kind is not EntryKind.DIRECTORY and is_dead(path, name.owner, entry):
            found.append((path, name))
    return sorted(found, key=lambda left: left[1].kind is not Kind.OLD)


class Cleaner:
    """Looks at every listing, removes leftovers, and ends unfinished replacements."""

    def __init__(self, context: Context, names: Names, dead_owners: frozenset[bytes]) -> None:
        """`dead_owners`: mounts that are known to have ended."""
        self._context = context
        self._names = names
        self._dead_owners = dead_owners | {context.own.owner}
        self._seen: dict[bytes, tuple[int, float]] = {}
        self._busy: set[bytes] = set()

    async def on_swept(self, path: bytes, directory: Directory) -> None:
        """Clean up after a directory was listed. Raises no MavftpfsError: the listing is right in any
        case."""
        replacements = self._context.replacements
        targets = {record.aside: target for target, record in replacements if record.aside is not None}
        reserved = [entry for name, entry in directory.entries.items() if is_reserved(name)]
        if directory is self._context.directories.known(path):
            here = {join(path, name) for name in directory.entries}
            for target, record in replacements:
                if split(target)[0] == path and record.lacks_file:
                    lost = directory.complete and record.aside not in here
                    if target in here or lost:
                        self._on_nothing_to_mend(target)
        if path in self._busy or not reserved:
            return
        self._busy.add(path)
        try:
            for left, ours in leftovers(path, reserved, self._is_dead)[:MAX_LEFTOVERS]:
                if not self._context.blocked or left in replacements.needed_asides():
                    await self._mend(left, ours, targets.get(left))
        except MavftpfsError as error:
            log.info("%r is cleaned up at a later listing: %s", path, error)
        finally:
            self._busy.discard(path)

    async def finish(self, *, at_once: bool = False) -> None:
        """End unfinished replacements. Names that may lack a file get theirs, and old files that lay aside
        long enough are removed; all of them `at_once`. A listing of their directories does both.

        An old file that was removed at once can be there again only by a late copy of a request. So its
        directory is listed only in doubt.
        """
        context, now = self._context, self._context.clock()
        directories = set()
        for path, record in context.replacements:
            if record.lacks_file and record.aside not in context.own.in_use:
                directories.add(split(path)[0])
            elif record.aside is None and not self._waits_for_delivery(path):
                context.replacements.end(path)
            elif record.placed and (at_once or record.until <= now):
                context.own.in_use.discard(record.aside or b"")
                if not context.store.in_doubt():
                    context.replacements.end(path)
                    continue
                directories.add(split(path)[0])
                record.until = now
        for directory in directories:
            try:
                await context.directories.ask(directory)
            except MavftpfsError as error:
                log.info("%r is mended at a later listing: %s", directory, error)
                continue
            for path, record in context.replacements:
                if split(path)[0] == directory and record.placed and record.until <= now:
                    context.replacements.end(path)

    # --- inside

    def _on_nothing_to_mend(self, path: bytes) -> None:
        """Note that a name has a file, or that the old file is gone, too. If a draft waits to be delivered
        there, its delivery looks at that; else nothing is unfinished any more."""
        record = self._context.replacements.get(path)
        if record is not None and self._waits_for_delivery(path):
            record.aside = None
        else:
            self._context.replacements.end(path)

    def _waits_for_delivery(self, path: bytes) -> bool:
        """Return whether a draft of this path waits to be delivered."""
        node = self._context.nodes.get(path)
        return node is not None and node.undelivered

    def _is_dead(self, path: bytes, owner: bytes, entry: DirEntry) -> bool:
        if path in self._context.own.in_use:
            return False
        if owner in self._dead_owners:
            return True
        seen, now = self._seen.get(path), self._context.clock()
        if seen is None or seen[0] != entry.size:  # it is new, or it grows
            seen = self._seen[path] = (entry.size, now)
            if len(self._seen) > MAX_SEEN:
                del self._seen[next(iter(self._seen))]
        return now - seen[1] >= DEAD_AFTER

    async def _mend(self, left: bytes, name: Reserved, known_target: bytes | None) -> None:
        """Remove what is left, or give it its name. known_target: the path whose replacement left it, if this
        mount made it."""
        context, parent = self._context, split(left)[0]
        target = known_target or join(parent, name.target or b"recovered-o" + name.serial)
        if name.kind is not Kind.OLD or await self._exists(target):
            await self._names.remove(left)
        else:
            node = context.nodes.get(target)
            if node is not None and node.delivery is not None:
                return  # its delivery is under way: a later listing shows the outcome
            log.warning("%r was left by an interruption: renaming it to %r", left, target)
            await self._names.rename(left, target, completes=known_target is not None)
            if known_target is not None:
                self._on_nothing_to_mend(known_target)

    async def _exists(self, path: bytes) -> bool:
        """Return whether the vehicle has a file of this name.

        Raises:
            VehicleLost: only an old listing was to be had, in which we may have put the name ourselves.
        """
        with suppress(NotFound, NotADirectory):
            await self._context.directories.find(path)
            self._context.directories.require_heard()
            return True
        return False
