"""Remembered listings against the directories themselves, with sweeps that our own changes race.

Nobody but us changes the directories, so a listing that claims to be fresh and complete must equal them:
whatever a sweep saw of one page before a change and of the next one after it.
"""

from __future__ import annotations

from typing import cast

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from mavftpfs.cache.directories import Directories, Sweep
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.remote import RemoteStore
from mavftpfs.shared.model import DirEntry, EntryKind, Listing, join, split

DIRECTORIES = (b"/", b"/d", b"/e")
NAMES = (b"a", b"b", b"c", b"x")
PAGE = 2

directories = st.sampled_from(DIRECTORIES)
names = st.sampled_from(NAMES)
sizes = st.integers(0, 3)


class Paging:
    """A sweep that asks for PAGE entries at a time, by index, as servers answer."""

    def __init__(self, sweep: Sweep) -> None:
        self.sweep = sweep
        self.seen: dict[bytes, DirEntry] = {}
        self.index = 0


class Racing(RuleBasedStateMachine):
    """Sweeps, changes on the vehicle, and the notes of them, in any order that can happen."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        options = CacheOptions(dir_timeout=20, max_entries=9)
        self.directories = Directories(cast(RemoteStore, None), options, clock=lambda: self.now)
        self.truth: dict[bytes, dict[bytes, DirEntry]] = {path: {} for path in DIRECTORIES}
        self.sweeps: list[Paging] = []
        self.unnoted: list[tuple[str, bytes, bytes, int]] = []

    # --- sweeps

    @rule(path=directories)
    def begin(self, path: bytes) -> None:
        if path not in [paging.sweep.path for paging in self.sweeps]:
            self.sweeps.append(Paging(self.directories.begin(path)))

    @precondition(lambda self: self.sweeps)
    @rule(data=st.data())
    def next_page(self, data: st.DataObject) -> None:
        paging = data.draw(st.sampled_from(self.sweeps))
        entries = list(self.truth[paging.sweep.path].values())[paging.index : paging.index + PAGE]
        paging.index += PAGE
        paging.seen.update((entry.name, entry) for entry in entries)
        if not entries:
            self.sweeps.remove(paging)
            listing = Listing(tuple(paging.seen.values()), 0.0)
            del self.directories._sweeps[paging.sweep.path]
            directory = self.directories.remember(paging.sweep, listing)
            assert directory.listed_at == paging.sweep.began

    @precondition(lambda self: self.sweeps)
    @rule(data=st.data())
    def abandon(self, data: st.DataObject) -> None:
        paging = data.draw(st.sampled_from(self.sweeps))
        self.sweeps.remove(paging)
        del self.directories._sweeps[paging.sweep.path]

    @rule(seconds=st.sampled_from([1.0, 19.0, 21.0]))
    def wait(self, seconds: float) -> None:
        self.now += seconds

    @rule(path=directories)
    def expire(self, path: bytes) -> None:
        self.directories.expire(path)

    @rule(path=directories)
    def forget(self, path: bytes) -> None:
        self.directories.forget(path)

    # --- changes: the vehicle makes them first, we note them when the answer comes

    @precondition(lambda self: not self.unnoted)
    @rule(path=directories, name=names, size=sizes)
    def create(self, path: bytes, name: bytes, size: int) -> None:
        if name not in self.truth[path]:
            self.truth[path][name] = DirEntry(name, EntryKind.FILE, size)
            self.unnoted.append(("create", join(path, name), b"", size))

    @precondition(lambda self: not self.unnoted)
    @rule(path=directories, name=names)
    def remove(self, path: bytes, name: bytes) -> None:
        if self.truth[path].pop(name, None) is not None:
            self.unnoted.append(("remove", join(path, name), b"", 0))

    @precondition(lambda self: not self.unnoted)
    @rule(path=directories, name=names, size=sizes)
    def resize(self, path: bytes, name: bytes, size: int) -> None:
        if name in self.truth[path]:
            self.truth[path][name] = DirEntry(name, EntryKind.FILE, size)
            self.unnoted.append(("resize", join(path, name), b"", size))

    @precondition(lambda self: not self.unnoted)
    @rule(old=directories, name=names, new=directories, other=names)
    def rename(self, old: bytes, name: bytes, new: bytes, other: bytes) -> None:
        if name in self.truth[old] and (old, name) != (new, other):
            entry = self.truth[old].pop(name)
            self.truth[new].pop(other, None)
            self.truth[new][other] = DirEntry(other, EntryKind.FILE, entry.size)
            self.unnoted.append(("rename", join(old, name), join(new, other), 0))

    @precondition(lambda self: self.unnoted)
    @rule()
    def note(self) -> None:
        what, path, new, size = self.unnoted.pop()
        if what == "create":
            name = path.rpartition(b"/")[2]
            self.directories.put(path, DirEntry(name, EntryKind.FILE, size))
        elif what == "remove":
            self.directories.put(path, None)
        elif what == "resize":
            self.directories.put(path, DirEntry(split(path)[1], EntryKind.FILE, size), proven=True)
        else:
            self.directories.rename(path, new)

    # --- what must hold

    @invariant()
    def fresh_is_true(self) -> None:
        if self.unnoted:
            return
        for path in DIRECTORIES:
            directory = self.directories.known(path)
            if directory is not None and self.directories.clock() < directory.fresh_until:
                assert directory.complete
                assert directory.entries == self.truth[path]

    @invariant()
    def proven_is_true(self) -> None:
        if self.unnoted:
            return
        for path in DIRECTORIES:
            directory = self.directories.known(path)
            for name in () if directory is None else directory.proven:
                assert self.directories.entry(join(path, name)) == self.truth[path][name]

    @invariant()
    def memory_is_bounded(self) -> None:
        known = [d for d in (self.directories._known.get(p) for p in DIRECTORIES) if d is not None]
        assert self.directories.entry_count == sum(len(directory.entries) for directory in known)
        assert len(self.directories) == len(known)


TestRacing = Racing.TestCase
TestRacing.settings = settings(max_examples=150, stateful_step_count=40)
