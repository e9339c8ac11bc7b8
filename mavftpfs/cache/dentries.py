"""Remembered listings. Layer: cache; pure: the time is an argument (`now`, seconds of a monotonic clock).

There is no stat on the wire (servers.md 14.30): everything known of a path comes from its parent's
listing. A listing is fresh for a while; a name that a fresh and complete one lacks does not exist.
Expired listings are kept to be served while the vehicle is out of reach.

The generation guard: a listing takes many requests, and a change made by us meanwhile may show in it or
not. Each sweep under way is a `Sweep`, every `note_...` is written down in it, and what was written down
beats what the sweep saw. If names came or went, the entries behind them shifted between the sweep's pages
(servers.md 6, "Concurrent change"): then the result is incomplete and expires at once.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field, replace

from mavftpfs.cache.attributes import tidy
from mavftpfs.shared.model import DirEntry, EntryKind, Listing, folded, split, usable_name

DIR_TIMEOUT = 20.0
"""Seconds that a listing is fresh where the user did not say it."""

COST_FACTOR = 50
"""A listing that took T seconds is fresh for at least COST_FACTOR * T: it costs at most 2 % of the link."""

STILL_GROWING = 30.0
"""A file that was seen to grow is taken to be open on the vehicle for so many seconds."""

MAX_ABSENT = 4096
"""How many single absences (found by probing, not by a listing) are remembered."""


@dataclass(slots=True)
class Directory:
    """A remembered listing.

    entries: by name, as listed. sizes: what opening told about an entry since, which beats the listing.
    growing: when a file was last seen to be larger than before, though we did not write it.
    listed_at: when the sweep began, ended_at: when it was done; fresh_until: after that it proves nothing.
    proven: when an entry was last shown to be what it is by other means than this listing.
    complete: whether a name that is not in it is absent. cut_short: the vehicle did not list it to its end.
    """

    entries: dict[bytes, DirEntry]
    listed_at: float
    fresh_until: float
    complete: bool
    sizes: dict[bytes, int] = field(default_factory=dict)
    growing: dict[bytes, float] = field(default_factory=dict)
    ended_at: float = float("-inf")
    proven: dict[bytes, float] = field(default_factory=dict)
    cut_short: bool = False

    def size_of(self, name: bytes) -> int | None:
        """Return the best known size of a listed name in bytes, None if nothing told it."""
        return self.sizes.get(name, self.entries[name].size)

    @property
    def weight(self) -> int:
        """What it counts against the bound on remembered entries."""
        return 1 + len(self.entries)


@dataclass(slots=True, eq=False)
class Sweep:
    """A listing under way: what we changed in that directory since it began."""

    path: bytes
    began: float
    changes: dict[bytes, DirEntry | None] = field(default_factory=dict)
    reshaped: bool = False
    void: bool = False


class Dentries:
    """Listings by path, least recently used ones dropped when more than `max_entries` names are held."""

    def __init__(self, *, dir_timeout: float | None, max_entries: int) -> None:
        """`dir_timeout`: seconds that a listing is fresh; None: DIR_TIMEOUT, or longer if it took long."""
        self._dir_timeout = dir_timeout
        self._max_entries = max_entries
        self._directories: OrderedDict[bytes, Directory] = OrderedDict()
        self._weight = 0
        self._sweeps: dict[bytes, list[Sweep]] = {}
        self._absent: OrderedDict[bytes, float] = OrderedDict()

    def __len__(self) -> int:
        return len(self._directories)

    @property
    def entry_count(self) -> int:
        """Names remembered over all listings."""
        return self._weight - len(self._directories)

    # --- asking

    def fresh(self, path: bytes, now: float) -> Directory | None:
        """Return the directory's listing if it still proves something."""
        directory = self.known(path)
        return directory if directory is not None and now < directory.fresh_until else None

    def known(self, path: bytes) -> Directory | None:
        """Return the directory's listing however old it is."""
        directory = self._directories.get(path)
        if directory is not None:
            self._directories.move_to_end(path)
        return directory

    def absent_until(self, path: bytes, now: float) -> float:
        """Return until when the path is known not to exist; `now` or less means it is not known."""
        until = self._absent.get(path, now)
        parent, name = split(path)
        directory = self._directories.get(parent)
        if name and directory is not None and directory.complete and name not in directory.entries:
            until = max(until, directory.fresh_until)
        return until

    # --- listing

    def begin(self, path: bytes, now: float) -> Sweep:
        """Note that a listing of `path` starts; `finish` or `abandon` must follow."""
        sweep = Sweep(path, now)
        self._sweeps.setdefault(path, []).append(sweep)
        return sweep

    def abandon(self, sweep: Sweep) -> None:
        """The listing failed or was cancelled."""
        sweeps = self._sweeps[sweep.path]
        sweeps.remove(sweep)
        if not sweeps:
            del self._sweeps[sweep.path]

    def finish(self, sweep: Sweep, listing: Listing, now: float) -> Directory:
        """Remember a listing and return it, local changes applied."""
        self.abandon(sweep)
        entries = {entry.name: tidy(entry) for entry in listing.entries if usable_name(entry.name)}
        for name, entry in sweep.changes.items():
            _put(entries, name, entry)
        complete = listing.complete and not sweep.reshaped
        life = self._dir_timeout
        if life is None:
            life = max(DIR_TIMEOUT, COST_FACTOR * listing.took)
        doubtful = sweep.reshaped or sweep.void
        directory = Directory(entries, sweep.began, now if doubtful else now + life, complete)
        directory.cut_short = not listing.complete
        directory.growing, directory.ended_at = self._growing(sweep, directory, now), now
        if not sweep.void:
            self._store(sweep.path, directory)
        return directory

    def expire(self, path: bytes, now: float) -> None:
        """The listing of `path` is in doubt: it proves nothing any more, but may be served stale."""
        for sweep in self._sweeps.get(path, ()):
            sweep.void = True
        directory = self._directories.get(path)
        if directory is not None:
            directory.fresh_until = min(directory.fresh_until, now)

    def expire_all(self, now: float) -> None:
        """Everything is in doubt (the vehicle rebooted)."""
        self._absent.clear()
        for path in self._directories.keys() | self._sweeps.keys():
            self.expire(path, now)

    def forget(self, path: bytes) -> None:
        """Drop the listings of `path` and of all below it."""
        below = path.rstrip(b"/") + b"/"
        for known in [p for p in self._directories if p == path or p.startswith(below)]:
            self._weight -= self._directories.pop(known).weight
        for known, sweeps in self._sweeps.items():
            if known == path or known.startswith(below):
                for sweep in sweeps:
                    sweep.void = True
        for known in [p for p in self._absent if p.startswith(below)]:
            del self._absent[known]

    # --- what is learnt besides

    def learn_size(self, path: bytes, size: int, now: float | None = None) -> None:
        """An open told the size (`now`): it beats the listing until the next one. No change of ours."""
        parent, name = split(path)
        directory = self._directories.get(parent)
        if directory is not None and name in directory.entries:
            before = directory.size_of(name)
            directory.sizes[name] = size
            if now is not None and before is not None and size > before:
                directory.growing[name] = now

    def free_at(self, path: bytes) -> float:
        """Return when a complete listing last showed that nothing has the name, whatever its case; -inf if
        none did."""
        parent, name = split(path)
        known = self.known(parent)
        if known is None or not known.complete or folded(name) in map(folded, known.entries):
            return float("-inf")
        return known.listed_at

    def note_proven(self, path: bytes, now: float) -> None:
        """The path is what its listing shows, as an answer of just now (`now`) proved."""
        parent, name = split(path)
        directory = self._directories.get(parent)
        if directory is not None and name in directory.entries:
            directory.proven[name] = now

    def is_growing(self, path: bytes, now: float) -> bool:
        """Return whether somebody on the vehicle seems to write the file."""
        parent, name = split(path)
        directory = self._directories.get(parent)
        return directory is not None and now - directory.growing.get(name, float("-inf")) < STILL_GROWING

    def note_found(self, path: bytes, entry: DirEntry) -> None:
        """An open found a file that its directory's incomplete listing lacks."""
        parent, name = split(path)
        directory = self._directories.get(parent)
        if directory is not None and name not in directory.entries:
            directory.entries[name] = entry
            self._weight += 1

    def note_absent(self, path: bytes, until: float) -> None:
        """An open found that the path does not exist."""
        self._absent[path] = until
        self._absent.move_to_end(path)
        if len(self._absent) > MAX_ABSENT:
            self._absent.popitem(last=False)

    # --- what we changed ourselves

    def note_created(self, path: bytes, entry: DirEntry) -> None:
        """We made a file or directory; `entry.name` is the path's last part."""
        self.forget(path)
        self._absent.pop(path, None)
        self._change(path, entry, reshapes=True)

    def note_written(self, path: bytes, size: int) -> None:
        """We wrote a file, which is listed perhaps: its size in bytes."""
        if self._entry(path) is None:
            self.note_created(path, DirEntry(split(path)[1], EntryKind.FILE, size))
        else:
            self.note_resized(path, size)

    def note_removed(self, path: bytes) -> None:
        """We removed a file or directory."""
        self.forget(path)
        self._change(path, None, reshapes=True)

    def note_renamed(self, old: bytes, new: bytes) -> None:
        """We renamed something, perhaps over something else; what lay below it must be listed again."""
        entry = self._entry(old)
        self.note_removed(old)
        if entry is None:
            self.forget(new)
            self._absent.pop(new, None)
            self.note_unsized(new)  # it is not what is remembered
            self._doubt(split(new)[0])
        else:
            self.note_created(new, replace(entry, name=split(new)[1]))

    def note_resized(self, path: bytes, size: int, mtime: int | None = None) -> None:
        """We wrote or truncated a file: its size in bytes, its mtime where known."""
        entry = self._entry(path)
        if entry is not None:
            self._change(path, replace(entry, size=size, mtime=mtime), reshapes=False)
        else:
            self._doubt(split(path)[0])

    def note_unsized(self, path: bytes, *, made: bool = False) -> None:
        """We are writing a file, or gave up: its size is unknown, and growth says nothing of others. made: by
        us, perhaps after what a listing since our beginning shows."""
        entry, name = self._entry(path), split(path)[1]
        if entry is not None:
            self._change(path, replace(entry, size=None, mtime=None), reshapes=False)
        elif made:
            self.note_created(path, DirEntry(name, EntryKind.FILE, None))

    # --- inside

    def _entry(self, path: bytes) -> DirEntry | None:
        """Return the entry as last known: a change noted in a sweep under way is newer than any listing."""
        parent, name = split(path)
        for sweep in self._sweeps.get(parent, ()):
            if name in sweep.changes:
                return sweep.changes[name]
        directory = self._directories.get(parent)
        return directory.entries.get(name) if directory is not None else None

    def _change(self, path: bytes, entry: DirEntry | None, *, reshapes: bool) -> None:
        parent, name = split(path)
        for sweep in self._sweeps.get(parent, ()):
            sweep.changes[name] = entry
            sweep.reshaped |= reshapes
        directory = self._directories.get(parent)
        if directory is not None:
            self._weight -= directory.weight
            _put(directory.entries, name, entry)
            directory.sizes.pop(name, None)
            directory.growing.pop(name, None)
            directory.proven.pop(name, None)
            self._weight += directory.weight

    def _doubt(self, path: bytes) -> None:
        """We changed something in `path` without knowing what it looks like now: ask again."""
        for sweep in self._sweeps.get(path, ()):
            sweep.reshaped = True
        directory = self._directories.get(path)
        if directory is not None:
            directory.fresh_until = float("-inf")

    def _growing(self, sweep: Sweep, new: Directory, now: float) -> dict[bytes, float]:
        """Return which files grew since the last listing without us, or did a short while ago."""
        old = self._directories.get(sweep.path)
        if old is None:
            return {}
        growing = {name: at for name, at in old.growing.items() if now - at < STILL_GROWING}
        for name in old.entries.keys() & new.entries.keys():
            before, after = old.size_of(name), new.size_of(name)
            if before is not None and after is not None and after > before:
                growing[name] = now
        return {name: at for name, at in growing.items() if name not in sweep.changes}

    def _store(self, path: bytes, directory: Directory) -> None:
        old = self._directories.pop(path, None)
        self._weight += directory.weight - (old.weight if old is not None else 0)
        self._directories[path] = directory
        while self._weight > self._max_entries and len(self._directories) > 1:
            self._weight -= self._directories.popitem(last=False)[1].weight


def _put(entries: dict[bytes, DirEntry], name: bytes, entry: DirEntry | None) -> None:
    if entry is None:
        entries.pop(name, None)
    else:
        entries[name] = entry
