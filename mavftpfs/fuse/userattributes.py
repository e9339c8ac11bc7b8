"""What programs set and no vehicle stores: modes, owners, exact times. Layer: fuse; pure.

Kept by path for the life of the mount (the kernel forgets inodes at will), so that `cp -p`, `rsync -a`,
`tar` and `touch` see what they set. A file's time is shown while the tree shows the same second, because the
tree knows when a file changed. A directory's is the one that was set, until entries are made, removed or
renamed in it; from then on it is the time of that, or the vehicle's where that is later: a memory card keeps
none, and the programs that look for changes by it (make, mail readers, git's untracked cache) would see none.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

MAX_KEPT = 100_000
NANO = 1_000_000_000


@dataclass(slots=True)
class UserAttributes:
    """None = not set. mode: permission bits; times in nanoseconds since 1970 UTC.

    changed_ns: when a directory's entries, or its times, were last changed through this mount.
    """

    mode: int | None = None
    uid: int | None = None
    gid: int | None = None
    atime_ns: int | None = None
    mtime_ns: int | None = None
    changed_ns: int | None = None

    def shown_mtime_ns(self, listed: int) -> int:
        """Return the time to show of a file where the tree shows `listed` (seconds)."""
        if self.mtime_ns is not None and self.mtime_ns // NANO == listed:
            return self.mtime_ns
        return listed * NANO

    def directory_times(self, listed_ns: int) -> tuple[int, int]:
        """Return (mtime, ctime) to show of a directory where the tree shows `listed_ns`."""
        changed = listed_ns if self.changed_ns is None else max(self.changed_ns, listed_ns)
        return changed if self.mtime_ns is None else self.mtime_ns, changed


class UserAttributeTable:
    """What was set on a bounded number of paths; the least recently changed are forgotten first."""

    def __init__(self, limit: int = MAX_KEPT) -> None:
        self._limit = limit
        self._kept: OrderedDict[bytes, UserAttributes] = OrderedDict()

    def get(self, path: bytes) -> UserAttributes | None:
        """Return what was set on a path, or None."""
        return self._kept.get(path)

    def at(self, path: bytes) -> UserAttributes:
        """Return what was set on a path, to be changed."""
        kept = self._kept.get(path)
        if kept is None:
            kept = self._kept[path] = UserAttributes()
            if len(self._kept) > self._limit:
                self._kept.popitem(last=False)
        self._kept.move_to_end(path)
        return kept

    def entries_changed(self, directory: bytes, now_ns: int) -> None:
        """An entry was made, removed or renamed in a directory: a time that was set holds no longer."""
        kept = self.at(directory)
        kept.mtime_ns, kept.changed_ns = None, now_ns

    def drop(self, path: bytes) -> None:
        """The path is gone."""
        self._kept.pop(path, None)

    def move(self, old: bytes, new: bytes) -> None:
        """The path, and everything below it, has another name."""
        self.drop(new)
        prefix = old + b"/"
        for path in [known for known in self._kept if known == old or known.startswith(prefix)]:
            self._kept[new + path[len(old) :]] = self._kept.pop(path)
