"""Reading the vehicle's files: opening, fetching bytes, and proving that they are the same. Layer: cache.

**Is what is here still the vehicle's file?** An open() decides:
- yes, if a fresh listing shows the size and the mtime that are known;
- yes, if that was proven less than `dir_timeout` ago, and no later listing contradicts. Then the vehicle is
  not asked. Where listings tell no times, only the reply to an open proves it;
- otherwise the file is opened on the vehicle, and the bytes that are here are forgotten: equal sizes without
  an mtime prove nothing.

**While a program has it open** the vehicle's session is closed and opened again: after losses, restarts, and
turns of other users. The reply to an open tells the size, and a listing that began after it the mtime, where
listings tell any. A file that is equal, or larger, is the same, because logs grow; handles read up to the
size that it had when a program last opened it. If another file has the name, the file is DEAD: its handles
get FileChanged, and the name gets another File. Between two comparisons (COMPARE_PAUSE) a program may get
bytes of the next version. The comparison at the file's end finds that out, so a program that reads to the end
gets the error.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import trio

from mavftpfs.cache.card import Card
from mavftpfs.cache.directories import COST_FACTOR, Directory, Found
from mavftpfs.cache.file import Event, File, Replaces, State
from mavftpfs.cache.readahead import Readahead
from mavftpfs.cache.remote import Reader
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    DataUnproven,
    FileChanged,
    FtpNak,
    IsADirectory,
    LocalProtocolError,
    NotADirectory,
    NotFound,
)
from mavftpfs.shared.model import DirEntry, EntryKind, split
from mavftpfs.shared.sameness import Known, Listed, Opened, Sameness, compare

READING = 3.0
"""Seconds for which a file of which bytes arrived counts as being read."""

PAUSES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Seconds that a read waits before it tries again after its bytes became suspect. Together they are longer
than it takes to notice that another client used this mount's session."""

COMPARE_PAUSE = 2.0
"""Seconds after a directory was listed before it is listed again only to compare a file in it, or 50 times
what that listing took if that is more. A read that reaches the end of the file does not wait for that."""


# --- opening


async def opened(card: Card, path: bytes) -> tuple[File, bool]:
    """Return the file of a path, proven to be the vehicle's just now, or with pending changes; and whether
    pages that the kernel has of it are right.

    Raises:
        NotFound, NotADirectory, IsADirectory. DataUnproven: the size in the reply is smaller than listed.
        Else as RemoteStore.open_reader.
    """
    while True:
        file = card.find(path)
        if file is not None and file.is_local:
            return file, False
        found = await card.directories.find(path)
        if found.entry.kind is not EntryKind.FILE:
            raise IsADirectory(f"{path!r} is a directory")
        file = card.need(path)
        try:
            same = await card.opening.run(file, partial(_revalidate, card, file, found))
        finally:
            if file.base is None and not (file.handles or file.is_local):
                card.forget(file)  # it was not opened
        if same is not None and file.has_name:
            return file, same


async def _revalidate(card: Card, file: File, found: Found) -> bool | None:
    """Make sure that a file is the vehicle's. Returns whether its bytes are still those that it had; None if
    it turned out to be replaced, so that the path is another file's."""
    listed_at = found.directory.listed_at
    if file.base is not None:
        answer = compare(replace(_version(card, file), at_open=True), Listed(found.entry))
        if answer is Sameness.OTHER and listed_at > file.proven_at:
            if file.handles:
                on_replaced(card, file)
                return None
        elif found.size == file.size and _may_serve(card, file, found, answer):
            return True
        if not file.handles:
            file.base = None  # nothing depends on what it was
    return await _open(card, file, found.entry)


def _may_serve(card: Card, file: File, found: Found, answer: Sameness) -> bool:
    fresh = card.clock() < found.directory.fresh_until
    if fresh and answer is Sameness.SAME and found.directory.listed_at > card.epoch:
        file.prove(found.directory.listed_at)
        return True
    proven_at = file.proven_at if answer is Sameness.SAME else file.fresh_at
    return card.clock() - proven_at < card.options.proof_time and proven_at > card.epoch


async def _open(card: Card, file: File, entry: DirEntry) -> bool | None:
    """Open a file on the vehicle to learn its size; result as of _revalidate."""
    card.directories.require_heard()
    blocks, path = file.blocks, file.path
    blocks.close_reader()
    blocks.drop()
    file.in_kernel = False
    reader = await card.store.open_reader(path, blocks)
    try:
        if reader.size < entry.size and not file.is_local:
            entry = await _require_listed(card, path, reader.size)
    except BaseException:
        reader.close()
        raise
    if file.is_local or not file.has_name:  # a program emptied or removed it meanwhile
        reader.close()
        return False
    if file.base is not None and compare(file.base, Opened(reader.size)) is Sameness.OTHER:
        reader.close()
        on_replaced(card, file)
        return None
    blocks.close_reader()  # another read may have opened one meanwhile, perhaps of another file
    blocks.drop()
    blocks.reader = reader
    file.content.on_opened(reader.size)
    file.base = Known(reader.size, entry.mtime if entry.size == reader.size else None)
    file.fresh_at = card.clock()
    file.prove(file.fresh_at)
    if entry.size != reader.size:  # the kernel was told another one
        card.directories.learn_size(path, reader.size)
        card.tell_changed(path)
    return False


