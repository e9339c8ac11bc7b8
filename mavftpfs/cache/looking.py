"""The file under a name after an interrupted commit, by a listing and a comparison. Layer: cache.

The first that fits:
1. The name is missing, and the verified temporary file is there: that gets the name; nothing is sent again.
2. The name is missing, and the old file is aside: that gets its name back.
3. The name has what was committed: that is what the vehicle has of the file, which is delivered if no program
   changed it since.
4. Anything else: the next delivery sends the file again, if it may replace what has the name (see
   `File.replaces`).

If a name lacks its old file, the renames of 1 and 2 are made in flight, too; a checksum is asked for after
the flight.
"""

from __future__ import annotations

import logging
from contextlib import suppress

import trio

from mavftpfs.cache.card import Card
from mavftpfs.cache.directories import Directory
from mavftpfs.cache.file import File
from mavftpfs.cache.unsure import Unsure
from mavftpfs.shared.errors import Armed, FtpNak, MavftpfsError, NotADirectory, NotFound
from mavftpfs.shared.model import DirEntry, EntryKind, split

log = logging.getLogger("mavftpfs.cache")

LOOK_AGAIN, IN_FLIGHT = 2.0, 60.0
"""Seconds after which mavftpfs looks again what has a name; the second while the vehicle is armed."""


async def until_known(card: Card, file: File) -> None:
    """Find out what has the name of a file whose commit was interrupted, once the vehicle is heard. The next
    delivery would find it out, too, but it waits for the end of a flight, and for programs that have the file
    open for writing; the name may lack its file until then."""
    pause = LOOK_AGAIN
    while file.unsure is not None:
        await trio.sleep(pause)
        if card.store.why_lost() is not None:
            continue
        try:
            async with file.lock, card.paths.steady(file):  # so that `repair` leaves the name alone, too
                await look(card, file)
        except MavftpfsError as error:
            log.info("what has the name %r is not known yet: %s", file.path, error)
            pause = IN_FLIGHT if isinstance(error, Armed) else LOOK_AGAIN
    card.maybe_forget(file)


async def look(card: Card, file: File) -> None:
    """If the commit of a file was interrupted, find out what has its name, and give a missing name its file.
    The caller has the file's lock.

    Raises:
        Armed: nothing is renamed, and no checksum is computed, in flight. Also as Directories.ask and
        Names.rename. The file stays unsure.
    """
    unsure = file.unsure
    if unsure is None:
        return
    if not await _is_committed(card, file, unsure):
        return
    if file.changed_since(unsure):
        file.base = unsure.sent
        file.content.on_committed(unsure.sent.size)
    else:
        card.on_delivered(file, unsure.sent)


async def _is_committed(card: Card, file: File, unsure: Unsure) -> bool:
    """Return whether the vehicle has what was committed (rules 1 and 3), after which the file is not unsure.
    If nothing has the name, and nothing was left of it, the file has no base from now on."""
    path, there, committed = file.path, None, False
    with suppress(NotFound, NotADirectory):
        directory = await card.directories.ask(split(path)[0])
        there = directory.has(path) or await _give_name_back(card, unsure, path, directory.entries)
        if there is not None:
            committed = await _is_sent(card, file, unsure, there, directory)
    if there is None:
        file.base, file.content.keeps_base = None, False
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
                await card.names.rename(left, path, completes=unsure.aside is not None)
            except FtpNak as nak:
                refused = nak
            else:
                return entry
    if refused is not None:
        raise refused
    return None


async def _is_sent(card: Card, file: File, unsure: Unsure, there: DirEntry, directory: Directory) -> bool:
    """Return whether a file on the vehicle is what was committed: the checksums are equal. If the vehicle
    tells none, the size is right, and the temporary file is gone. If a program changed a file larger than
    verify_max since, nobody knows the checksum of what was committed, and the right size is enough: all of
    the file is sent once more anyway."""
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
        log.warning("%r: its checksum was not told: %s", file.path, nak)
        return directory.complete and split(unsure.temporary)[1] not in directory.entries
