"""The directory in which the mounts of several vehicles are: what the kernel sees of it. Layer: mount.

It is local, and holds directories only, one for each vehicle. Each is covered by that vehicle's own mount.
The root cannot be listed before the first heartbeat, nor can a directory that is not covered: an empty
directory would tell `rsync --delete` that all logs are gone.

The kernel keeps names and attributes for ever. So the vehicles' mounts can be reached even if this process is
killed.
"""

from __future__ import annotations

import errno
import json
import stat as stat_bits
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, NoReturn

import pyfuse3
import trio
from pyfuse3 import EntryAttributes, FUSEError, RequestContext, StatvfsData

from mavftpfs.client.mountpoint import XATTR_STATUS
from mavftpfs.mount.guard import handler
from mavftpfs.mount.handles import ROOT_INO, Presentation
from mavftpfs.mount.roster import Member, Roster, parse_name

FOREVER = 1e8
"""Seconds."""
LOOK_PATIENCE = 4.0
"""Seconds for a part of a vehicle to answer."""
ABSENT = 10.0
"""Seconds for which the kernel believes that a part is not there."""

Look = Callable[[int, int], Awaitable[bool]]
"""Asks a component of a system for its files; returns whether it answered."""


class RootOperations(pyfuse3.Operations):
    """Implements pyfuse3's handlers for the root. look: asks components that were not asked yet."""

    supports_dot_lookup = True
    enable_writeback_cache = False

    def __init__(
        self, roster: Roster, presentation: Presentation, look: Look, status: Callable[[], dict[str, Any]]
    ) -> None:
        super().__init__()
        self._roster = roster
        self.op_deadline = presentation.op_deadline
        self._presentation = presentation
        self._look = look
        self._status = status

    @handler
    async def lookup(self, parent_inode: int, name: bytes, ctx: RequestContext) -> EntryAttributes:
        """Find a vehicle's directory; a component is asked whether it is there."""
        if parent_inode != ROOT_INO:
            raise FUSEError(errno.EAGAIN)  # its mount is not there (yet)
        if name in (b".", b".."):
            return self._attributes(ROOT_INO)
        key = parse_name(name)
        member = None if key is None else self._roster.find(*key) or await self._found(*key)
        if member is not None:
            return self._attributes(member.ino)
        if not len(self._roster):
            raise FUSEError(errno.EAGAIN)
        if key is not None and key[1]:
            nothing = EntryAttributes()  # with the number 0: the kernel remembers that there is none
            nothing.entry_timeout = ABSENT
            return nothing
        raise FUSEError(errno.ENOENT)

    async def _found(self, system: int, component: int) -> Member | None:
        """Return a part of a vehicle if it answers; autopilots are only heard."""
        answered = False
        with trio.move_on_after(LOOK_PATIENCE):
            answered = component != 0 and await self._look(system, component)
        return self._roster.add(system, component) if answered else None

    async def forget(self, inode_list: Sequence[tuple[int, int]]) -> None:
        """Nothing to do: lookups are not counted, because numbers stay."""

    @handler
    async def getattr(self, inode: int, ctx: RequestContext) -> EntryAttributes:
        """Return a directory's attributes."""
        return self._attributes(inode)

    @handler
    async def opendir(self, inode: int, ctx: RequestContext) -> int:
        """Open the root, once a vehicle was heard."""
        if inode != ROOT_INO or not len(self._roster):
            raise FUSEError(errno.EAGAIN)
        return inode

    @handler
    async def readdir(self, fh: int, start_id: int, token: pyfuse3.ReaddirToken) -> None:
        """Reply with the vehicles."""
        members = sorted(self._roster, key=lambda member: member.ino)
        for offset, member in enumerate(members[start_id:], start_id + 1):
            attributes = self._attributes(member.ino)
            if not pyfuse3.readdir_reply(token, member.name.encode(), attributes, offset):
                return

    async def releasedir(self, fh: int) -> None:
        """Nothing to release."""

    @handler
    async def statfs(self, ctx: RequestContext) -> StatvfsData:
        """Return that nothing can be stored here."""
        data = StatvfsData()
        data.f_bsize = data.f_frsize = 4096
        data.f_namemax = 255
        return data

    @handler
    async def getxattr(self, inode: int, name: bytes, ctx: RequestContext) -> bytes:
        """Return the root's status."""
        if name == XATTR_STATUS and inode == ROOT_INO:
            return json.dumps(self._status(), default=str).encode()
        raise FUSEError(pyfuse3.ENOATTR)

    async def listxattr(self, inode: int, ctx: RequestContext) -> list[bytes]:
        """List the root's status."""
        return [XATTR_STATUS] if inode == ROOT_INO else []

    async def _read_only(self, *_: object) -> NoReturn:
        raise FUSEError(errno.EROFS)

    _never: Any = _read_only
    setattr = mkdir = mknod = create = symlink = link = unlink = rmdir = rename = _never

    def _attributes(self, ino: int) -> EntryAttributes:
        if ino != ROOT_INO and self._roster.at(ino) is None:
            raise FUSEError(errno.ENOENT)
        attributes = EntryAttributes()
        attributes.st_ino = ino
        attributes.st_mode = stat_bits.S_IFDIR | self._presentation.directory_mode
        attributes.st_nlink = 2
        attributes.st_uid, attributes.st_gid = self._presentation.uid, self._presentation.gid
        attributes.st_size = 0
        attributes.entry_timeout = attributes.attr_timeout = FOREVER
        return attributes