async def _require_listed(card: Card, path: bytes, size: int) -> DirEntry:
    """Return what a new listing shows of a file, if it agrees with the size in the reply to an open.

    A size that is too small would make a copy too short, without an error.

    Raises:
        DataUnproven: the listing shows another size. NotFound; otherwise as RemoteStore.list_directory.
    """
    entry = await card.directories.ask_entry(path)
    if entry is None:
        raise NotFound(f"{path!r} was removed from the vehicle")
    if entry.size != size:
        raise DataUnproven(f"{path!r} has {entry.size} bytes as listed, and {size} as opened")
    return entry


async def _reopened(card: Card, file: File) -> Reader:
    """Return a new reader of a file. The vehicle opens the file when bytes are wanted.

    Raises:
        As RemoteStore.open_reader.
    """
    async with card.paths.steady(file) as path:
        file.require_base()
        reader = await card.store.open_reader(path, file.blocks, expected_size=file.blocks.size)
    if file not in card.live or not file.has_name:
        reader.close()
        raise LocalProtocolError(f"{file.path!r} was closed while it was read")
    if file.blocks.reader is not None:  # another read was faster
        reader.close()
        return file.blocks.reader
    file.blocks.reader = reader
    return reader


# --- fetching


async def read(
    card: Card,
    file: File,
    start: int,
    stop: int,
    ahead: Readahead | None = None,
    *,
    base: bool = False,
    ended: bool = False,
) -> bytes | memoryview:
    """Return [start, stop) of a file, cut at its end, proven to be its own. ahead: what to fetch before it is
    asked for. base: of the vehicle's file, whatever programs changed. ended: the program read the end before,
    so no later read of it would prove these bytes.

    Raises:
        FileChanged, DataUnproven, RequestTimeout, VehicleLost, FtpNak, SpoolFailed.
    """
    for pause in (*PAUSES, 0.0):
        file.require_alive()
        epoch = card.epoch
        data = await _pieces(card, file, start, stop, ahead, base)
        if data is not None:
            if base or not file.content.whole or not file.is_local:
                await _prove(card, file, at_end=ended or stop >= file.size)
            if card.epoch == epoch:
                return data
        if card.epoch != epoch:
            await trio.sleep(pause)
    raise DataUnproven(f"bytes of {file.path!r} may be another file's, again and again")


async def _pieces(
    card: Card, file: File, start: int, stop: int, ahead: Readahead | None, base: bool
) -> bytes | memoryview | None:
    """Return [start, stop) piece by piece; None: some of it was dropped meanwhile."""
    parts: list[bytes | memoryview] = []
    fetch = _base_bytes if base else _piece
    for at in range(start, stop, card.cache.piece):
        data = await fetch(card, file, at, min(at + card.cache.piece, stop), ahead)
        if data is None:
            return None
        parts.append(data)
    return parts[0] if len(parts) == 1 else b"".join(parts)


async def _piece(
    card: Card, file: File, start: int, stop: int, ahead: Readahead | None
) -> bytes | memoryview | None:
    """Return [start, stop), at most a piece, cut at the end of the file. None: it was renamed, or bytes were
    dropped, meanwhile.

    Raises:
        As _base_bytes; SpoolFailed.
    """
    content = file.content
    if not file.is_local:
        return await _base_bytes(card, file, start, stop, ahead)
    parts: list[bytes | memoryview] = []
    while start < min(stop, content.size):
        end = min(stop, content.size)
        a, b = next(iter(content.missing(start, end)), (end, end))  # anew: a program may have written
        if a > start:
            parts.append(content.get(start, a))
            start = a
            continue
        data = await _base_bytes(card, file, a, b, None)
        if data is None:
            return None
        parts.append(data)
        start = b
    return parts[0] if len(parts) == 1 else b"".join(parts)


async def _base_bytes(
    card: Card, file: File, start: int, stop: int, readahead: Readahead | None
) -> bytes | memoryview | None:
    """Return bytes of the vehicle's file, at most a piece, not proven yet. None: see _piece.

    Raises:
        FileChanged: another file has the name, or none. Otherwise as RemoteStore.open_reader and
            Blocks.wait_for.
    """
    file.require_base()
    blocks, ahead = file.blocks, (stop, stop)
    if readahead is not None:
        limit, small = card.cache.readahead_limits(len(card.live))
        plan = readahead.on_read(start, stop, limit=limit, small=small)
        ahead = (plan.start, plan.stop)
        if plan.seeked and blocks.reader is not None:
            blocks.reader.drop(demand=False)
    data = blocks.get(start, stop)
    if data is not None:
        if blocks.reader is not None and ahead[0] < ahead[1]:
            blocks.reader.want(*ahead, demand=False)
        return data
    try:
        async with card.cache.reads:
            if blocks.missing(start, stop):
                reader = blocks.reader or await _reopened(card, file)
                reader.want(start, stop, demand=True)
                if ahead[0] < ahead[1]:
                    reader.want(*ahead, demand=False)
                await blocks.wait_for(start, stop)
            return blocks.get(start, stop)
    except (FileChanged, FtpNak) as error:
        if not isinstance(error, FileChanged) and errno_for(error) != errno.ENOENT:
            raise
        on_replaced(card, file)
        file.require_base()
        raise


