"""A file whose commit was interrupted. Layer: cache; pure.

Before the first request that may change a file's name, the file notes what is committed there. It is `unsure`
until the vehicle confirmed that, or `looking` found out what has the name.
"""

from __future__ import annotations

from dataclasses import dataclass

from mavftpfs.shared.sameness import Known


@dataclass(frozen=True, slots=True)
class Unsure:
    """The commit of a file under its name that was interrupted, or is under way.

    temporary: the verified temporary file. aside: the name that the old file has, or may have; None if it was
    not moved. sent: the content that is committed. changes: the file's `changes` when that was sent.
    """

    temporary: bytes
    aside: bytes | None
    sent: Known
    changes: int
