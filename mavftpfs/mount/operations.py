"""pyfuse3's handlers: translate, delegate to the tree, map errors. Layer: mount.

Inodes are touched only between awaits: reserve, reply and count form one atomic step. A call without a
handler here is ENOSYS for the kernel, which handles that: an fsync of a directory succeeds, and no extended
attribute can be set.

The kernel calls flush for every closed descriptor, even of programs that wrote nothing. So flush asks the
handle, and a handle for reading has nothing to deliver. A program asks for fsync, and means the file, so any
handle will do (`sync FILE` opens for reading). release cannot report errors; pending changes stay with the
tree. With `ro` both the kernel and the tree refuse changes.
"""

from __future__ import annotations

import errno
import json
import logging
import mmap
import os
import stat as stat_bits
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, NoReturn

import pyfuse3
import trio
from pyfuse3 import EntryAttributes, FileInfo, FUSEError, RequestContext, SetattrFields, StatvfsData

from mavftpfs.cache.attributes import Stat
from mavftpfs.cache.tree import Tree
from mavftpfs.client.connect import Space
from mavftpfs.client.mountpoint import XATTR_CRC32, XATTR_STATUS
from mavftpfs.mount.guard import handler
from mavftpfs.mount.handles import (
    ROOT_INO,
    DirectoryHandle,
    FileHandle,
    HandleTable,
    Inode,
    InodeTable,
    Presentation,
    UserAttributeTable,
    closed_on_failure,
    is_mapped_page,
)
from mavftpfs.mount.programs import program_of
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import ListingIncomplete, MavftpfsError, NotFound
from mavftpfs.shared.model import MAX_WIRE_PATH, EntryKind, join, split

log = logging.getLogger("mavftpfs.fuse")

DOTS = (b".", b"..")
"""The kernel takes number and kind of these entries, and counts no lookup."""
_WRITE_BITS = 0o222
_ANY_DIRECTORY = Stat(EntryKind.DIRECTORY, 0, 0, 0.0)

BLOCK_SIZE = 4096
STAT_BLOCK = 512
UNKNOWN_SPACE = 1000 << 30
"""Bytes shown as total and free if the vehicle reports none, because programs refuse to copy into 0 free
bytes."""

Refresh = Callable[[int], Awaitable[None]]
"""Makes the kernel forget an inode's attributes (not its pages)."""


async def _no_refresh(ino: int) -> None:
    """For callers without a kernel."""


