"""Remembered listings: freshness, absence, bounds, and listings that race our own changes."""

from __future__ import annotations

import pytest

from mavftpfs.cache.attributes import MAX_MTIME, MAX_SIZE, UNKNOWN_MTIME, shown_mtime, tidy
from mavftpfs.cache.dentries import MAX_ABSENT, Dentries, Directory
from mavftpfs.shared.model import DirEntry, EntryKind, Listing


def file(name: bytes, size: int | None = 1, mtime: int | None = None) -> DirEntry:
    return DirEntry(name, EntryKind.FILE, size, mtime)


def folder(name: bytes) -> DirEntry:
    return DirEntry(name, EntryKind.DIRECTORY)


def make(max_entries: int = 1000) -> Dentries:
    return Dentries(dir_timeout=20, max_entries=max_entries)


def put(
    dentries: Dentries,
    path: bytes,
    *entries: DirEntry,
    now: float = 0,
    took: float = 0,
    complete: bool = True,
) -> Directory:
    return dentries.finish(dentries.begin(path, now), Listing(entries, took, complete), now)


def names(dentries: Dentries, path: bytes) -> set[bytes]:
    directory = dentries.known(path)
    return set(directory.entries) if directory else {b"(unknown)"}


def test_a_listing_is_fresh_for_dir_timeout() -> None:
    dentries = make()
    directory = put(dentries, b"/", file(b"a"), now=5)
    assert dentries.fresh(b"/", 24.9) is directory
    assert dentries.fresh(b"/", 25) is None
    assert dentries.known(b"/") is directory
    assert dentries.known(b"/b") is None


def test_a_listing_that_was_expensive_is_fresh_for_longer() -> None:
    dentries = Dentries(dir_timeout=None, max_entries=10)
    put(dentries, b"/", took=2)
    assert dentries.fresh(b"/", 99.9) is not None
    assert dentries.fresh(b"/", 100) is None


def test_a_dir_timeout_that_a_user_set_is_the_bound() -> None:
    dentries = Dentries(dir_timeout=0, max_entries=10)
    put(dentries, b"/", took=2)
    assert dentries.fresh(b"/", 0) is None


def test_the_listing_is_as_old_as_its_first_page() -> None:
    dentries = make()
    sweep = dentries.begin(b"/", 3)
    directory = dentries.finish(sweep, Listing((), 4.0), 7)
    assert directory.listed_at == 3
    assert directory.fresh_until == 7 + 20


def test_a_fresh_complete_listing_proves_absence() -> None:
    dentries = make()
    put(dentries, b"/d", file(b"a"))
    assert dentries.absent_until(b"/d/b", 1) == 20
    assert dentries.absent_until(b"/d/a", 1) == 1
    assert dentries.absent_until(b"/e/a", 1) == 1


@pytest.mark.holds("promise 10")
def test_names_that_could_leave_the_tree_do_not_enter_it() -> None:
    dentries = make()
    hostile = [b"", b".", b"..", b"a/b", b"a\0b", b"ok", b"ok"]
    directory = put(dentries, b"/", *(file(name) for name in hostile))
    assert list(directory.entries) == [b"ok"]


@pytest.mark.holds("rule 14.27")
def test_sizes_and_times_are_clamped() -> None:
    directory = put(make(), b"/", file(b"a", 2**70, 2**70), file(b"b", -5, -5))
    assert directory.entries[b"a"] == file(b"a", MAX_SIZE, None)
    assert directory.entries[b"b"] == file(b"b", 0, None)
    assert tidy(file(b"c", 3, MAX_MTIME)) == file(b"c", 3, MAX_MTIME)
    assert tidy(file(b"c", None, 0)) == file(b"c", None, None)


def test_an_open_tells_a_size_until_the_next_listing() -> None:
    dentries = make()
    directory = put(dentries, b"/", file(b"a", 3, 99))
    dentries.learn_size(b"/a", 7)
    dentries.learn_size(b"/nobody", 7)
    dentries.learn_size(b"/d/a", 7)
    assert directory.size_of(b"a") == 7
    assert directory.entries[b"a"] == file(b"a", 3, 99)
    assert put(dentries, b"/", file(b"a", 4)).size_of(b"a") == 4


