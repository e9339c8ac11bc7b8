"""pyfuse3's handlers: translate, delegate to the tree, map errors. Layer: fuse.

Rules (all held by `handler`): only FUSEError leaves a handler, because anything else ends pyfuse3's main
loop and with it the mount; every handler has a deadline, because a caller that waits in the kernel cannot be
killed; trio.Cancelled passes.

Inodes are touched only between awaits: reserve, reply and count form one atomic step.
"""

from __future__ import annotations

import errno
import functools
import json
import logging
import os
import stat as stat_bits
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from dataclasses import dataclass
from typing import Any, Concatenate, NoReturn, ParamSpec, TypeVar

import pyfuse3
import trio
from pyfuse3 import EntryAttributes, FileInfo, FUSEError, RequestContext, StatvfsData

from mavftpfs.fuse.handles import (
    XATTR_CRC32,
    XATTR_STATUS,
    DirectoryHandle,
    FileHandle,
    FileTree,
    HandleTable,
    Space,
    Stat,
    closed_on_failure,
)
from mavftpfs.fuse.inodes import ROOT_INO, Inode, InodeTable
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import Armed, ListingIncomplete, MavftpfsError, NotFound
from mavftpfs.shared.model import MAX_WIRE_PATH, EntryKind, join, split

log = logging.getLogger("mavftpfs.fuse")


DEADLINE_MARGIN = 3.0
"""Seconds the tree gets beyond op_deadline to report its own, better error."""

CRC_BUDGET = 120.0
"""Seconds for a checksum: the drone reads the whole file for it (promise 2)."""

SLOWEST_RATE = 256
"""Bytes/s of the slowest link worth waiting for. The tree ends a read without progress by itself; this
only keeps a read that trickles from lasting for ever."""

BLOCK_SIZE = 4096
STAT_BLOCK = 512
UNKNOWN_SPACE = 1000 << 30
"""Bytes shown as total and free where the vehicle did not say: programs refuse to copy into 0 free bytes."""

P = ParamSpec("P")
T = TypeVar("T")
S = TypeVar("S", bound="Operations")
Handler = Callable[Concatenate[S, P], Coroutine[Any, Any, T]]


@dataclass(frozen=True, slots=True)
class Presentation:
    """How entries look, and how long requests may take. Modes are permission bits; deadline in seconds."""

    uid: int
    gid: int
    file_mode: int
    directory_mode: int
    op_deadline: float


Refresh = Callable[[int], Awaitable[None]]
"""Has the kernel forget an inode's attributes (not its pages)."""


async def _no_refresh(ino: int) -> None:
    """For callers without a kernel."""


def handler(method: Handler[S, P, T]) -> Handler[S, P, T]:
    """Guard a handler: let only FUSEError out, within the time that `Operations.budget` allows."""

    async def guarded(self: S, /, *args: P.args, **kwargs: P.kwargs) -> T:
        with trio.move_on_after(self.budget(method.__name__, args)):
            try:
                return await method(self, *args, **kwargs)
            except FUSEError:
                raise
            except MavftpfsError as exc:
                log.debug("%s: %s", method.__name__, exc)
                raise FUSEError(errno_for(exc)) from exc
            except Exception as exc:
                log.exception("bug in %s; the caller gets EIO", method.__name__)
                raise FUSEError(errno.EIO) from exc
        log.warning("%s took longer than its deadline", method.__name__)
        raise FUSEError(errno.ETIMEDOUT)

    return functools.update_wrapper(guarded, method)


