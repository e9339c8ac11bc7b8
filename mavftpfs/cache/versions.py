"""One version of a remote file. Layer: cache.

A version is a file as it was when it was opened: its size, and its time where listings tell it. Handles of
one version share its blocks and its remote reader. When the file turns out to have become another one the
version is `dead`: its handles get FileChanged, and later opens start a new version. If somebody else did
that it is `lost`, too: its handles never get what has the path now, whoever wrote it.
"""

from __future__ import annotations

from dataclasses import dataclass

from mavftpfs.cache.blocks import FileBlocks
from mavftpfs.cache.kept_disk import Kept
from mavftpfs.cache.remote import Reader
from mavftpfs.shared.errors import FileChanged, MavftpfsError
from mavftpfs.shared.model import DirEntry

NEVER = float("-inf")


@dataclass(slots=True, eq=False)
class Version:
    """A file as it was when it was opened. Times are those of the caches' clock.

    mtime: None if not known to belong to this size. proven_at: when it was last known to be what the vehicle
    holds, so that opening it again needs no request. compared_at: when the path was last known to be this
    file. compare_after: no listing is asked for before, only to compare. handles: how many are open. shown:
    whether the kernel may hold pages of it and all of them are good. dead: why it is not the path's file any
    more; lost: somebody else changed that. kept: its part on the local disk, if it may have one.
    """

    path: bytes
    mtime: int | None
    blocks: FileBlocks
    proven_at: float
    compared_at: float
    compare_after: float = NEVER
    reader: Reader | None = None
    handles: int = 0
    shown: bool = False
    dead: MavftpfsError | None = None
    lost: bool = False
    kept: Kept | None = None

    @property
    def size(self) -> int:
        """Size in bytes by the open reply."""
        return self.blocks.size

    @property
    def compared(self) -> bool:
        """Whether it was known to be the path's file since the server opened that the last time, or
        restarted."""
        return self.compared_at >= self.blocks.opened_at

    def require_alive(self) -> None:
        """Raise FileChanged if the file became another one."""
        if self.dead is not None:
            raise self.dead.with_traceback(None)

    def end(self, why: str) -> None:
        """It is not the path's file any more; who waits for its bytes hears so."""
        self.dead, self.kept = FileChanged(why), None
        self.close_reader()
        self.blocks.on_failed(self.dead)
        self.blocks.clear()

    def start_over(self, mtime: int | None, listed_at: float) -> None:
        """Nothing of it was given out: it is the file that a listing of that time shows."""
        self.mtime, self.kept = mtime, None
        self.compared_at, self.compare_after = listed_at, NEVER
        self.close_reader()
        self.blocks.start_over()

    def close_reader(self) -> None:
        """Drop readahead and the remote reader."""
        reader, self.reader = self.reader, None
        if reader is not None:
            reader.drop_readahead()
            reader.close()


def became_another(size: int, mtime: int | None, entry: DirEntry) -> bool:
    """Return whether a newer listing contradicts what is known of a file; a larger one only grew."""
    if entry.size is None or entry.size > size:
        return False
    if entry.size < size:
        return True
    return entry.mtime is not None and mtime is not None and entry.mtime != mtime