def test_least_recently_used_listings_go_first() -> None:
    dentries = make(max_entries=10)
    for name in (b"/1", b"/2", b"/3"):
        put(dentries, name, file(b"a"), file(b"b"))
    dentries.known(b"/1")
    put(dentries, b"/4", file(b"a"), file(b"b"))
    assert [dentries.known(p) is not None for p in (b"/1", b"/2", b"/3", b"/4")] == [True, False, True, True]
    assert len(dentries) == 3
    assert dentries.entry_count == 6


def test_the_newest_listing_stays_however_large() -> None:
    dentries = make(max_entries=5)
    put(dentries, b"/1", file(b"a"))
    put(dentries, b"/2", *(file(b"%d" % i) for i in range(50)))
    assert (len(dentries), dentries.entry_count) == (1, 50)
    put(dentries, b"/2", file(b"a"))
    assert (len(dentries), dentries.entry_count) == (1, 1)


# --- expiring and forgetting


def test_an_expired_listing_is_kept_but_proves_nothing() -> None:
    dentries = make()
    put(dentries, b"/", file(b"a"))
    dentries.expire(b"/", 3)
    dentries.expire(b"/unknown", 3)
    assert dentries.fresh(b"/", 3) is None
    assert names(dentries, b"/") == {b"a"}
    assert dentries.absent_until(b"/b", 3) == 3


def test_expire_all_covers_sweeps_and_absences() -> None:
    dentries = make()
    put(dentries, b"/", file(b"a"))
    dentries.note_absent(b"/x/y", 100)
    sweep = dentries.begin(b"/b", 1)
    dentries.expire_all(2)
    assert dentries.fresh(b"/", 2) is None
    assert dentries.absent_until(b"/x/y", 2) == 2
    directory = dentries.finish(sweep, Listing((file(b"c"),), 0), 3)
    assert set(directory.entries) == {b"c"}
    assert directory.fresh_until == 3
    assert dentries.known(b"/b") is None


def test_forget_takes_all_below_and_nothing_beside() -> None:
    dentries = make()
    for path in (b"/a", b"/a/b", b"/ab", b"/"):
        put(dentries, path, file(b"x"))
    dentries.note_absent(b"/a/q", 50)
    dentries.note_absent(b"/ab/q", 50)
    sweeps = [dentries.begin(path, 1) for path in (b"/a", b"/a/b", b"/ab")]
    dentries.forget(b"/a")
    assert [dentries.known(p) is not None for p in (b"/a", b"/a/b", b"/ab", b"/")] == [
        False,
        False,
        True,
        True,
    ]
    assert [sweep.void for sweep in sweeps] == [True, True, False]
    assert (dentries.absent_until(b"/a/q", 1), dentries.absent_until(b"/ab/q", 1)) == (1, 50)
    assert dentries.entry_count == 2
    dentries.forget(b"/")
    assert (len(dentries), dentries.entry_count) == (0, 0)


def test_probed_absences_are_bounded() -> None:
    dentries = make()
    for i in range(MAX_ABSENT):
        dentries.note_absent(b"/d/%d" % i, 100)
    dentries.note_absent(b"/d/0", 200)
    dentries.note_absent(b"/d/new", 100)
    assert dentries.absent_until(b"/d/0", 1) == 200
    assert dentries.absent_until(b"/d/1", 1) == 1
    assert dentries.absent_until(b"/d/2", 1) == 100


# --- our own changes


def test_created_and_removed_show_at_once() -> None:
    dentries = make()
    put(dentries, b"/", file(b"a"))
    dentries.note_absent(b"/b", 50)
    dentries.note_created(b"/b", file(b"b", 5))
    assert names(dentries, b"/") == {b"a", b"b"}
    assert dentries.absent_until(b"/b", 1) == 1
    assert dentries.entry_count == 2
    dentries.note_removed(b"/a")
    dentries.note_removed(b"/never")
    assert names(dentries, b"/") == {b"b"}
    assert dentries.entry_count == 1
    assert dentries.absent_until(b"/a", 1) == 20


