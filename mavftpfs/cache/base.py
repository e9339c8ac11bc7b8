"""Reads of a file's old content below a draft. Layer: cache."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from mavftpfs.cache.context import Context
from mavftpfs.cache.files import FileHandle
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.versions import became_another
from mavftpfs.shared.errors import FileChanged, FtpNak, IsADirectory, LocalProtocolError, NotFound
from mavftpfs.shared.model import DirEntry, EntryKind, split

STEP = 128 * 1024


async def open_base(context: Context, path: bytes) -> FileHandle:
    """Open a file of the vehicle.

    Raises:
        NotFound, NotADirectory, IsADirectory; else as RemoteStore.open_reader.
    """
    found = await context.directories.find(path)
    if found.entry.kind is not EntryKind.FILE:
        raise IsADirectory(f"{path!r} is a directory")
    fresh = context.clock() < found.directory.fresh_until
    return await context.files.open(path, found.entry, found.directory.listed_at, fresh=fresh)


async def open_node(context: Context, node: Node) -> FileHandle:
    """Open what the vehicle has of a node, whatever it is called by now.

    Raises:
        FileChanged: it has no name there. Else as open_base.
    """
    while True:
        async with context.paths.steady(lambda: node.path) as path:
            node.require_reachable()
            try:
                return await open_base(context, path)
            except (NotFound, FtpNak):
                if node.path == path:
                    raise  # else it got its lasting hidden name meanwhile


async def _open_below(context: Context, node: Node) -> FileHandle:
    """Open what a node's draft lies over; if we wrote it, it has to be as we left it, as far as is known.

    Raises:
        FileChanged. Else as open_node and Directories.ask.
    """
    handle = await open_node(context, node)
    try:
        if node.mtime is not None:
            await _require_as_listed(context, node, context.clock())
    except BaseException:
        handle.close()
        raise
    return handle


def _changed_by_us(node: Node) -> bool:
    return node.draft is None or node.draft.touched or node.draft.placed


async def _require_as_listed(context: Context, node: Node, since: float) -> None:
    """Raise FileChanged if a listing that began at `since` or later shows that others replaced what was
    opened or written here; asks for one if there is none.

    Raises:
        As Directories.recent.
    """
    path = node.path
    parent, name = split(path)
    directory = await context.directories.recent(parent, began=since)
    if node.path == path and directory.listed_at >= node.known_at:  # it may not be the one that is kept
        _require_as_known(node, directory.entries.get(name))
    _require_as_known(node, context.dentries.listed_since(node.path, node.known_at))


def _require_as_known(node: Node, entry: DirEntry | None) -> None:
    """Raise FileChanged if a listing shows that others replaced what was opened or written here."""
    node.require_not_parted()
    if entry is not None and not _changed_by_us(node) and _is_another(node, entry):
        raise FileChanged(f"{node.path!r} became another file after it was opened or written here")


def _is_another(node: Node, entry: DirEntry) -> bool:
    draft = node.draft
    if draft is None or draft.remote_end is None:
        return False
    shorter = entry.size is not None and entry.size < draft.remote_end
    if shorter and (node.may_be_cut or entry.size == draft.size):
        return False  # it was cut by us, or just as it was to be
    return became_another(draft.remote_end, node.mtime, entry)


async def read_base(
    context: Context, node: Node, start: int, stop: int, *, sure: bool = False
) -> bytes | memoryview:
    """Return bytes of the vehicle's file that a node's draft lies over; sure: as FileHandle.read.

    Raises:
        FileChanged: it is another file by now. DataUnproven: they may be another file's. Else as open_base
        and FileHandle.read.
    """
    if node.draft is not None and node.draft.ruined:
        raise FileChanged(f"{node.path!r} was emptied on the vehicle while it was changed here")
    data: bytes | memoryview | None = None
    while data is None:
        if node.base is None:
            handle = await _open_below(context, node)
            if node.base is None:
                node.base = handle
            else:
                handle.close()
        base = node.base
        if node.draft is not None and base.size < stop:
            raise FileChanged(f"{node.path!r} became shorter on the vehicle")
        try:
            data = await base.read(start, stop - start, sure=sure)
        except (FileChanged, LocalProtocolError):
            if node.base is base:
                raise  # else we changed it there ourselves meanwhile, but not these bytes
    if node.draft is not None:
        node.draft.require_sound(start, stop)
    return data


async def require_same(context: Context, node: Node, since: float) -> None:
    """Check that the file below a draft is not another one by now: what was changed here of the old one is
    not to be changed there. The caller has the lock.

    A listing that began at `since` or later has to show the mtime that is known of the file, or of what was
    read of it. What we changed there ourselves meanwhile cannot be compared.

    Raises:
        FileChanged. Else as Directories.recent and FileHandle.require_same.
    """
    if not _changed_by_us(node):
        with node.looking():
            if node.mtime is not None or (node.base is not None and node.base.comparable):
                await _require_as_listed(context, node, since)
            else:
                _require_as_known(node, context.dentries.listed_since(node.path, node.known_at))
            if node.base is not None:
                await node.base.require_same()
    node.require_not_parted()
    if node.base is not None:
        node.base.require_not_lost()


async def require_stays(context: Context, node: Node, ask: Callable[[bytes], Awaitable[int]]) -> int:
    """Return the size on the vehicle of a file of which a part is to stay, as `ask` tells it; the caller has
    the lock.

    Raises:
        FileChanged: it grew or shrank, or is another one. Else as `ask` and require_same.
    """
    draft, since = node.draft, context.clock()
    assert draft is not None
    with node.looking():
        size, most = await ask(node.path), draft.remote_end
    await require_same(context, node, since)
    if most is not None and not draft.base_limit <= size <= max(most, draft.stretched):
        raise FileChanged(f"{node.path!r} has {size} bytes now, {most} when it was changed here")
    return size


def outdate(context: Context, node: Node) -> None:
    """We changed the vehicle's file: who reads it opens it anew, which is no change of somebody else's."""
    node.generation += 1
    node.mtime = None
    node.close_base()
    context.files.on_written(node.path)


async def cut(context: Context, node: Node, size: int) -> None:
    """Cut the vehicle's file; if that fails it may have been cut nevertheless, which nobody else did.

    Raises:
        As WriteStore.truncate.
    """
    node.may_be_cut = done = True
    try:
        await context.writer.truncate(node.path, size)
    except FtpNak:
        done = False
        raise
    finally:  # also if who waits for it gives up
        if done:
            context.dentries.note_unsized(node.path)
            outdate(context, node)


async def fill(context: Context, node: Node) -> None:
    """Fetch what only the vehicle has, so that the draft is whole; the caller has the node's lock.

    Raises:
        NoSpace; else as read_base.
    """
    draft = node.draft
    assert draft is not None
    with node.looking():
        for start, stop in draft.missing_base():
            for at in range(start, stop, STEP):
                end = min(at + STEP, stop)
                draft.fill(at, await read_base(context, node, at, end, sure=True))
