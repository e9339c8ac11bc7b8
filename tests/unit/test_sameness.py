"""Is it still the same file? The table, row by row, and all rows against what may have happened."""

from __future__ import annotations

from itertools import product

import pytest

from mavftpfs.shared.model import DirEntry, EntryKind
from mavftpfs.shared.sameness import Known, Listed, Opened, Sameness, Seen, Summed, compare

SAME, GREW, UNDECIDED, OTHER = Sameness
SIZE = 100
FLAGS = list(product((False, True), repeat=3))


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
    ("ours, and of the time that was told later", Known(SIZE, 5, ours=True), listed(mtime=5), UNDECIDED),
    ("ours, of another time", Known(SIZE, 5, ours=True), listed(mtime=6), OTHER),
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


def rows() -> list[tuple[Known, Seen]]:
    """Return every combination of what may be known with what may be seen."""
    sizes, times, sums = (SIZE - 1, SIZE, SIZE + 1), (None, 5, 6), (0, 7, 8)
    knowns = [
        Known(SIZE, mtime, crc32, *flags) for mtime, crc32, flags in product(times, (None, 0, 7), FLAGS)
    ]
    seens: list[Seen] = [Opened(size) for size in sizes]
    seens += [listed(size, mtime, kind) for size, mtime, kind in product(sizes, times, EntryKind)]
    seens += [NONE, PART, *map(Summed, sums)]
    return list(product(knowns, seens))


def contradicts(known: Known, seen: Seen) -> bool:
    """Return whether what was seen cannot be the file that is known, though somebody may have appended."""
    match seen:
        case Opened():
            return seen.size < known.size
        case Summed():
            return known.crc32 is not None and seen.crc32 != known.crc32
    entry = seen.entry
    if entry is None:
        return seen.complete
    times = None not in (known.mtime, entry.mtime) and known.mtime != entry.mtime
    if entry.kind is not EntryKind.FILE or entry.size < known.size:
        return True
    return known.restarted if entry.size > known.size else times


def size_of(seen: Seen) -> int | None:
    """Return the size that was seen."""
    if isinstance(seen, Opened):
        return seen.size
    return seen.entry.size if isinstance(seen, Listed) and seen.entry is not None else None


@pytest.mark.holds("promise 1", "promise 5")
def test_no_row_takes_another_file_for_the_same_nor_the_same_for_another() -> None:
    answers = set()
    for known, seen in rows():
        answer, size, bad = compare(known, seen), size_of(seen), contradicts(known, seen)
        answers.add(answer)
        assert (answer is OTHER) == bad, (known, seen)
        assert (answer is GREW) <= (size is not None and size > known.size), (known, seen)
        assert (answer is SAME) <= (size in (None, known.size)), (known, seen)
        # A program that opens it anew gets what is cached only where times, or a CRC32, agree.
        if answer is SAME and known.at_open and isinstance(seen, Listed):
            assert seen.entry is not None
            assert seen.entry.mtime == known.mtime is not None
        # A time that may be another file's proves nothing.
        assert not (answer is SAME and known.ours and isinstance(seen, Listed)), (known, seen)
    assert answers == set(Sameness)