def test_resized_replaces_size_mtime_and_what_an_open_told() -> None:
    dentries = make()
    directory = put(dentries, b"/", file(b"a", 1, 50))
    dentries.learn_size(b"/a", 2)
    dentries.note_resized(b"/a", 9)
    assert directory.entries[b"a"] == file(b"a", 9, None)
    assert directory.size_of(b"a") == 9
    dentries.note_resized(b"/a", 10, 60)
    assert directory.entries[b"a"] == file(b"a", 10, 60)


def test_rename_moves_the_entry_between_listings() -> None:
    dentries = make()
    put(dentries, b"/", folder(b"d"), folder(b"e"))
    put(dentries, b"/d", file(b"a", 7, 8))
    put(dentries, b"/e", file(b"b", 1))
    dentries.note_renamed(b"/d/a", b"/e/b")
    assert names(dentries, b"/d") == set()
    directory = dentries.known(b"/e")
    assert directory is not None
    assert directory.entries == {b"b": file(b"b", 7, 8)}


def test_rename_of_something_unknown_makes_the_target_directory_doubtful() -> None:
    dentries = make()
    put(dentries, b"/e", file(b"b"))
    put(dentries, b"/e/b", file(b"c"))
    dentries.note_absent(b"/e/b", 50)
    dentries.note_renamed(b"/d/a", b"/e/b")
    assert dentries.fresh(b"/e", 0) is None
    assert dentries.known(b"/e/b") is None
    assert dentries.absent_until(b"/e/b", 1) == 1


# --- the guard


def test_a_write_during_a_listing_beats_its_size_but_shifts_nothing() -> None:
    dentries = make()
    put(dentries, b"/", file(b"a", 1))
    sweep = dentries.begin(b"/", 30)
    dentries.note_resized(b"/a", 9)
    directory = dentries.finish(sweep, Listing((file(b"a", 1, 5),), 0), 31)
    assert directory.entries == {b"a": file(b"a", 9, None)}
    assert directory.complete
    assert dentries.fresh(b"/", 31) is directory


def test_what_an_unknown_file_took_the_place_of_is_not_taken_for_it() -> None:
    dentries = make()
    put(dentries, b"/d", file(b"a", 7, 70))
    dentries.note_renamed(b"/unknown", b"/d/a")
    directory = dentries.known(b"/d")
    assert directory is not None
    assert directory.entries[b"a"] == file(b"a", None, None)
    assert dentries.fresh(b"/d", 0.0) is None


# --- mtimes


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        (b"/fs/microsd/log/2024-05-01/12_34_56.ulg", 1714566896),
        (b"/log/2024-05-01/12_34_56_replayed.ulg", 1714566896),
        (b"/log/2024-05-01", 1714521600),
        (b"/log/2024-05-01/12_34_56.txt", UNKNOWN_MTIME),
        (b"/log/2024-05-01/12_34_56.ulg/x", UNKNOWN_MTIME),
        (b"/log/2024-05-01x", UNKNOWN_MTIME),
        (b"/log/sess001", UNKNOWN_MTIME),
        (b"/log/sess001/log100.ulg", UNKNOWN_MTIME),
        (b"/2024-05-01/12_34_56.ulg", UNKNOWN_MTIME),
        (b"/log/2024-13-01", UNKNOWN_MTIME),
        (b"/log/2024-00-01", UNKNOWN_MTIME),
        (b"/log/2024-01-32", UNKNOWN_MTIME),
        (b"/log/2024-01-00", UNKNOWN_MTIME),
        (b"/log/1970-01-01", UNKNOWN_MTIME),
        (b"/log/9999-01-01", MAX_MTIME),
        (b"/log/2024-05-01/24_00_00.ulg", UNKNOWN_MTIME),
        (b"/log/2024-05-01/00_60_00.ulg", UNKNOWN_MTIME),
        (b"/log/2024-05-01/00_00_60.ulg", UNKNOWN_MTIME),
        (b"/log/log/2024-05-01", 1714521600),
    ],
)
def test_log_paths_tell_their_time(path: bytes, expected: int) -> None:
    assert shown_mtime(path, None) == expected


def test_a_listed_mtime_beats_the_path() -> None:
    assert shown_mtime(b"/log/2024-05-01", 7) == 7
