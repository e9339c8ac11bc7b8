"""Is it still the same file?"""

from __future__ import annotations

import pytest

from mavftpfs.shared.model import DirEntry, EntryKind
from mavftpfs.shared.sameness import Known, Listed, Opened, Sameness, Seen, Summed, compare

SAME, GREW, UNDECIDED, OTHER = Sameness
SIZE = 100


def listed(size: int = SIZE, mtime: int | None = None, kind: EntryKind = EntryKind.FILE) -> Listed:
    return Listed(DirEntry(b"name", kind, size, mtime))


NONE, PART = Listed(None), Listed(None, complete=False)

TABLE: list[tuple[str, Known, Seen, Sameness]] = [
    ("opened smaller", Known(SIZE), Opened(SIZE - 1), OTHER),
    ("opened equal", Known(SIZE), Opened(SIZE), SAME),
    ("opened larger", Known(SIZE), Opened(SIZE + 1), GREW),
    ("opened, its time is known", Known(SIZE, 5), Opened(SIZE), UNDECIDED),
    ("opened larger, its time is known", Known(SIZE, 5), Opened(SIZE + 1), UNDECIDED),
    ("opened after a restart", Known(SIZE, restarted=True), Opened(SIZE), UNDECIDED),
    ("opened larger after a restart", Known(SIZE, restarted=True), Opened(SIZE + 1), UNDECIDED),
    ("opened smaller, whatever else", Known(SIZE, 5, restarted=True), Opened(SIZE - 1), OTHER),
    ("gone", Known(SIZE), NONE, OTHER),
    ("not in what came of a listing", Known(SIZE), PART, UNDECIDED),
    ("a directory", Known(SIZE), listed(kind=EntryKind.DIRECTORY), OTHER),
    ("smaller", Known(SIZE, 5), listed(SIZE - 1, 5), OTHER),
    ("larger", Known(SIZE, 5), listed(SIZE + 1, 6), GREW),
    ("larger after a restart", Known(SIZE, 5, restarted=True), listed(SIZE + 1, 6), OTHER),
    ("equal, no times", Known(SIZE), listed(), SAME),
    ("equal, no times, opened anew", Known(SIZE, at_open=True), listed(), UNDECIDED),
    ("equal, its time was not known", Known(SIZE), listed(mtime=5), SAME),
    ("equal, its time was not known, opened anew", Known(SIZE, at_open=True), listed(mtime=5), UNDECIDED),
    ("equal, its time is not told", Known(SIZE, 5), listed(), SAME),
    ("equal, and of that time", Known(SIZE, 5, at_open=True), listed(mtime=5), SAME),
    ("equal, and of that time after a restart", Known(SIZE, 5, restarted=True), listed(mtime=5), SAME),
    ("equal, of another time", Known(SIZE, 5), listed(mtime=6), OTHER),
    ("its CRC32 is not known", Known(SIZE), Summed(7), UNDECIDED),
    ("the same CRC32", Known(SIZE, crc32=7), Summed(7), SAME),
    ("another CRC32", Known(SIZE, crc32=7), Summed(8), OTHER),
    ("0, which leading zeros do not change", Known(SIZE, crc32=0), Summed(0), UNDECIDED),
    ("another CRC32 than 0", Known(SIZE, crc32=0), Summed(8), OTHER),
]


@pytest.mark.holds("promise 1", "promise 5")
@pytest.mark.parametrize(("known", "seen", "expected"), [row[1:] for row in TABLE], ids=[r[0] for r in TABLE])
def test_the_table(known: Known, seen: Seen, expected: Sameness) -> None:
    assert compare(known, seen) is expected
