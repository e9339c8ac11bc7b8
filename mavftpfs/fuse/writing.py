"""The handlers of a mount that may be changed. Layer: fuse.

flush is called for every closed descriptor, whoever wrote (pyfuse3 tells no owner), so it asks the handle:
one that was opened for reading has nothing to say. fsync is asked for by name, and is about the file: any
handle will do (`sync FILE` opens for reading). release cannot report; what it finds undelivered stays with
the tree.
"""

from __future__ import annotations

import errno
import logging
import mmap
import os
import stat as stat_bits
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn, cast

import pyfuse3
from pyfuse3 import EntryAttributes, FileInfo, FUSEError, RequestContext, SetattrFields

from mavftpfs.cache.attributes import Stat
from mavftpfs.fuse.handles import FileHandle, WritableFile, WritableTree, closed_on_failure
from mavftpfs.fuse.inodes import NANO, Inode, UserAttributeTable
from mavftpfs.fuse.operations import Operations, Presentation, handler
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.shared.model import EntryKind, split

log = logging.getLogger("mavftpfs.fuse")

DELIVERY_BUDGET = 4 * 3600.0
"""Seconds for what moves bytes: the tree ends it by itself when there is no progress, so this only keeps
a trickle from lasting for ever."""

NAMESPACE_BUDGET = 240.0
"""Seconds for a change of names: it may have to finish a delivery, and to look whether it was done."""

_DELIVERING = frozenset({"write", "flush", "fsync", "release", "setattr", "open"})
_NAMING = frozenset({"create", "mknod", "mkdir", "rmdir", "unlink", "rename"})


def _writable(handle: FileHandle) -> WritableFile | None:
    """Return the file of a handle that was opened for writing, else None."""
    file = cast(WritableFile, handle.file)
    return file if file.writable else None


@contextmanager
def _given_up_on_failure(file: WritableFile) -> Iterator[None]:
    """Close a file whose creation fails after all, and forget it: it would appear on the card later."""
    try:
        yield
    except BaseException:
        file.give_up()
        raise


def _is_mapped_page(start: int, stop: int, told: int) -> bool:
    """Return whether a write brings a page of a mapping instead of what a program appended.

    The kernel brings pages by any handle that may write, also one with O_APPEND. They lie on page borders and
    within the size it knows (`told`, bytes), where nothing can be appended.
    """
    return start < told and start % mmap.PAGESIZE == 0 and (stop == told or stop % mmap.PAGESIZE == 0)


