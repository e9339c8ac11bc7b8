"""What is known of names whose files we replaced. Layer: cache; pure.

A file is replaced by one rename, or by three requests: the old file moves aside, the new one gets the name,
and the old one is removed. If they are interrupted, one record says what is known of the name. `names` or
`delivery`, which notices the interruption, makes the record. The cleaner (`repair`) ends it, or the delivery
that compared the file, or the next change of the name. A delivery looks at it first.

A replacement that was not interrupted has a record, too, for some seconds (placed: True): a late copy of a
request could bring the old file back.

  aside   placed   the name has
  none    None     the new file, the old one, or nothing: a single rename was interrupted
  none    False    a file, or nothing: a listing showed that, or that the old file is gone, and a draft waits
  set     None     the new file or nothing: the old one was moved aside
  set     False    the old file or nothing: it was perhaps moved aside, and perhaps back
  set     True     the new file; in doubt the old one still lies aside
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf

from mavftpfs.shared.model import rename_keys, renamed
from mavftpfs.shared.sameness import Known


@dataclass(slots=True)
class Replacement:
    """What is known of one name.

    aside: where the old file lies, or may lie; None if none does. placed: whether the new file has the name;
    None if that is not known. until: when the old file is to be removed, by the caches' clock. sent: what the
    interrupted delivery tried to place. If the name has it, the next delivery may replace it. None if no
    delivery was interrupted, or if its file proved to be spoilt (`Draft.not_confirmed`).
    """

    aside: bytes | None = None
    placed: bool | None = None
    until: float = inf
    sent: Known | None = None

    @property
    def lacks_file(self) -> bool:
        """Whether the name may have no file, and the old one waits to be moved back."""
        return self.aside is not None and self.placed is not True


class Replacements:
    """The records of a mount, by path: of unfinished replacements, and for some seconds of finished ones."""

    def __init__(self) -> None:
        self._records: dict[bytes, Replacement] = {}

    def __iter__(self) -> Iterator[tuple[bytes, Replacement]]:
        """Yield paths and records; ending some meanwhile is fine."""
        return iter(list(self._records.items()))

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._records)

    def get(self, path: bytes) -> Replacement | None:
        """Return the record of a path."""
        return self._records.get(path)

    def put(self, path: bytes, record: Replacement) -> None:
        """Note what is known of a path from now on."""
        self._records[path] = record

    def is_unfinished(self, path: bytes) -> bool:
        """Return whether it was interrupted: a listing is to tell which file has the name."""
        record = self._records.get(path)
        return record is not None and record.placed is not True

    def on_interrupted(self, path: bytes) -> Replacement:
        """Note that it is not known whether the new file has the name; return the record. One that says that
        the new file was not placed stays so."""
        record = self._records.setdefault(path, Replacement())
        if record.placed:
            record.placed, record.until = None, inf
        return record

    def end(self, path: bytes) -> Replacement | None:
        """Remove the record of a path, and return it."""
        return self._records.pop(path, None)

    def needed_asides(self) -> set[bytes]:
        """Return the asides that must stay: a name may lack its file, and this is the old one."""
        return {record.aside for record in self._records.values() if record.lacks_file and record.aside}

    def follow_rename(self, old: bytes, new: bytes) -> None:
        """A directory has another name."""
        rename_keys(self._records, old, new)
        for record in self._records.values():
            if record.aside is not None:
                record.aside = renamed(record.aside, old, new)
