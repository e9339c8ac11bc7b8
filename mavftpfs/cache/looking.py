"""The file under a name after an interrupted replacement, by a listing and a comparison. Layer: cache.

The first that fits:
1. The name is missing, and the verified temporary file is there: that gets the name; nothing is sent again.
2. The name is missing, and the old file is aside: that gets its name back.
3. The name has what was committed: that is what the vehicle has of the file, which is delivered if no program
   changed it since.
4. The name has what the file changes: the next delivery sends it again.
5. The name has something else, and bytes of the base matter: the next delivery makes the file STALE.
6. There was no base, and the name is taken: the next delivery says EEXIST.

The last three are what each delivery finds out before it commits a file. Renames of 1 and 2 are made in
flight, too; a checksum is asked for after the flight.
"""

from __future__ import annotations

import logging

from mavftpfs.cache.card import Card
from mavftpfs.cache.file import File
from mavftpfs.cache.unsure import Unsure
from mavftpfs.shared.errors import FtpNak, NotADirectory, NotFound, NotVerified
from mavftpfs.shared.model import DirEntry, EntryKind, split

log = logging.getLogger("mavftpfs.cache")


async def look(card: Card, file: File) -> bool:
    """Find out what has the name of an unsure file, and give a missing name its file; return whether the
    vehicle has what was committed (rules 1 and 3). Then the file stops being unsure. The caller holds the
    file's lock.

    If nothing has the name, and nothing was left of it, the file has no base from now on.

    Raises:
        NotVerified: the vehicle sent no checksum. Armed: none is asked for in flight. Also as Directories.ask
        and Names.rename. The file stays unsure.
    """
    unsure, path = file.unsure, file.path
    assert unsure is not None
    try:
        directory = await card.directories.ask(split(path)[0])
        there = directory.has(path) or await _give_name_back(card, unsure, path, directory.entries)
    except (NotFound, NotADirectory):
        there = None
    committed = there is not None and await _is_sent(card, file, unsure, there)
    if there is None:
        file.base, file.content.base_limit = None, 0
    card.names.settle(file)
    return committed


async def _give_name_back(
    card: Card, unsure: Unsure, path: bytes, entries: dict[bytes, DirEntry]
) -> DirEntry | None:
    """Rename what was left of a missing name to it, and return that; None if nothing was left, or if the card
    turned out to rename nothing."""
    refused: FtpNak | None = None
    for left in (unsure.temporary, unsure.aside) if card.store.traits.rename_works is not False else ():
        entry = None if left is None else entries.get(split(left)[1])
        if left is not None and entry is not None:
            log.warning("%r was left by an interruption: renaming it to %r", left, path)
            try:
                await card.names.rename(left, path, completes=True)
            except FtpNak as nak:
                refused = nak
            else:
                return entry
    if refused is not None:
        raise refused
    return None


async def _is_sent(card: Card, file: File, unsure: Unsure, there: DirEntry) -> bool:
    """Return whether a file on the vehicle is what was committed."""
    sent = unsure.sent
    if there.kind is not EntryKind.FILE or there.size != sent.size:
        return False
    crc32 = sent.crc32
    if crc32 is None and file.changes == unsure.changes:
        crc32 = file.crc32()
    if not sent.size or crc32 is None:
        return True
    try:
        return crc32 == await card.store.crc32(file.path, size=sent.size)
    except FtpNak as nak:
        raise NotVerified(f"{file.path!r} is in doubt, and the vehicle told no checksum: {nak}") from nak
