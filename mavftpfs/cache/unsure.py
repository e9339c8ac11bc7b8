"""A file whose placing was interrupted. Layer: cache; pure.

Before the first request that may change a file's name, the file notes what is placed there. It is `unsure`
until the vehicle confirmed that, or `looking` found out what has the name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from mavftpfs.shared.sameness import Known


@dataclass(frozen=True, slots=True)
class Unsure:
    """What was being placed under a name.

    temporary: the verified temporary file; aside: where the old file is, or may be, None if it was not moved.
    sent: what is placed. changes: the file's `changes` when that was sent.
    """

    temporary: bytes
    aside: bytes | None
    sent: Known
    changes: int


class Placeable(Protocol):
    """A file, as far as giving it its name and looking at it needs it.

    unsure: see Unsure. base: the vehicle's file that it changes, None if it is a new file.
    """

    unsure: Unsure | None
    base: Known | None

    @property
    def path(self) -> bytes:
        """Its name now."""
        ...

    @property
    def changes(self) -> int:
        """How often its content changed."""
        ...

    def crc32(self) -> int:
        """Return the CRC32 of its whole content. Raises SpoolFailed."""
        ...
