"""Remembered listings: freshness, absence, bounds, and listings that race our own changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import pytest
import trio

from mavftpfs.cache.attributes import MAX_MTIME, MAX_SIZE, UNKNOWN_MTIME, shown_mtime, tidy
from mavftpfs.cache.directories import Directories, Directory
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.remote import RemoteStore
from mavftpfs.shared.model import DirEntry, EntryKind, Listing
from tests.support.clocks import HandClock


def file(name: bytes, size: int = 1, mtime: int | None = None) -> DirEntry:
    return DirEntry(name, EntryKind.FILE, size, mtime)


def folder(name: bytes) -> DirEntry:
    return DirEntry(name, EntryKind.DIRECTORY)


@pytest.fixture
def clock() -> HandClock:
    return HandClock()


def make(
    clock: Callable[[], float] = lambda: 0.0, *, dir_timeout: float | None = 20, max_entries: int = 1000
) -> Directories:
    options = CacheOptions(dir_timeout=dir_timeout, max_entries=max_entries)
    return Directories(cast(RemoteStore, None), options, clock=clock, nursery=cast(trio.Nursery, None))


def put(directories: Directories, path: bytes, *entries: DirEntry, took: float = 0) -> Directory:
    sweep = directories.begin(path)
    return directories.remember(sweep, Listing(entries, took))


def is_fresh(directories: Directories, path: bytes) -> bool:
    directory = directories.known(path)
    return directory is not None and directories.clock() < directory.fresh_until


def names(directories: Directories, path: bytes) -> set[bytes]:
    directory = directories.known(path)
    return set(directory.entries) if directory else {b"(unknown)"}


@pytest.mark.parametrize(("dir_timeout", "took", "life"), [(20, 9, 20), (None, 0.1, 20), (None, 2, 100)])
def test_a_listing_is_fresh_for_dir_timeout_or_as_long_as_it_was_expensive(
    clock: HandClock, dir_timeout: float | None, took: float, life: float
) -> None:
    directories = make(clock, dir_timeout=dir_timeout)
    clock.now = 5
    directory = put(directories, b"/", file(b"a"), took=took)
    clock.now += life - 0.1
    assert is_fresh(directories, b"/")
    clock.now += 0.1
    assert not is_fresh(directories, b"/")
    assert directories.known(b"/") is directory
    assert directories.known(b"/b") is None


def test_a_dir_timeout_that_a_user_set_is_the_bound() -> None:
    directories = make(dir_timeout=0)
    put(directories, b"/", took=2)
    assert not is_fresh(directories, b"/")


@pytest.mark.holds("promise 10")
def test_names_that_could_leave_the_tree_do_not_enter_it() -> None:
    directories = make()
    hostile = [b"", b".", b"..", b"a/b", b"a\0b", b"ok", b"ok"]
    directory = put(directories, b"/", *(file(name) for name in hostile))
    assert list(directory.entries) == [b"ok"]


@pytest.mark.holds("rule 14.27")
def test_sizes_and_times_are_clamped() -> None:
    directory = put(make(), b"/", file(b"a", 2**70, 2**70), file(b"b", 0, -5))
    assert directory.entries[b"a"] == file(b"a", MAX_SIZE, None)
    assert directory.entries[b"b"] == file(b"b", 0, None)
    assert tidy(file(b"c", 3, MAX_MTIME)) == file(b"c", 3, MAX_MTIME)
    assert tidy(file(b"c", 5, 0)) == file(b"c", 5, None)


def test_an_open_tells_a_size_until_the_next_listing() -> None:
    directories = make()
    directory = put(directories, b"/", file(b"a", 3, 99))
    directories.learn_size(b"/a", 7)
    directories.learn_size(b"/nobody", 7)
    directories.learn_size(b"/d/a", 7)
    assert directory.size_of(b"a") == 7
    assert directory.entries[b"a"] == file(b"a", 3, 99)
    assert put(directories, b"/", file(b"a", 4)).size_of(b"a") == 4


def test_least_recently_used_listings_go_first() -> None:
    directories = make(max_entries=10)
    for name in (b"/1", b"/2", b"/3"):
        put(directories, name, file(b"a"), file(b"b"))
    directories.known(b"/1")
    put(directories, b"/4", file(b"a"), file(b"b"))
    assert [directories.known(p) is not None for p in (b"/1", b"/2", b"/3", b"/4")] == [
        True,
        False,
        True,
        True,
    ]
    assert len(directories._recent) == 3
    assert directories.entry_count == 6


# --- expiring and forgetting


def test_forget_takes_all_below_and_nothing_beside() -> None:
    directories = make()
    for path in (b"/a", b"/a/b", b"/ab", b"/"):
        put(directories, path, file(b"x"))
    sweeps = [directories.begin(path) for path in (b"/a", b"/a/b", b"/ab")]
    directories.forget(b"/a")
    assert [directories.known(p) is not None for p in (b"/a", b"/a/b", b"/ab", b"/")] == [
        False,
        False,
        True,
        True,
    ]
    assert [sweep.void for sweep in sweeps] == [True, True, False]
    assert directories.entry_count == 2
    directories.forget(b"/")
    assert (len(directories._recent), directories.entry_count) == (0, 0)


# --- our own changes


def test_what_we_changed_shows_at_once() -> None:
    directories = make()
    put(directories, b"/", file(b"a", 1, 50))
    put(directories, b"/b", file(b"x"))
    directories.learn_size(b"/a", 2)
    directories.put(b"/a", file(b"a", 9))
    directories.put(b"/b", folder(b"another name"))
    directory = directories.known(b"/")
    assert directory is not None
    assert directory.entries == {b"a": file(b"a", 9), b"b": folder(b"b")}
    assert directory.size_of(b"a") == 9
    assert directories.known(b"/b") is None
    assert directories.entry(b"/b") == folder(b"b")
    directories.put(b"/a", None)
    directories.put(b"/never", None)
    assert names(directories, b"/") == {b"b"}
    assert directories.entry(b"/a") is None


@pytest.mark.holds("fault odd listing")
def test_a_change_during_a_listing_beats_what_it_saw_and_lets_it_expire() -> None:
    directories = make()
    sweep = directories.begin(b"/")
    directories.put(b"/a", file(b"a", 9))
    directories.put(b"/b", None)
    directory = directories.remember(sweep, Listing((file(b"a", 1, 5), file(b"b"), file(b"c")), 0))
    assert directory.entries == {b"a": file(b"a", 9), b"c": file(b"c")}
    assert (directory.complete, directory.fresh_until) == (True, 0)


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
    assert shown_mtime(path, None) == expected * 10**9
