"""Remembered listings against the directories themselves, with sweeps that our own changes race.

What others change is told at once, so a listing that claims to be fresh and complete must equal the
directory: whatever a sweep saw of one page before a change and of the next one after it.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from random import Random
from typing import cast

import trio
from hypothesis import given, settings
from hypothesis import strategies as st

from mavftpfs.cache.directories import Directories
from mavftpfs.cache.items import Directory, Folder, Sweep
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.remote import RemoteStore
from mavftpfs.shared.model import DirEntry, EntryKind, Listing, join

DIRECTORIES = (b"/", b"/d")
NAMES = (b"a", b"b", b"c")


def file(name: bytes, size: int) -> DirEntry:
    return DirEntry(name, EntryKind.FILE, size)


class Paging:
    """A sweep that asks for one entry at a time, by index, as servers answer."""

    def __init__(self, sweep: Sweep) -> None:
        self.sweep = sweep
        self.seen: dict[bytes, DirEntry] = {}
        self.index = 0


class Racing:
    """Sweeps, changes on the vehicle, and the notes of them, in any order that can happen."""

    def __init__(self, rng: Random) -> None:
        self.rng = rng
        self.now = 0.0
        options = CacheOptions(dir_timeout=20, max_entries=rng.choice([5, 100]))
        store, nursery = cast(RemoteStore, None), cast(trio.Nursery, None)
        self.directories = Directories(store, options, clock=lambda: self.now, nursery=nursery)
        self.truth = {path: {name: file(name, 1) for name in NAMES[:2]} for path in DIRECTORIES}
        self.sweeps: dict[bytes, Paging] = {}
        self.unnoted: tuple[bytes, DirEntry | None, bytes] | None = None
        self.under_way = ExitStack()

    def step(self) -> None:
        self.now += 0.01
        acts = [self.sweep_on, self.sweep_on, self.put, self.rename, self.note, self.disturb]
        self.rng.choice(acts)(self.rng.choice(DIRECTORIES))
        if self.unnoted is None:
            for path in DIRECTORIES:
                self.check(path)
        assert self.directories.entry_count == sum(len(known.entries) for known in self.known())

    def known(self) -> list[Directory]:
        """Return all remembered listings."""
        root = self.directories.root
        folders = [one for one in (root, *root.walk()) if isinstance(one, Folder)]
        return [folder.listing for folder in folders if folder.listing is not None]

    # --- sweeps

    def sweep_on(self, path: bytes) -> None:
        """Have a sweep begin, or get its next page."""
        if path not in self.sweeps:
            self.sweeps[path] = Paging(self.directories.begin(path))
        paging = self.sweeps[path]
        page = list(self.truth[path].values())[paging.index : paging.index + 1]
        paging.index += 1
        paging.seen.update((entry.name, entry) for entry in page)
        if not page:
            self.abandon(path)
            directory = self.directories.remember(paging.sweep, Listing(tuple(paging.seen.values()), 0.0))
            assert directory.listed_at == paging.sweep.began

    def abandon(self, path: bytes) -> None:
        paging = self.sweeps.pop(path, None)
        if paging is not None:
            self.directories.end(paging.sweep)

    def disturb(self, path: bytes) -> None:
        match self.rng.randrange(8):
            case 0:
                self.others_change(path, self.directories.forget)
            case 1 | 2:
                self.others_change(path, self.directories.expire)
            case 3:
                self.abandon(path)
            case _:
                self.now += self.rng.choice([1.0, 19.0, 21.0])

    def others_change(self, path: bytes, tell: Callable[[bytes], None]) -> None:
        """Have others change a directory, as is told at once."""
        self.note(path)
        name = self.rng.choice(NAMES)
        if self.truth[path].pop(name, None) is None:
            self.truth[path][name] = file(name, 7)
        tell(path)

    # --- changes: the vehicle makes them first, we note them when the answer comes

    def put(self, path: bytes) -> None:
        """Make a file, change its size, or remove it."""
        self.note(path)
        name, size = self.rng.choice(NAMES), self.rng.randrange(-1, 3)
        if size < 0:
            self.truth[path].pop(name, None)
        else:
            self.truth[path][name] = file(name, size)
        self.change(join(path, name), self.truth[path].get(name))

    def rename(self, path: bytes) -> None:
        """Rename what was just looked up."""
        self.note(path)
        if not self.is_fresh(path):
            return
        name, new, other = self.rng.choice(NAMES), self.rng.choice(DIRECTORIES), self.rng.choice(NAMES)
        if name in self.truth[path] and (path, name) != (new, other):
            entry = self.truth[path].pop(name)
            self.truth[new].pop(other, None)
            self.truth[new][other] = file(other, entry.size)
            self.change(join(path, name), None, join(new, other))

    def change(self, path: bytes, entry: DirEntry | None, new: bytes = b"") -> None:
        self.under_way.enter_context(self.directories.changing(path, *[new] * bool(new)))
        self.unnoted = (path, entry, new)

    def note(self, _: bytes) -> None:
        if self.unnoted is None:
            return
        (path, entry, new), self.unnoted = self.unnoted, None
        self.under_way.close()
        if new:
            self.directories.rename(path, new)
        else:
            self.directories.put(path, entry)
        assert self.directories.entry(new or path) in (None, self.true_entry(new or path))

    # --- what must hold

    def true_entry(self, path: bytes) -> DirEntry | None:
        parent, _, name = path.rpartition(b"/")
        return self.truth[parent or b"/"].get(name)

    def is_fresh(self, path: bytes) -> bool:
        directory = self.directories.known(path)
        return directory is not None and self.now < directory.fresh_until

    def check(self, path: bytes) -> None:
        """A fresh listing is true."""
        directory = self.directories.known(path)
        if directory is not None and self.is_fresh(path):
            assert directory.complete
            assert directory.entries == self.truth[path]


@settings(max_examples=200)
@given(st.integers(0, 2**32))
def test_a_fresh_listing_is_the_directory(seed: int) -> None:
    racing = Racing(Random(seed))
    for _ in range(100):
        racing.step()
