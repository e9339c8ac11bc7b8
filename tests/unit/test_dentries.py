"""Remembered listings: freshness, absence, bounds, and listings that race our own changes."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from mavftpfs.cache.attributes import MAX_MTIME, MAX_SIZE, UNKNOWN_MTIME, shown_mtime, tidy
from mavftpfs.cache.dentries import Dentries, Directory
from mavftpfs.shared.model import DirEntry, EntryKind, Listing


def file(name: bytes, size: int | None = 1, mtime: int | None = None) -> DirEntry:
    return DirEntry(name, EntryKind.FILE, size, mtime)


def folder(name: bytes) -> DirEntry:
    return DirEntry(name, EntryKind.DIRECTORY)


class Clock:
    """Time that passes when a test says so."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def make(
    clock: Callable[[], float] = lambda: 0.0, *, dir_timeout: float | None = 20, max_entries: int = 1000
) -> Dentries:
    return Dentries(clock=clock, dir_timeout=dir_timeout, max_entries=max_entries)


def put(dentries: Dentries, path: bytes, *entries: DirEntry, took: float = 0) -> Directory:
    sweep = dentries.begin(path)
    dentries.end(sweep)
    return dentries.remember(sweep, Listing(entries, took))


def names(dentries: Dentries, path: bytes) -> set[bytes]:
    directory = dentries.known(path)
    return set(directory.entries) if directory else {b"(unknown)"}


@pytest.mark.parametrize(("dir_timeout", "took", "life"), [(20, 9, 20), (None, 0.1, 20), (None, 2, 100)])
def test_a_listing_is_fresh_for_dir_timeout_or_as_long_as_it_was_expensive(
    clock: Clock, dir_timeout: float | None, took: float, life: float
) -> None:
    dentries = make(clock, dir_timeout=dir_timeout)
    clock.now = 5
    directory = put(dentries, b"/", file(b"a"), took=took)
    clock.now += life - 0.1
    assert dentries.fresh(b"/") is directory
    clock.now += 0.1
    assert dentries.fresh(b"/") is None
    assert dentries.known(b"/") is directory
    assert dentries.known(b"/b") is None


def test_a_dir_timeout_that_a_user_set_is_the_bound() -> None:
    dentries = make(dir_timeout=0)
    put(dentries, b"/", took=2)
    assert dentries.fresh(b"/") is None


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


# --- expiring and forgetting


def test_an_expired_listing_is_kept_but_proves_nothing() -> None:
    dentries = make()
    put(dentries, b"/", file(b"a"))
    dentries.expire(b"/")
    dentries.expire(b"/unknown")
    assert dentries.fresh(b"/") is None
    assert names(dentries, b"/") == {b"a"}


def test_forget_takes_all_below_and_nothing_beside() -> None:
    dentries = make()
    for path in (b"/a", b"/a/b", b"/ab", b"/"):
        put(dentries, path, file(b"x"))
    sweeps = [dentries.begin(path) for path in (b"/a", b"/a/b", b"/ab")]
    dentries.forget(b"/a")
    assert [dentries.known(p) is not None for p in (b"/a", b"/a/b", b"/ab", b"/")] == [
        False,
        False,
        True,
        True,
    ]
    assert [sweep.void for sweep in sweeps] == [True, True, False]
    assert dentries.entry_count == 2
    dentries.forget(b"/")
    assert (len(dentries), dentries.entry_count) == (0, 0)


# --- our own changes


def test_what_we_changed_shows_at_once() -> None:
    dentries = make()
    put(dentries, b"/", file(b"a", 1, 50))
    put(dentries, b"/b", file(b"x"))
    dentries.learn_size(b"/a", 2)
    dentries.put(b"/a", file(b"a", 9))
    dentries.put(b"/b", folder(b"another name"))
    directory = dentries.known(b"/")
    assert directory is not None
    assert directory.entries == {b"a": file(b"a", 9), b"b": folder(b"b")}
    assert directory.size_of(b"a") == 9
    assert dentries.known(b"/b") is None
    assert dentries.entry(b"/b") == folder(b"b")
    dentries.put(b"/a", None)
    dentries.put(b"/never", None)
    assert names(dentries, b"/") == {b"b"}
    assert dentries.entry(b"/a") is None


def test_what_the_vehicle_confirmed_is_proven_until_it_is_in_doubt(clock: Clock) -> None:
    dentries = make(clock)
    directory = put(dentries, b"/")
    clock.now = 3
    dentries.put(b"/a", file(b"a"))
    assert directory.proven == {}
    dentries.put(b"/a", file(b"a"), proven=True)
    assert directory.proven == {b"a": 3}
    dentries.expire(b"/")
    assert directory.proven == {}


@pytest.mark.holds("fault odd listing")
def test_a_change_during_a_listing_beats_what_it_saw_and_leaves_it_incomplete() -> None:
    dentries = make()
    sweep = dentries.begin(b"/")
    dentries.put(b"/a", file(b"a", 9))
    dentries.put(b"/b", None)
    assert dentries.entry(b"/a") == file(b"a", 9)
    directory = dentries.remember(sweep, Listing((file(b"a", 1, 5), file(b"b"), file(b"c")), 0))
    assert directory.entries == {b"a": file(b"a", 9), b"c": file(b"c")}
    assert (directory.complete, directory.cut_short, directory.fresh_until) == (False, False, 0)


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