class Operations(pyfuse3.Operations):
    """One mount's request handlers."""

    supports_dot_lookup = False
    enable_writeback_cache = False

    def __init__(
        self,
        tree: Tree,
        presentation: Presentation,
        *,
        inodes: InodeTable | None = None,
        refresh: Refresh = _no_refresh,
        space: Callable[[], Space | None] = lambda: None,
        told: Callable[[], dict[str, Any]] = dict,
    ) -> None:
        """`told()`: the value of the mount's attribute, JSON-able."""
        super().__init__()
        self._tree = tree
        self.op_deadline = presentation.op_deadline
        self._presentation = presentation
        self._refresh = refresh
        self._space = space
        self._told = told
        self._set_by_users = UserAttributeTable()
        self.inodes = InodeTable() if inodes is None else inodes
        self.files: HandleTable[FileHandle] = HandleTable()
        self.directories: HandleTable[DirectoryHandle] = HandleTable()

    def counts(self) -> dict[str, int]:
        """Return the kernel's numbers of inodes and handles."""
        return {
            "inodes": len(self.inodes),
            "open_files": len(self.files),
            "open_directories": len(self.directories),
        }

    # -- names and attributes ---------------------------------------------------------------------

    @handler
    async def lookup(self, parent_inode: int, name: bytes, ctx: RequestContext) -> EntryAttributes:
        """Find a name; the kernel caches its absence, too (st_ino 0)."""
        path = self._child(parent_inode, name)
        try:
            found = await self._tree.stat(path)
        except NotFound:
            return self._negative(path)
        self._lose_names()
        # The parent may have another path by now.
        return self._attributes(self.inodes.lookup(self._child(parent_inode, name)), found)

    async def forget(self, inode_list: Sequence[tuple[int, int]]) -> None:
        """Subtract lookup counts. Must not raise."""
        for ino, lookups in inode_list:
            self.inodes.forget(ino, lookups)

    # -- directories ------------------------------------------------------------------------------

    @handler
    async def opendir(self, inode: int, ctx: RequestContext) -> int:
        """Open a directory, if it still exists; the first readdir lists it."""
        if (await self._tree.stat(self._path(inode))).kind is not EntryKind.DIRECTORY:
            raise FUSEError(errno.ENOTDIR)
        return self.directories.add(DirectoryHandle(inode))

    @handler
    async def readdir(self, fh: int, start_id: int, token: pyfuse3.ReaddirToken) -> None:
        """Reply with entries and attributes, as many as the kernel takes.

        Offsets count in a snapshot, so a change of the directory in the meantime neither skips nor repeats a
        name; rewinding takes a new one. If a directory could not be listed to its end, the program gets the
        known part, and then an error, because `rsync --delete` believes what it sees.
        """
        handle = self._directory(fh)
        if start_id == 0:
            await self._take_snapshot(handle)
            self._lose_names()
        elif start_id >= len(handle.entries) and handle.cut_short:
            raise FUSEError(errno.EIO)
        for offset, (name, found) in enumerate(handle.entries[start_id:], start_id + 1):
            inode = self.inodes.reserve(self._child(handle.ino, name))
            sent = pyfuse3.readdir_reply(token, name, self._attributes(inode, found), offset)
            if sent and name not in DOTS:
                self.inodes.count(inode)
            else:
                self.inodes.discard(inode)
            if not sent:
                return

    async def _take_snapshot(self, handle: DirectoryHandle) -> None:
        """List a directory.

        Raises:
            FUSEError: EIO in place of ENOENT, which the C library takes for the end of the directory.
        """
        handle.cut_short = False
        try:
            entries = await self._tree.list(self._path(handle.ino))
        except ListingIncomplete as incomplete:
            entries, handle.cut_short = list(incomplete.entries), True
            if not entries:
                raise
        except MavftpfsError as error:
            if errno_for(error) != errno.ENOENT:
                raise
            log.debug("readdir: %s", error)
            raise FUSEError(errno.EIO) from error
        handle.entries = [*((dot, _ANY_DIRECTORY) for dot in DOTS), *entries]

    @handler
    async def releasedir(self, fh: int) -> None:
        """Forget the snapshot."""
        self.directories.remove(fh)

    # -- files ------------------------------------------------------------------------------------

    @handler
    async def open(self, inode: int, flags: int, ctx: RequestContext) -> FileInfo:
        """Open a file; O_TRUNC is in the flags, and no setattr follows."""
        truncate, append = bool(flags & os.O_TRUNC), bool(flags & os.O_APPEND)
        writing = truncate or flags & os.O_ACCMODE != os.O_RDONLY
        known = self._inode(inode)
        self._lose_names()
        path = self._path(inode)
        file = await self._tree.open(
            path, write=writing, truncate=truncate, append=append, program=lambda: program_of(ctx.pid)
        )
        self._lose_names()
        if known.path is None:
            file.close()
            raise FUSEError(errno.ESTALE)  # the kernel looks the name up again, and opens the new inode
        if truncate:
            known.told_size = 0
        elif known.told_size not in (None, file.size):
            with closed_on_failure(file.close):
                await self._refresh(inode)
        fh = self.files.add(FileHandle(inode, file, flags))
        return FileInfo(fh=fh, direct_io=file.direct_io, keep_cache=file.keep_cache)

    @handler
    async def create(
        self, parent_inode: int, name: bytes, mode: int, flags: int, ctx: RequestContext
    ) -> tuple[FileInfo, EntryAttributes]:
        """Create a file and open it."""
        path = self._child(parent_inode, name)
        exclusive = bool(flags & os.O_EXCL)
        file = await self._tree.create(path, exclusive=exclusive, program=lambda: program_of(ctx.pid))
        with closed_on_failure(file.close):
            if flags & os.O_TRUNC and file.size:
                await file.truncate(0)
            found = Stat(EntryKind.FILE, file.size, (await self._tree.stat(path)).mtime_ns, 0.0)
        self._lose_names()
        self._set_by_users.at(path).mode = stat_bits.S_IMODE(mode)
        inode = self.inodes.lookup(path)
        fh = self.files.add(FileHandle(inode.ino, file, flags))
        info = FileInfo(fh=fh, direct_io=file.direct_io, keep_cache=file.keep_cache)
        return info, self._attributes(inode, found)

    @handler
    async def read(self, fh: int, off: int, size: int) -> bytes | memoryview:  # type: ignore[override]
        """Read; fewer bytes than requested only at the end of the opened size.

        A short reply in mid-file would look like the end: `cp` would exit 0 with half a file.
        """
        handle = self._file(fh)
        file = handle.file
        with trio.CancelScope() as scope:
            # More than a page at once is the kernel's readahead into the page cache.
            if size > mmap.PAGESIZE and not (file.writable or file.direct_io or handle.let_go):
                handle.ahead[scope.cancel] = None
            try:
                data = await file.read(off, size)
            finally:
                handle.ahead.pop(scope.cancel, None)
        if scope.cancelled_caught:
            raise FUSEError(errno.EINTR)
        if len(data) != max(0, min(size, file.size - off)):
            log.error("bug: %d bytes for a read of %d at %d of %d", len(data), size, off, file.size)
            raise FUSEError(errno.EIO)
        return data

    @handler
    async def write(self, fh: int, off: int, buf: bytes) -> int:
        """Take bytes, and keep them until the card is proven to have them."""
        handle = self._file(fh)
        file = handle.file
        if not file.writable:
            raise FUSEError(errno.EBADF)
        known = self._inode(handle.ino)
        told, stop = known.told_size or 0, off + len(buf)
        known.told_size = max(told, stop)  # the kernel counts on without asking
        if handle.flags & os.O_APPEND and not is_mapped_page(off, stop, told):
            off = file.size  # the kernel's size may be older than the tree's
        return await file.write(off, buf)

    @handler
    async def flush(self, fh: int) -> None:
        """Deliver the file, because a descriptor was closed. 0 means that everything written is on the card,
        verified.

        Exception: fsync or release delivers a file that was only emptied, or made.

        A program that closes a descriptor for reading may have been interrupted. The kernel's reads for it
        would keep the handle open, and last for minutes on a slow link, so flush ends them. For another
        program that shares the handle this is no error: the kernel asks again, page by page. flush ends them
        only once.
        """
        handle = self._file(fh)
        if handle.file.writable:
            await handle.file.flush()
        for cancel in list(handle.ahead):
            handle.let_go = True
            cancel()

    @handler
    async def fsync(self, fh: int, datasync: bool) -> None:
        """Deliver the file: 0 means that everything written is on the card, verified, whichever handle wrote
        it. The kernel also calls fsync after each write to a file with O_SYNC, and the write returns its
        error."""
        handle = self._file(fh)
        await handle.file.fsync(ends_write=bool(handle.flags & os.O_DSYNC))

    @handler
    async def release(self, fh: int) -> None:
        """Close the handle, because its last descriptor was closed. Errors reach no program, but the tree
        keeps the bytes."""
        handle = self.files.remove(fh)
        if handle is None:
            return
        try:
            await handle.file.release()
        except MavftpfsError as exc:
            log.debug("a closed file is not finished on the vehicle yet: %s", exc)  # the tree said it once

    # -- attributes -------------------------------------------------------------------------------

    @handler
    async def getattr(self, inode: int, ctx: RequestContext) -> EntryAttributes:
        """Return attributes by number, even of a file whose name was removed."""
        return await self._attributes_of(inode)

    @handler
    async def setattr(
        self, inode: int, attr: EntryAttributes, fields: SetattrFields, fh: int | None, ctx: RequestContext
    ) -> EntryAttributes:
        """Cut or extend a file; keep modes, owners and times, which no server stores."""
        if fields.update_size:
            await self._resize(inode, attr.st_size, fh)
        path = self._inode(inode).path
        if path is not None:
            await self._keep(path, attr, fields)
        return await self._attributes_of(inode)

    async def _resize(self, ino: int, size: int, fh: int | None) -> None:
        handle = self.files.get(fh) if fh is not None else None
        if handle is not None and handle.file.writable:
            await handle.file.truncate(size)
        else:
            await self._tree.truncate(self._path(ino), size)

    async def _keep(self, path: bytes, attr: EntryAttributes, fields: SetattrFields) -> None:
        kept = self._set_by_users.at(path)
        if fields.update_mode:
            kept.mode = stat_bits.S_IMODE(attr.st_mode)
        if fields.update_uid:
            kept.uid = attr.st_uid
        if fields.update_gid:
            kept.gid = attr.st_gid
        if fields.update_atime:
            kept.atime_ns = attr.st_atime_ns
        if fields.update_mtime:
            if (await self._tree.stat(path)).kind is EntryKind.FILE:
                await self._tree.set_times(path, attr.st_mtime_ns)
            else:
                kept.mtime_ns = attr.st_mtime_ns

    # -- names ------------------------------------------------------------------------------------

    @handler
    async def mkdir(self, parent_inode: int, name: bytes, mode: int, ctx: RequestContext) -> EntryAttributes:
        """Make a directory."""
        path = self._child(parent_inode, name)
        await self._tree.mkdir(path)
        self._set_by_users.at(path).mode = stat_bits.S_IMODE(mode)
        found = await self._tree.stat(path)
        return self._attributes(self.inodes.lookup(path), found)

    @handler
    async def rmdir(self, parent_inode: int, name: bytes, ctx: RequestContext) -> None:
        """Remove an empty directory."""
        path = self._child(parent_inode, name)
        await self._tree.rmdir(path)
        self.note_gone(path)

    @handler
    async def unlink(self, parent_inode: int, name: bytes, ctx: RequestContext) -> None:
        """Remove a file; programs that have it open keep it."""
        path = self._child(parent_inode, name)
        await self._tree.unlink(path)
        self.note_gone(path)

    @handler
    async def rename(
        self,
        parent_inode_old: int,
        name_old: bytes,
        parent_inode_new: int,
        name_new: bytes,
        flags: int,
        ctx: RequestContext,
    ) -> None:
        """Move a name, and everything below it."""
        if flags & ~pyfuse3.RENAME_NOREPLACE:
            raise FUSEError(errno.EINVAL)  # EXCHANGE
        old = self._child(parent_inode_old, name_old)
        new = self._child(parent_inode_new, name_new)
        await self._tree.rename(old, new, noreplace=bool(flags & pyfuse3.RENAME_NOREPLACE))
        self.note_renamed(old, new)

    async def _not_on_a_card(self, *_: object) -> NoReturn:
        """Refuse links and devices. Regular files are made by `create`."""
        raise FUSEError(errno.EPERM)

    _never: Any = _not_on_a_card
    symlink = link = mknod = _never

    # -- the file system --------------------------------------------------------------------------

    @handler
    async def statfs(self, ctx: RequestContext) -> StatvfsData:
        """Return the vehicle's reported space, otherwise constants; never a round trip."""
        space = self._space() or Space(UNKNOWN_SPACE, UNKNOWN_SPACE)
        data = StatvfsData()
        data.f_bsize = data.f_frsize = BLOCK_SIZE
        data.f_blocks = space.total // BLOCK_SIZE
        data.f_bfree = data.f_bavail = space.free // BLOCK_SIZE
        data.f_namemax = MAX_WIRE_PATH - 1
        return data

    @handler
    async def getxattr(self, inode: int, name: bytes, ctx: RequestContext) -> bytes:
        """Return a file's checksum, or the mount's identity; unknown names never touch the link."""
        path = self._path(inode)
        if name == XATTR_STATUS:  # of any directory: a part of the mount may be mounted elsewhere, too
            return json.dumps(self._told(), default=str).encode()
        if name != XATTR_CRC32:
            raise FUSEError(pyfuse3.ENOATTR)
        if (await self._tree.stat(path)).kind is not EntryKind.FILE:
            raise FUSEError(pyfuse3.ENOATTR)
        return b"%08x" % await self._tree.crc32(path)

    @handler
    async def listxattr(self, inode: int, ctx: RequestContext) -> list[bytes]:
        """List the root's attribute only, because `cp -a` would ask for the checksum of every log if
        checksums were listed."""
        return [XATTR_STATUS] if inode == ROOT_INO else []

    # -- what changed, through the kernel or not --------------------------------------------------

    def note_gone(self, path: bytes) -> None:
        """Note that a name was removed."""
        self.inodes.unlink(path)
        self._set_by_users.drop(path)

    def note_renamed(self, old: bytes, new: bytes) -> None:
        """Note that a name, and everything below it, has another path."""
        self.inodes.rename(old, new)
        self._set_by_users.move(old, new)

    # -- helpers ----------------------------------------------------------------------------------

    def _lose_names(self) -> None:
        """Take the path from each inode whose open file lost the name: another client replaced the file, or a
        write failed. The path gets another inode, because the kernel has one page cache for each."""
        for handle in self.files:
            inode = self.inodes.get(handle.ino)
            if inode is not None and inode.path is not None and not handle.file.has_name:
                self.inodes.unlink(inode.path)

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
        look = self._presentation
        inode.told_size = found.size
        entry = EntryAttributes()
        entry.st_ino = inode.ino
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
        entry.st_atime_ns = entry.st_mtime_ns = entry.st_ctime_ns = found.mtime_ns
        kept = None if inode.path is None else self._set_by_users.get(inode.path)
        if kept is not None:
            kept.show(entry, found)
        if inode.path is not None and self._tree.is_only_read(inode.path):
            entry.st_mode &= ~_WRITE_BITS
        return entry

    async def _attributes_of(self, ino: int) -> EntryAttributes:
        inode = self._inode(ino)
        self._lose_names()
        if inode.path is not None:
            found = await self._tree.stat(inode.path)
            self._lose_names()
            if inode.path is not None:
                return self._attributes(inode, found)
        for handle in self.files:
            if handle.ino == ino:
                entry = self._attributes(inode, Stat(EntryKind.FILE, handle.file.size, 0, 0.0))
                entry.st_nlink = 0
                return entry
        raise FUSEError(errno.ESTALE)
