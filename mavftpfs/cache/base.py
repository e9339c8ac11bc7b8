"""The vehicle's file below a draft: reads it, and fetches it. Layer: cache."""

from __future__ import annotations

from dataclasses import replace

from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Draft
from mavftpfs.cache.files import VersionHandle
from mavftpfs.cache.nodes import Node
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared.errors import FileChanged, LocalProtocolError

STEP = 128 * 1024
"""Bytes fetched at once."""


async def open_node(context: Context, node: Node) -> VersionHandle:
    """Open the vehicle's file of a node, under the name that it has by now.

    Raises:
        FileChanged: the vehicle does not have it any more. Else as Files.open.
    """
    async with context.paths.steady(node) as path:
        node.require_reachable()
        handle = await context.files.open(path)
    try:
        node.require_reachable()  # opening it may have shown that others replaced it
    except FileChanged:
        handle.close()
        raise
    return handle


async def read_base(context: Context, node: Node, start: int, stop: int) -> bytes | memoryview:
    """Return bytes of the vehicle's file that a node's draft lies over.

    Raises:
        FileChanged: it is another file by now. Else as Files.open and VersionHandle.read.
    """
    while True:
        node.require_not_stale()
        if node.base_handle is None:
            opened = await open_node(context, node)
            if node.base_handle is None:
                node.base_handle = opened
            else:
                opened.close()
        handle = node.base_handle
        if node.draft is not None and handle.size < stop:
            raise FileChanged(f"{node.path!r} became shorter on the vehicle")
        try:
            return await handle.read(start, stop - start)
        except (FileChanged, LocalProtocolError) as error:
            if node.base_handle is not handle:
                continue  # we replaced the file ourselves meanwhile
            if (
                isinstance(error, FileChanged)
                and not node.removed
                and not context.nodes.is_changing(node.path)
            ):
                context.files.on_replaced(node.path)
            raise


async def fetch(context: Context, node: Node, draft: Draft) -> None:
    """Fetch the bytes of a draft that only the vehicle has. The caller delivers the draft.

    Where listings tell no times, the whole old file is read to know its checksum. The delivery compares that
    before it replaces the old file.

    Raises:
        NoSpace; else as read_base.
    """
    assert draft.base is not None
    size = draft.base.size
    summed = not context.directories.tells_times and draft.base_limit == size <= context.options.verify_max
    value = 0
    for start, stop in [(0, size)] if summed else draft.missing_base():
        for at in range(start, stop, STEP):
            data = await read_base(context, node, at, min(at + STEP, stop))
            value = crc32(data, value)
            draft.fill(at, data)
    if summed:
        draft.base = replace(draft.base, crc32=value)
