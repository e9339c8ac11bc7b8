"""Remembered listings. Layer: cache; pure: the time comes from a clock (seconds, monotonic).

There is no stat on the wire (servers.md 14.30): everything known of a path comes from its parent's
listing. A listing is fresh for a while; a name that a fresh and complete one lacks does not exist.
Expired listings are kept to be served while the vehicle is out of reach.

A listing takes many requests, and a change made by us meanwhile may show in it or not. So each sweep under
way is a `Sweep` in which every change of ours is written down, and what was written down beats what the sweep
saw. The entries behind a changed name shifted between the sweep's pages (servers.md 6, "Concurrent change"):
so the result is incomplete and expires at once.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from mavftpfs.cache.attributes import tidy
from mavftpfs.shared.model import DirEntry, Listing, split, usable_name

DIR_TIMEOUT = 20.0
"""Seconds that a listing is fresh where the user did not say it."""

COST_FACTOR = 50
"""A listing that took T seconds is fresh for at least COST_FACTOR * T: it costs at most 2 % of the link."""

STILL_GROWING = 30.0
"""A file that was seen to grow is taken to be open on the vehicle for so many seconds."""


@dataclass(slots=True)
class Directory:
    """A remembered listing.

    entries: by name, as listed. listed_at: when the sweep began, ended_at: when it was done; fresh_until:
    after that it proves nothing. complete: whether a name that is not in it is absent. cut_short: the vehicle
    did not list it to its end.
    sizes: what opening told about an entry since, which beats the listing. growing: when a file was last seen
    to be larger than before, though we did not write it. proven: when the vehicle last confirmed that we gave
    a name to what is listed there.
    """

    entries: dict[bytes, DirEntry]
    listed_at: float
    ended_at: float
    fresh_until: float
    complete: bool
    cut_short: bool
    sizes: dict[bytes, int] = field(default_factory=dict)
    growing: dict[bytes, float] = field(default_factory=dict)
    proven: dict[bytes, float] = field(default_factory=dict)

    def size_of(self, name: bytes) -> int | None:
        """Return the best known size of a listed name in bytes, None if nothing told it."""
        return self.sizes.get(name, self.entries[name].size)


@dataclass(slots=True, eq=False)
class Sweep:
    """A listing under way.

    changes: what we changed in that directory since it began. void: it is in doubt, or not wanted any more.
    """

    path: bytes
    began: float
    changes: dict[bytes, DirEntry | None] = field(default_factory=dict)
    void: bool = False


class Dentries:
    """Listings by path, least recently used ones dropped when more than `max_entries` names are held."""

    def __init__(self, *, clock: Callable[[], float], dir_timeout: float | None, max_entries: int) -> None:
        """`dir_timeout`: seconds that a listing is fresh; None: DIR_TIMEOUT, or longer if it took long."""
        self.clock = clock
        self._dir_timeout = dir_timeout
        self._max_entries = max_entries
        self._directories: OrderedDict[bytes, Directory] = OrderedDict()
        self._sweeps: dict[bytes, Sweep] = {}

    def __len__(self) -> int:
        return len(self._directories)

    @property
    def entry_count(self) -> int:
        """Names remembered over all listings."""
        return sum(len(directory.entries) for directory in self._directories.values())

    # --- asking

    def known(self, path: bytes) -> Directory | None:
        """Return the directory's listing, expired or not."""
        directory = self._directories.get(path)
        if directory is not None:
            self._directories.move_to_end(path)
        return directory

    def fresh(self, path: bytes) -> Directory | None:
        """Return the directory's listing if it still proves something."""
        directory = self.known(path)
        return directory if directory is not None and self.clock() < directory.fresh_until else None

    def entry(self, path: bytes) -> DirEntry | None:
        """Return what a path was last known to be: our change is newer than a listing under way."""
        parent, name = split(path)
        sweep = self._sweeps.get(parent)
        if sweep is not None and name in sweep.changes:
            return sweep.changes[name]
        directory = self._directories.get(parent)
        return None if directory is None else directory.entries.get(name)

    def is_growing(self, path: bytes) -> bool:
        """Return whether somebody on the vehicle seems to write the file."""
        parent, name = split(path)
        directory = self._directories.get(parent)
        if directory is None or name not in directory.growing:
            return False
        return self.clock() - directory.growing[name] < STILL_GROWING

    # --- listing

    def begin(self, path: bytes) -> Sweep:
        """Note that a listing of `path` starts; `end` must follow. One at a time of each directory."""
        sweep = self._sweeps[path] = Sweep(path, self.clock())
        return sweep

    def end(self, sweep: Sweep) -> None:
        """The listing is done, failed or cancelled."""
        del self._sweeps[sweep.path]

    def remember(self, sweep: Sweep, listing: Listing) -> Directory:
        """Remember a listing and return it, our own changes applied."""
        now = self.clock()
        entries = {entry.name: tidy(entry) for entry in listing.entries if usable_name(entry.name)}
        for name, entry in sweep.changes.items():
            entries.pop(name, None)
            if entry is not None:
                entries[name] = entry
        life = self._dir_timeout
        if life is None:
            life = max(DIR_TIMEOUT, COST_FACTOR * listing.took)
        if sweep.changes or sweep.void:
            life = 0.0
        complete = listing.complete and not sweep.changes
        directory = Directory(entries, sweep.began, now, now + life, complete, not listing.complete)
        old = self._directories.get(sweep.path)
        if old is not None:
            _see_growth(old, directory, sweep)
        if not sweep.void:
            self._directories[sweep.path] = directory
            self._directories.move_to_end(sweep.path)
            self._make_room()
        return directory

    def expire(self, path: bytes) -> None:
        """The listing of `path` is in doubt: it proves nothing any more, but may be served stale."""
        sweep, directory = self._sweeps.get(path), self._directories.get(path)
        if sweep is not None:
            sweep.void = True
        if directory is not None:
            directory.fresh_until = min(directory.fresh_until, self.clock())
            directory.proven.clear()

    def expire_all(self) -> None:
        """Everything is in doubt (the vehicle rebooted)."""
        for path in self._directories.keys() | self._sweeps.keys():
            self.expire(path)

    def forget(self, path: bytes) -> None:
        """Drop the listings of `path` and of all below it."""
        below = path.rstrip(b"/") + b"/"
        for known in list(self._directories):
            if known == path or known.startswith(below):
                del self._directories[known]
        for known, sweep in self._sweeps.items():
            if known == path or known.startswith(below):
                sweep.void = True

    # --- what else is learnt

    def learn_size(self, path: bytes, size: int) -> None:
        """An open told the size: it beats the listing until the next one. If it is larger, the file grows."""
        parent, name = split(path)
        directory = self._directories.get(parent)
        if directory is None or name not in directory.entries:
            return
        before = directory.size_of(name)
        directory.sizes[name] = size
        if before is not None and size > before:
            directory.growing[name] = self.clock()

    def learn_found(self, path: bytes, entry: DirEntry) -> None:
        """An open found a file that its directory's incomplete listing lacks."""
        parent, name = split(path)
        if parent in self._directories:
            self._directories[parent].entries.setdefault(name, entry)

    def put(self, path: bytes, entry: DirEntry | None, *, proven: bool = False) -> None:
        """We made, wrote, renamed or removed (None) what has this name; what lies below is to be listed anew.

        proven: the vehicle said just now that the name is this.
        """
        self.forget(path)
        parent, name = split(path)
        if entry is not None and entry.name != name:
            entry = replace(entry, name=name)
        sweep = self._sweeps.get(parent)
        if sweep is not None:
            sweep.changes[name] = entry
        directory = self._directories.get(parent)
        if directory is None:
            return
        for facts in (directory.entries, directory.sizes, directory.growing, directory.proven):
            facts.pop(name, None)
        if entry is not None:
            directory.entries[name] = entry
            if proven:
                directory.proven[name] = self.clock()

    def rename(self, old: bytes, new: bytes) -> None:
        """We renamed something, perhaps over something else, and the vehicle just said so."""
        entry = self.entry(old)
        self.put(old, None)
        self.put(new, entry, proven=True)
        if entry is None:
            self.expire(split(new)[0])

    def _make_room(self) -> None:
        weight = len(self._directories) + self.entry_count
        while weight > self._max_entries and len(self._directories) > 1:
            weight -= 1 + len(self._directories.popitem(last=False)[1].entries)


def _see_growth(old: Directory, new: Directory, sweep: Sweep) -> None:
    """Note which files grew since the last listing without us, or did a short while ago."""
    for name in new.entries.keys() & old.entries.keys() - sweep.changes.keys():
        before, after = old.size_of(name), new.size_of(name)
        if before is not None and after is not None and after > before:
            new.growing[name] = new.ended_at
        elif name in old.growing:
            new.growing[name] = old.growing[name]
