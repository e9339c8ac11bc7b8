"""The end of a mount that was written to: deliver, or keep. Layer: mount."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from mavftpfs.cache.tree import Tree
from mavftpfs.client.leftovers import put_back_by, recovery_directory
from mavftpfs.shared.errors import MavftpfsError

log = logging.getLogger("mavftpfs.mount")

DRAIN_LIMIT = 300.0
"""Seconds to go on delivering after the kernel mount is gone; a second signal ends it sooner."""


def keep_the_rest(tree: Tree, directory: Path) -> str:
    """Move what is still undelivered to a local directory; return the line that says so, or ""."""
    broken = tree.broken()
    left = [*tree.undelivered(), *broken]
    if not left:
        return ""
    lost = f"{len(left)} file(s) did not reach the vehicle"
    if broken:
        lost += f", {len(broken)} of them because a write failed"
    try:
        kept = tree.recover_to(directory)
    except OSError as exc:
        return f"{lost}, and {directory} is not writable: {exc.strerror}"
    except MavftpfsError as exc:
        return f"{lost}, and could not be moved to {directory}: {exc}"
    if len(kept) == len(left):
        return f"{lost}; they are kept in {directory}"
    return (
        f"{lost}; only {len(kept)} could be kept, in {directory}; "
        "the log says why, and the next mount looks for the others"
    )


async def say_goodbye(tree: Tree, source: str, tell: Callable[[str], None]) -> None:
    """Deliver, or keep what is left; `tell` gets the line that goes with exit code 4. When cancelled,
    keep."""
    try:
        waiting = tree.undelivered()
        if waiting:
            log.warning("delivering %d file(s) to the vehicle before ending", len(waiting))
            await tree.drain(DRAIN_LIMIT)
    finally:
        directory = recovery_directory(source)
        put_back = put_back_by(source, directory) if tree.undelivered() else "list them by: mavftpfs recover"
        message = keep_the_rest(tree, directory)
        if message:
            message += f"; {put_back}" if directory.exists() else ""
            log.error("%s", message)
            tell(message)