class WritingOperations(Operations):
    """Operations plus everything that changes the tree."""

    _tree: WritableTree

    def __init__(
        self,
        tree: WritableTree,
        presentation: Presentation,
        *,
        now_ns: Callable[[], int] = time.time_ns,
        **others: Any,
    ) -> None:
        """`now_ns()`: the time of day, nanoseconds since 1970 UTC."""
        super().__init__(tree, presentation, **others)
        self._set_by_users = UserAttributeTable()
        self._now_ns = now_ns

    def budget(self, name: str, args: Sequence[Any]) -> float:
        """Return the seconds a handler may take."""
        if name in _DELIVERING:
            return DELIVERY_BUDGET
        if name in _NAMING:
            return NAMESPACE_BUDGET
        return super().budget(name, args)

    # -- files ------------------------------------------------------------------------------------

    @handler
    async def open(self, inode: int, flags: int, ctx: RequestContext) -> FileInfo:
        """Open a file; O_TRUNC comes in the flags and no setattr follows it."""
        writing = flags & os.O_ACCMODE != os.O_RDONLY or bool(flags & os.O_TRUNC)
        known = self._inode(inode)
        path = self._path(inode)
        file = await self._tree.open(path, write=writing, truncate=bool(flags & os.O_TRUNC))
        if flags & os.O_TRUNC:
            known.told_size = 0
        elif known.told_size not in (None, file.size):
            with closed_on_failure(file):
                await self._refresh(inode)
        fh = self.files.add(FileHandle(inode, file, flags))
        return FileInfo(fh=fh, direct_io=file.direct_io, keep_cache=file.keep_cache)

    @handler
    async def create(
        self, parent_inode: int, name: bytes, mode: int, flags: int, ctx: RequestContext
    ) -> tuple[FileInfo, EntryAttributes]:
        """Create a file and open it."""
        path = self._child(parent_inode, name)
        file = await self._tree.create(path, exclusive=bool(flags & os.O_EXCL))
        with _given_up_on_failure(file):
            if flags & os.O_TRUNC and file.size:
                await file.truncate(0)
            found = Stat(EntryKind.FILE, file.size, (await self._tree.stat(path)).mtime, 0.0)
        self._made(path, mode)
        inode = self.inodes.lookup(path)
        fh = self.files.add(FileHandle(inode.ino, file, flags))
        info = FileInfo(fh=fh, direct_io=file.direct_io, keep_cache=file.keep_cache)
        return info, self._attributes(inode, found)

    @handler
    async def write(self, fh: int, off: int, buf: bytes) -> int:
        """Take bytes; what is taken is kept until it is proven to be on the card."""
        handle = self._file(fh)
        file = _writable(handle)
        if file is None:
            raise FUSEError(errno.EBADF)
        known = self._inode(handle.ino)
        told, stop = known.told_size or 0, off + len(buf)
        known.told_size = max(told, stop)  # the kernel counts on without asking
        if handle.flags & os.O_APPEND and not _is_mapped_page(off, stop, told):
            off = file.size  # the kernel's idea of the size may be older than ours
        return await file.write(off, buf)

    @handler
    async def flush(self, fh: int) -> None:
        """A descriptor was closed: 0 means that everything written is on the card, checked.

        But a file that was only emptied, or made, is delivered by fsync or release.
        """
        file = _writable(self._file(fh))
        if file is not None:
            await file.flush()

    @handler
    async def fsync(self, fh: int, datasync: bool) -> None:
        """0 means that everything written is on the card, checked, by whichever handle."""
        await cast(WritableFile, self._file(fh).file).fsync()

    @handler
    async def release(self, fh: int) -> None:
        """The last descriptor was closed; nobody hears errors any more, but the tree keeps the bytes."""
        handle = self.files.remove(fh)
        if handle is None:
            return
        file = cast(WritableFile, handle.file)
        try:
            await file.release()  # also of a reader: the last one of an unlinked file has it removed
        except MavftpfsError as exc:
            log.debug("a closed file is not finished on the vehicle yet: %s", exc)  # the tree said it once
        finally:
            file.close()

    # -- attributes -------------------------------------------------------------------------------

    @handler
    async def getattr(self, inode: int, ctx: RequestContext) -> EntryAttributes:
        """Return attributes by number, also of a file that has no name any more."""
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
        file = None if handle is None else _writable(handle)
        if file is not None:
            await file.truncate(size)
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
            kept.mtime_ns, kept.changed_ns = attr.st_mtime_ns, self._now_ns()
            if (await self._tree.stat(path)).kind is EntryKind.FILE:
                await self._tree.set_times(path, attr.st_mtime_ns)

    # -- names ------------------------------------------------------------------------------------

    @handler
    async def mknod(
        self, parent_inode: int, name: bytes, mode: int, rdev: int, ctx: RequestContext
    ) -> EntryAttributes:
        """Make an empty regular file; there are no devices on a card."""
        if not stat_bits.S_ISREG(mode):
            raise FUSEError(errno.EPERM)
        path = self._child(parent_inode, name)
        file = await self._tree.create(path, exclusive=True)
        with _given_up_on_failure(file):
            await file.release()
        file.close()
        return await self._new_entry(path, mode)

    @handler
    async def mkdir(self, parent_inode: int, name: bytes, mode: int, ctx: RequestContext) -> EntryAttributes:
        """Make a directory."""
        path = self._child(parent_inode, name)
        await self._tree.mkdir(path)
        self._set_by_users.entries_changed(path, self._now_ns())
        return await self._new_entry(path, mode)

    @handler
    async def rmdir(self, parent_inode: int, name: bytes, ctx: RequestContext) -> None:
        """Remove an empty directory."""
        path = self._child(parent_inode, name)
        await self._tree.rmdir(path)
        self._gone(path)

    @handler
    async def unlink(self, parent_inode: int, name: bytes, ctx: RequestContext) -> None:
        """Remove a file; who has it open keeps it."""
        path = self._child(parent_inode, name)
        await self._tree.unlink(path)
        self._gone(path)

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
        self.inodes.rename(old, new)
        self._set_by_users.move(old, new)
        self._entry_changed(old)
        self._entry_changed(new)

    async def _not_on_a_card(self, *_: object) -> NoReturn:
        raise FUSEError(errno.EPERM)

    async def _no_attribute(self, *_: object) -> NoReturn:
        raise FUSEError(errno.ENOTSUP)

    _never: Any = _not_on_a_card
    _unset: Any = _no_attribute
    symlink = link = _never
    setxattr = removexattr = _unset

    # -- helpers ----------------------------------------------------------------------------------

    def _gone(self, path: bytes) -> None:
        self.inodes.unlink(path)
        self._set_by_users.drop(path)
        self._entry_changed(path)

    def _made(self, path: bytes, mode: int) -> None:
        kept = self._set_by_users.at(path)
        kept.mode, kept.atime_ns = stat_bits.S_IMODE(mode), self._now_ns()
        self._entry_changed(path)

    def _entry_changed(self, path: bytes) -> None:
        """A name came or went; the kernel asks for its directory's attributes again by itself."""
        self._set_by_users.entries_changed(split(path)[0], self._now_ns())

    async def _new_entry(self, path: bytes, mode: int) -> EntryAttributes:
        self._made(path, mode)
        found = await self._tree.stat(path)
        return self._attributes(self.inodes.lookup(path), found)

    async def _attributes_of(self, ino: int) -> EntryAttributes:
        inode = self._inode(ino)
        if inode.path is not None:
            return self._attributes(inode, await self._tree.stat(inode.path))
        for handle in self.files:
            if handle.ino == ino:
                entry = self._attributes(inode, Stat(EntryKind.FILE, handle.file.size, 0, 0.0))
                entry.st_nlink = 0
                return entry
        raise FUSEError(errno.ESTALE)

    def _attributes(self, inode: Inode, found: Any) -> EntryAttributes:
        entry = super()._attributes(inode, found)
        kept = None if inode.path is None else self._set_by_users.get(inode.path)
        if kept is None:
            return entry
        if kept.mode is not None:
            entry.st_mode = stat_bits.S_IFMT(entry.st_mode) | kept.mode
        if kept.uid is not None:
            entry.st_uid = kept.uid
        if kept.gid is not None:
            entry.st_gid = kept.gid
        if found.kind is EntryKind.DIRECTORY:
            entry.st_mtime_ns, entry.st_ctime_ns = kept.directory_times(entry.st_mtime_ns)
        elif not found.mtime_nsec:  # else the tree knows it to the nanosecond
            entry.st_mtime_ns = entry.st_ctime_ns = kept.shown_mtime_ns(found.mtime)
        entry.st_atime_ns = entry.st_mtime_ns if kept.atime_ns is None else kept.atime_ns
        if (
            found.kind is EntryKind.FILE
            and kept.mtime_ns is not None
            and kept.mtime_ns // NANO != found.mtime
        ):
            kept.atime_ns = None  # the file changed since
        return entry