class Operations(pyfuse3.Operations):
    """One mount's request handlers. Read-only: whatever would change the tree is EROFS."""

    supports_dot_lookup = False
    enable_writeback_cache = False

    def __init__(
        self,
        tree: FileTree,
        presentation: Presentation,
        *,
        inodes: InodeTable | None = None,
        refresh: Refresh = _no_refresh,
        space: Callable[[], Space | None] = lambda: None,
        status: Callable[[], dict[str, Any]] = dict,
    ) -> None:
        super().__init__()
        self._tree = tree
        self._look = presentation
        self._refresh = refresh
        self._space = space
        self._status = status
        self.inodes = InodeTable() if inodes is None else inodes
        self.files: HandleTable[FileHandle] = HandleTable()
        self.directories: HandleTable[DirectoryHandle] = HandleTable()

    def budget(self, name: str, args: Sequence[Any]) -> float:
        """Return the seconds a handler may take."""
        if name == "read":
            return self._look.op_deadline + DEADLINE_MARGIN + int(args[2]) / SLOWEST_RATE
        if name == "getxattr" and args[1] == XATTR_CRC32:
            return CRC_BUDGET + self._look.op_deadline + DEADLINE_MARGIN
        return self._look.op_deadline + DEADLINE_MARGIN

    def counts(self) -> dict[str, int]:
        """Return how much the kernel holds of ours; excess forgets are a bug, here or there."""
        return {
            "inodes": len(self.inodes),
            "open_files": len(self.files),
            "open_directories": len(self.directories),
            "excess_forgets": self.inodes.excess_forgets,
        }

    # -- names and attributes ---------------------------------------------------------------------

    @handler
    async def lookup(self, parent_inode: int, name: bytes, ctx: RequestContext) -> EntryAttributes:
        """Find a name; one that is not there is cached by the kernel too (st_ino 0)."""
        path = self._child(parent_inode, name)
        try:
            found = await self._tree.stat(path)
        except NotFound:
            return self._negative(path)
        # The parent may have got another path meanwhile.
        return self._attributes(self.inodes.lookup(self._child(parent_inode, name)), found)

    async def forget(self, inode_list: Sequence[tuple[int, int]]) -> None:
        """Take back lookup counts. Must not raise."""
        for ino, lookups in inode_list:
            self.inodes.forget(ino, lookups)

    @handler
    async def getattr(self, inode: int, ctx: RequestContext) -> EntryAttributes:
        """Return attributes by number."""
        known = self._inode(inode)
        return self._attributes(known, await self._tree.stat(self._path(inode)))

    @handler
    async def access(self, inode: int, mode: int, ctx: RequestContext) -> bool:
        """Never asked while default_permissions is on, which is always."""
        return True

    @handler
    async def readlink(self, inode: int, ctx: RequestContext) -> bytes:
        """There are no symbolic links."""
        raise FUSEError(errno.EINVAL)

    # -- directories ------------------------------------------------------------------------------

    @handler
    async def opendir(self, inode: int, ctx: RequestContext) -> int:
        """Open a directory, if it is still there; it is listed by the first readdir."""
        if (await self._tree.stat(self._path(inode))).kind is not EntryKind.DIRECTORY:
            raise FUSEError(errno.ENOTDIR)
        return self.directories.add(DirectoryHandle(inode))

    @handler
    async def readdir(self, fh: int, start_id: int, token: pyfuse3.ReaddirToken) -> None:
        """Reply with entries and attributes, as many as the kernel takes.

        Offsets count in a snapshot, so a change of the directory in the meantime neither skips nor
        repeats a name; rewinding takes a new one. What is known of a directory that could not be listed to
        its end is shown, and then the program gets an error: `rsync --delete` believes what it sees.
        """
        handle = self._directory(fh)
        if start_id == 0:
            await self._take_snapshot(handle)
        elif start_id >= len(handle.entries) and handle.cut_short:
            raise FUSEError(errno.EIO)
        path = self._path(handle.ino)
        for offset, (name, found) in enumerate(handle.entries[start_id:], start_id + 1):
            inode = self.inodes.reserve(join(path, name))
            if not pyfuse3.readdir_reply(token, name, self._attributes(inode, found), offset):
                self.inodes.discard(inode)
                return
            self.inodes.count(inode)

    async def _take_snapshot(self, handle: DirectoryHandle) -> None:
        """List a directory.

        Raises:
            FUSEError: EIO in place of ENOENT, which the C library takes for the end of the directory.
        """
        handle.cut_short = False
        try:
            handle.entries = await self._tree.list(self._path(handle.ino))
        except ListingIncomplete as incomplete:
            handle.entries, handle.cut_short = incomplete.entries, True
            if not handle.entries:
                raise
        except MavftpfsError as error:
            if errno_for(error) != errno.ENOENT:
                raise
            log.debug("readdir: %s", error)
            raise FUSEError(errno.EIO) from error

    @handler
    async def releasedir(self, fh: int) -> None:
        """Forget the snapshot."""
        self.directories.remove(fh)

    @handler
    async def fsyncdir(self, fh: int, datasync: bool) -> None:
        """Nothing is ever pending in a directory."""

    # -- files ------------------------------------------------------------------------------------

    @handler
    async def open(self, inode: int, flags: int, ctx: RequestContext) -> FileInfo:
        """Open a file for reading."""
        if flags & os.O_ACCMODE != os.O_RDONLY or flags & os.O_TRUNC:
            raise FUSEError(errno.EROFS)
        known = self._inode(inode)
        file = await self._tree.open(self._path(inode))
        if known.told_size not in (None, file.size):
            # Else the kernel ends reads at the size it remembers for up to attr_timeout.
            with closed_on_failure(file):
                await self._refresh(inode)
        fh = self.files.add(FileHandle(inode, file))
        return FileInfo(fh=fh, direct_io=file.direct_io, keep_cache=file.keep_cache)

    @handler
    async def read(self, fh: int, off: int, size: int) -> bytes | memoryview:  # type: ignore[override]
        """Read; fewer bytes than asked only at the end of the opened size.

        A short reply in mid-file would look like the end: `cp` would exit 0 with half a file.
        """
        file = self._file(fh).file
        data = await file.read(off, size)
        if len(data) != max(0, min(size, file.size - off)):
            log.error("bug: %d bytes for a read of %d at %d of %d", len(data), size, off, file.size)
            raise FUSEError(errno.EIO)
        return data

    @handler
    async def flush(self, fh: int) -> None:
        """A handle for reading has nothing to deliver."""

    @handler
    async def fsync(self, fh: int, datasync: bool) -> None:
        """A handle for reading has nothing to deliver."""

    @handler
    async def release(self, fh: int) -> None:
        """Close a file."""
        handle = self.files.remove(fh)
        if handle is not None:
            handle.file.close()

    # -- the file system --------------------------------------------------------------------------

    @handler
    async def statfs(self, ctx: RequestContext) -> StatvfsData:
        """Return the space the vehicle told of, else constants; never a round trip."""
        space = self._space() or Space(UNKNOWN_SPACE, UNKNOWN_SPACE)
        data = StatvfsData()
        data.f_bsize = data.f_frsize = BLOCK_SIZE
        data.f_blocks = space.total // BLOCK_SIZE
        data.f_bfree = data.f_bavail = space.free // BLOCK_SIZE
        data.f_namemax = MAX_WIRE_PATH - 1
        return data

    @handler
    async def getxattr(self, inode: int, name: bytes, ctx: RequestContext) -> bytes:
        """Return a file's checksum or the root's status; unknown names never touch the link."""
        path = self._path(inode)
        if name == XATTR_STATUS and inode == ROOT_INO:
            return json.dumps(self._status(), default=str).encode()
        if name != XATTR_CRC32:
            raise FUSEError(pyfuse3.ENOATTR)
        if (await self._tree.stat(path)).kind is not EntryKind.FILE:
            raise FUSEError(pyfuse3.ENOATTR)
        try:
            return b"%08x" % await self._tree.crc32(path)
        except Armed as exc:
            raise FUSEError(errno.EAGAIN) from exc

    @handler
    async def listxattr(self, inode: int, ctx: RequestContext) -> list[bytes]:
        """List the root's status only: listed checksums would have `cp -a` ask for one of every log."""
        return [XATTR_STATUS] if inode == ROOT_INO else []

    # -- what would change the tree ---------------------------------------------------------------

    async def _refuse(self, *_: object) -> NoReturn:
        raise FUSEError(errno.EROFS)

    _refused: Any = _refuse
    setattr = create = mknod = mkdir = unlink = rmdir = symlink = rename = link = _refused
    write = setxattr = removexattr = _refused

    # -- helpers ----------------------------------------------------------------------------------

    def _inode(self, ino: int) -> Inode:
        inode = self.inodes.get(ino)
        if inode is None:
            raise FUSEError(errno.ESTALE)
        return inode

    def _path(self, ino: int) -> bytes:
        path = self._inode(ino).path
        if path is None:
            raise FUSEError(errno.ESTALE)
        return path

    def _file(self, fh: int) -> FileHandle:
        handle = self.files.get(fh)
        if handle is None:
            raise FUSEError(errno.EBADF)
        return handle

    def _directory(self, fh: int) -> DirectoryHandle:
        handle = self.directories.get(fh)
        if handle is None:
            raise FUSEError(errno.EBADF)
        return handle

    def _child(self, parent_ino: int, name: bytes) -> bytes:
        parent = self._path(parent_ino)
        if name == b".":
            return parent
        return split(parent)[0] if name == b".." else join(parent, name)

    def _negative(self, path: bytes) -> EntryAttributes:
        entry = EntryAttributes()
        entry.st_ino = 0
        entry.entry_timeout = self._tree.negative_valid_for(path)
        return entry

    def _attributes(self, inode: Inode, found: Stat) -> EntryAttributes:
        look = self._look
        inode.told_size = found.size
        entry = EntryAttributes()
        entry.st_ino = inode.ino
        entry.generation = inode.generation
        entry.entry_timeout = entry.attr_timeout = found.valid_for
        if found.kind is EntryKind.DIRECTORY:
            entry.st_mode = stat_bits.S_IFDIR | look.directory_mode
        else:
            entry.st_mode = stat_bits.S_IFREG | look.file_mode
        entry.st_nlink = 1
        entry.st_uid, entry.st_gid = look.uid, look.gid
        entry.st_size = found.size
        entry.st_blksize = BLOCK_SIZE
        entry.st_blocks = -(-found.size // STAT_BLOCK)
        mtime_ns = found.mtime * 1_000_000_000 + found.mtime_nsec
        entry.st_atime_ns = entry.st_mtime_ns = entry.st_ctime_ns = mtime_ns
        return entry
