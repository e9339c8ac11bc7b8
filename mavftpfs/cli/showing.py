"""Progress on a terminal; nothing is drawn where there is none. Layer: cli."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from mavftpfs.client.progress import Progress


@contextmanager
def shown(progress: Progress, idle: str = "looking at what is there") -> Iterator[Progress]:
    """Show progress on stderr during the body, if that is a terminal; nothing of it stays at the end.

    idle: what is shown where nothing is planned.
    """
    if not sys.stderr.isatty():
        yield progress
        return
    from mavftpfs.cli import drawing  # rich takes a tenth of a command's start

    with drawing.drawn(progress, idle):
        yield progress
