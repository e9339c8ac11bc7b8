"""The end of a writable mount: upload pending changes, or save them here. Layer: mount."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import trio

from mavftpfs.cache.tree import Tree
from mavftpfs.client.undelivered import recovery_directory, what_to_do
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.shared.readable import count_files

log = logging.getLogger("mavftpfs.mount")

BREAK_LIMIT = 5.0
"""Seconds for running calls to end their writes."""
DRAIN_LIMIT = 300.0
"""Seconds to upload pending changes after the kernel mount is gone; a second signal ends this sooner."""


def keep_the_rest(tree: Tree, directory: Path) -> str:
    """Move undelivered files to a local directory; return a line about them, or ""."""
    broken = tree.broken()
    left = [*tree.undelivered(), *broken]
    if not left:
        return ""
    lost, one = f"{count_files(len(left))} did not reach the vehicle", len(left) == 1
    if broken:
        lost += ", because a write failed" if one else f", {len(broken)} of them because a write failed"
    try:
        kept = tree.recover_to(directory)
    except OSError as exc:
        return f"{lost}, and {directory} is not writable: {exc.strerror}"
    except MavftpfsError as exc:
        return f"{lost}, and could not be moved to {directory}: {exc}"
    if len(kept) == len(left):
        return f"{lost}; {'it is' if one else 'they are'} kept in {directory}"
    return (
        f"{lost}; only {len(kept)} could be kept, in {directory}; "
        "the log says why, and the next mount looks for the others"
    )


async def drain_or_keep(tree: Tree, source: str, tell: Callable[[str], None]) -> None:
    """Upload pending changes, and keep the rest here; `tell` gets the line for exit code 4. When cancelled,
    keep all."""
    try:
        with trio.move_on_after(BREAK_LIMIT, shield=True):
            await tree.break_unfinished()
        waiting = tree.undelivered()
        if waiting:
            log.warning("uploading %s to the vehicle before ending", count_files(len(waiting)))
            await tree.drain(DRAIN_LIMIT)
    finally:
        directory = recovery_directory(source)
        message = keep_the_rest(tree, directory)
        if message:
            message += f"; {what_to_do(source, directory)}" if directory.exists() else ""
            log.error("%s", message)
            tell(message)