# --- is it the same file?


def _version(card: Card, file: File) -> Known:
    assert file.base is not None
    return replace(file.base, restarted=card.restarted_at >= file.proven_at)


def _needs_proof(card: Card, file: File, *, at_end: bool) -> bool:
    """Return whether a listing is to tell that a file is still the vehicle's, before bytes are given out.

    at_end: the read, or an earlier one, reached the end of the file, so it does not wait for the pause
    between two listings. Any other read may get bytes of the next file of this name; then the read that
    reaches the end fails.
    """
    if file.base is None or not file.has_name:
        return False
    if file.proven_at >= file.blocks.opened_at and file.proven_at > card.epoch:
        return False
    timed = card.directories.tells_times or file.base.mtime is not None
    if not timed and file.proven_at > card.restarted_at:
        return False  # the reply to the open was enough: the file did not become smaller
    known = card.directories.known(split(file.path)[0])
    if at_end or known is None or known.listed_at <= card.epoch:
        return True
    pause = max(COMPARE_PAUSE, COST_FACTOR * (known.ended_at - known.listed_at))
    return card.clock() >= known.ended_at + pause


async def _prove(card: Card, file: File, *, at_end: bool) -> None:
    """Check by a listing, if one can tell more, that the vehicle's file of this name is still the same.

    Raises:
        FileChanged: it is another one. Otherwise as RemoteStore.list_directory.
    """
    if not _needs_proof(card, file, at_end=at_end):
        return
    path, since = file.path, max(file.blocks.opened_at, card.epoch)
    try:
        directory = await card.directories.ask(split(path)[0], not_before=since)
    except (NotFound, NotADirectory):
        on_replaced(card, file)
    else:
        async with card.paths.steady(file) as present:
            if present == path and not _may_be_replacing(file):
                _compare(card, file, directory)
            # else the next read compares the file under its new name
    file.require_base()


def _may_be_replacing(file: File) -> bool:
    """Return whether this mount may have given the name another file: one with pending changes is locked (a
    delivery compares the vehicle's file itself, and may be just replacing it), or its commit was interrupted,
    or it is sent under its own name."""
    return file.is_local and (file.lock.locked() or file.unsure is not None or file.lies_in_place)


def _compare(card: Card, file: File, directory: Directory) -> None:
    """Compare a file with a listing that began after its last proof."""
    entry = directory.entries.get(file.name)
    answer = compare(_version(card, file), Listed(entry, directory.complete))
    if answer is Sameness.OTHER:
        on_replaced(card, file)
    elif entry is not None and file.base is not None:  # else the listing is incomplete, and does not tell
        if directory.listed_at >= file.blocks.opened_at:
            file.prove(directory.listed_at)
        if file.base.mtime is None and entry.size == file.base.size:
            file.base = replace(file.base, mtime=entry.mtime)


def on_listed(card: Card, path: bytes, directory: Directory) -> None:
    """Compare the open files of a directory with a new listing."""
    folder = card.root.find_folder(path)
    for file in [] if folder is None else list(folder.children.values()):
        if not isinstance(file, File) or file not in card.live or file.base is None:
            continue
        is_seen = file.name in directory.entries and directory.listed_at > file.proven_at
        if is_seen and not _may_be_replacing(file):
            _compare(card, file, directory)


def on_replaced(card: Card, file: File) -> None:
    """Note that another file, or none, has the name on the vehicle, unless a delivery may have caused that.

    Open handles get FileChanged, and never read the other file. Exception: pending changes that need no byte
    of the old file are kept, and the next delivery replaces the other file.
    """
    if file.has_name and not _may_be_replacing(file):
        lose_base(card, file)


def lose_base(card: Card, file: File) -> None:
    """As on_replaced, for callers that hold the file's lock."""
    file.in_kernel = False
    card.tell_changed(file.path)
    file.blocks.end(FileChanged(f"{file.path!r} changed on the vehicle after it was opened"))
    if file.state is State.DIRTY and file.replaces is not Replaces.BASE:
        return
    file.on(Event.REPLACED)
    if file.state is State.DEAD:
        card.lose_name(file)


# --- what is going on


def status(card: Card) -> Sequence[dict[str, object]]:
    """Return the files that are being fetched, with path, size and done in bytes."""
    recent = card.clock() - READING
    found = []
    for file in card.live:
        blocks = file.blocks
        if blocks.waited_for or (blocks.received_at > recent and blocks.progress < blocks.size):
            path = file.path.decode(errors="replace")
            found.append({"path": path, "size": blocks.size, "done": blocks.progress})
    return found
