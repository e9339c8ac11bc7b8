"""Says that it is the disk here that is full: to a program ENOSPC means the card. Layer: cache."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from mavftpfs.shared.errors import NoSpace

log = logging.getLogger("mavftpfs.cache")


class FullDisk:
    """Says it once until there was room."""

    def __init__(self) -> None:
        self._said = False

    @contextmanager
    def told(self) -> Iterator[None]:
        """Log a NoSpace that comes from inside; it goes on."""
        said = self._said  # an attempt that fails frees what it had taken itself
        try:
            yield
        except NoSpace as error:
            if not said:
                log.warning("no room here, not on the vehicle, for what is not delivered yet: %s", error)
            self._said = True
            raise

    def freed(self) -> None:
        """There is room again: the next time is news."""
        self._said = False
