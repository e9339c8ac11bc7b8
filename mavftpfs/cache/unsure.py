"""A file whose placing was interrupted. Layer: cache; pure.

Before the first request that may change a file's name, the file notes what is placed there. It is `unsure`
until the vehicle confirmed that, or `looking` found out what has the name.
"""

from __future__ import annotations

from dataclasses import dataclass

from mavftpfs.shared.sameness import Known


@dataclass(frozen=True, slots=True)
class Unsure:
    """What was being placed under a name.

    temporary: the verified temporary file; aside: where the old file is, or may be, None if it was not moved.
    sent: what is placed. changes: the file's `changes` when that was sent. in_place: no temporary file is
    placed, the card may have bytes of the file under its own name.
    """

    temporary: bytes
    aside: bytes | None
    sent: Known
    changes: int
    in_place: bool = False
