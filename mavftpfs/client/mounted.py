"""The files of a mount that is up, by the kernel's calls. Layer: client.

Each call goes through the kernel in a thread: it may have to wait for the mount's vehicle.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import trio

from mavftpfs.cache.attributes import Stat
from mavftpfs.cache.localfiles import stays_local
from mavftpfs.client import control
from mavftpfs.client.mountpoint import XATTR_CRC32
from mavftpfs.client.status import is_read_only, told_by
from mavftpfs.shared import errors, readonly
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import NotFound
from mavftpfs.shared.model import ROOT, EntryKind, is_virtual, normalise, split
from mavftpfs.shared.readable import name_text

WITHDRAWAL_TIME = 45.0
"""Seconds to take back what was written: a request or two without an answer."""

CLOSING_TIME = 5.0
"""Seconds to close a file of which nothing more is delivered."""

STATUS_PATIENCE = 3.0
"""Seconds for a mount to tell its status; a mount that does not is not used."""

ResultT = TypeVar("ResultT")

_BY_ERRNO: dict[int, type[errors.MavftpfsError]] = {
    errno_for(kind("")): kind
    for kind in (
        *(errors.NotFound, errors.NotADirectory, errors.IsADirectory, errors.AlreadyExists),
        *(errors.DirectoryNotEmpty, errors.InvalidMove, errors.CrossDevice, errors.ReadOnly, errors.FileBusy),
        *(errors.NotSupported, errors.FileTooLarge, errors.NoSpace, errors.FileChanged),
        *(errors.PathTooLong, errors.RequestTimeout),
    )
} | {
    errno.ENOTCONN: errors.LinkClosed,  # the mount's process is gone
    errno.ECONNABORTED: errors.LinkClosed,
    errno.ENODEV: errors.LinkClosed,
    errno.EAGAIN: errors.NotDeliveredYet,  # only the checksum has it
}


_SENTENCES = {
    errors.NotFound: "does not exist",
    errors.NotADirectory: "is not a directory",
    errors.IsADirectory: "is a directory",
    errors.AlreadyExists: "exists",
    errors.DirectoryNotEmpty: "is not empty",
}
"""The caches' sentences for the same errors."""
_ABOUT_TARGET = (
    *(errors.NotADirectory, errors.IsADirectory, errors.AlreadyExists, errors.DirectoryNotEmpty),
)
"""Errnos by which rename(2) refuses the new name."""


_HINTS = {
    errors.NotDeliveredYet: " (not all of it is on the vehicle yet)",
    errors.RequestTimeout: " (the vehicle does not answer)",
    errors.FileBusy: " (another program uses the vehicle's files, or the vehicle writes this one)",
}


def _translated(error: OSError, path: bytes) -> errors.MavftpfsError:
    number = error.errno or errno.EIO
    kind = _BY_ERRNO.get(number)
    if kind in _SENTENCES:
        return kind(_sentence(kind, path))
    text = f"{name_text(path)}: {os.strerror(number)}"
    return errors.OtherRefusal(text, number) if kind is None else kind(text + _HINTS.get(kind, ""))


def _sentence(kind: type[errors.MavftpfsError], path: bytes) -> str:
    return f"{path!r} {_SENTENCES[kind]}"


@contextmanager
def _about_parent(path: bytes) -> Iterator[None]:
    """Name the directory in the error, if the body makes a path and its directory is missing."""
    try:
        yield
    except NotFound as exc:
        raise NotFound(_sentence(NotFound, split(path)[0])) from exc


async def _call(path: bytes, function: Callable[..., ResultT], *args: object) -> ResultT:
    """Have the kernel do something about a path, in a thread."""
    try:
        return await trio.to_thread.run_sync(function, *args, abandon_on_cancel=True)
    except OSError as exc:
        raise _translated(exc, path) from exc


@dataclass(frozen=True, slots=True)
class _Changes:
    """The kernel's calls that change something in a mount: EROFS has several reasons, which the mount knows.

    mountpoint: of the mount; root: the vehicle's directory that is `/` of the paths.
    """

    mountpoint: str
    root: bytes

    async def call(self, path: bytes, function: Callable[..., ResultT], *args: object) -> ResultT:
        """Have the kernel do something about a path, in a thread."""
        try:
            return await _call(path, function, *args)
        except errors.ReadOnly as exc:
            raise await self._explained(path, exc) from exc
        except errors.OtherRefusal as exc:
            # Modes below @ lack write permission, so the kernel refuses ordinary users itself.
            if exc.number == errno.EACCES and is_virtual(normalise(self.root + path)):
                raise errors.ReadOnly(readonly.virtual(path)) from exc
            raise

    async def _explained(self, path: bytes, error: errors.ReadOnly) -> errors.MavftpfsError:
        ask = partial(told_by, self.mountpoint, STATUS_PATIENCE)
        try:
            status = await trio.to_thread.run_sync(ask, abandon_on_cancel=True)
        except errors.MavftpfsError:
            return error
        if status.get("problem") or "vehicle" not in status:
            return error
        if status["read_only"]:
            return errors.ReadOnly(readonly.by_option(path, self.mountpoint))
        if is_read_only(status["vehicle"]):
            return errors.Armed(readonly.ARMED)
        if is_virtual(normalise(self.root + path)):
            return errors.ReadOnly(readonly.virtual(path))
        return errors.ReadOnly(readonly.by_vehicle(path))


def _write_all(fd: int, data: bytes | memoryview, offset: int) -> None:
    """Write all of `data`. A write of which only the end is refused returns how much went before."""
    left = memoryview(data)
    while left:
        count = os.pwrite(fd, left, offset)
        left, offset = left[count:], offset + count


@dataclass(slots=True)
class MountedFile:
    """An open file of a mount; see File. changes: makes the calls that write. withdraw: asks the mount to
    take the file back, and blocks; None if it cannot."""

    path: bytes
    fd: int
    size: int
    changes: _Changes
    withdraw: Callable[[], bool | None]
    writable: bool

    async def read(self, offset: int, size: int) -> bytes:
        """As os.pread."""
        return await _call(self.path, os.pread, self.fd, size, offset)

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """As os.pwrite, until all of it is written."""
        await self.changes.call(self.path, _write_all, self.fd, data, offset)
        self.size = max(self.size, offset + len(data))
        return len(data)

    async def fsync(self) -> None:
        """As os.fsync."""
        await self.changes.call(self.path, os.fsync, self.fd)

    async def truncate(self, size: int) -> None:
        """As os.ftruncate."""
        await self.changes.call(self.path, os.ftruncate, self.fd, size)
        self.size = size

    async def release(self) -> None:
        """As os.close, which goes on in its thread if it takes long."""
        fd, self.fd = self.fd, -1
        if fd >= 0:
            with trio.CancelScope(deadline=trio.current_time() + CLOSING_TIME, shield=True):
                await self.changes.call(self.path, os.close, fd)

    async def take_back(self) -> bool | None:
        """Make the mount take back what it has not delivered, before a close makes it try again."""
        there: bool | None = None
        try:
            if self.writable:
                there = await trio.to_thread.run_sync(self.withdraw, abandon_on_cancel=True)
        finally:
            with suppress(errors.MavftpfsError):
                await self.release()
        return there


def _size_of_opened(fd: int) -> int:
    """Return the size of a file that was just opened.

    Raises:
        IsADirectoryError.
    """
    found = os.fstat(fd)
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    # Else the kernel asks for 128 KiB at once, which takes 22 s on a radio. The mount itself reads ahead.
    os.posix_fadvise(fd, 0, 0, os.POSIX_FADV_RANDOM)
    return found.st_size


class MountedFiles:
    """Implements Files by the kernel's calls."""

    def __init__(self, mountpoint: str, mounted: bytes, root: bytes, *, read_only: bool = False) -> None:
        """`mounted`: the vehicle's directory on the mountpoint; `root`: the vehicle's directory that is our
        `/`. read_only: refuse changes, whatever the mount allows."""
        self._read_only = read_only
        self._mountpoint = os.fsencode(mountpoint)
        self._mounted = mounted.rstrip(b"/")
        self._root = root.rstrip(b"/")
        self._changes = _Changes(mountpoint, self._root)

    def _place(self, path: bytes) -> bytes:
        remote = normalise(self._root + b"/" + path)
        if remote != (self._mounted or ROOT) and not remote.startswith(self._mounted + b"/"):
            raise errors.NotFound(
                f"{name_text(remote)} lies outside of {name_text(self._mounted)}, which is mounted on "
                f"{os.fsdecode(self._mountpoint)}"
            )
        return self._mountpoint + remote[len(self._mounted) :].rstrip(b"/")

    def _place_to_change(self, path: bytes) -> bytes:
        if self._read_only:
            raise errors.ReadOnly(readonly.by_option(path))
        return self._place(path)

    async def stat(self, path: bytes) -> Stat:
        """As os.stat."""
        return _stat_of(await _call(path, os.stat, self._place(path)))

    async def list(self, path: bytes) -> list[tuple[bytes, Stat]]:
        """As os.scandir."""

        def scan(place: bytes) -> list[tuple[bytes, Stat]]:
            found = []
            with os.scandir(place) as entries:
                for entry in entries:
                    with suppress(FileNotFoundError):  # it was removed meanwhile, and the directory was not
                        found.append((entry.name, _stat_of(entry.stat())))
            return found

        return await _call(path, scan, self._place(path))

    async def open(
        self, path: bytes, *, write: bool = False, truncate: bool = False, append: bool = False
    ) -> MountedFile:
        """As os.open."""
        return await self._open(path, os.O_RDWR * write | os.O_TRUNC * truncate | os.O_APPEND * append)

    async def create(self, path: bytes, *, exclusive: bool) -> MountedFile:
        """As os.open with O_CREAT."""
        with _about_parent(path):
            return await self._open(path, os.O_RDWR | os.O_CREAT | (os.O_EXCL if exclusive else 0))

    async def _open(self, path: bytes, flags: int) -> MountedFile:
        writable = bool(flags & (os.O_RDWR | os.O_TRUNC))
        if writable and stays_local(path):
            raise errors.NotSupported(
                f"{name_text(path)} would stay in the mount's memory, as editors' swap files do, and never "
                "reach the card; choose another name, or unmount first"
            )
        place = self._place_to_change(path) if writable else self._place(path)
        opened: list[int] = []
        wanted = True

        def open_it() -> int:
            opened.append(os.open(place, flags | os.O_CLOEXEC, 0o666))
            if not wanted:
                drop()
                return 0
            return _size_of_opened(opened[0])

        def drop() -> None:
            with suppress(IndexError):  # the other thread does it
                fd = opened.pop()
                if flags & (os.O_TRUNC | os.O_CREAT):  # else its close would deliver an empty file
                    self._withdraw(place)
                os.close(fd)

        try:
            size = await self._changes.call(path, open_it)
        except BaseException:  # the thread may still wait for the mount
            wanted = False
            with trio.CancelScope(deadline=trio.current_time() + WITHDRAWAL_TIME, shield=True):
                await trio.to_thread.run_sync(drop, abandon_on_cancel=True)
            raise
        withdraw, writable = partial(self._withdraw, place), bool(flags & os.O_RDWR)
        return MountedFile(path, opened[0], size, self._changes, withdraw, writable)

    def _withdraw(self, place: bytes) -> bool | None:
        request = {"command": "withdraw", "path": os.fsdecode(place[len(self._mountpoint) :])}
        with suppress(errors.MavftpfsError):
            there = self._ask(request, timeout=WITHDRAWAL_TIME)["there"]
            return None if there is None else bool(there)
        return None

    async def truncate(self, path: bytes, size: int) -> None:
        """As os.truncate."""
        await self._changes.call(path, os.truncate, self._place_to_change(path), size)

    async def crc32(self, path: bytes) -> int:
        """Ask the vehicle."""
        try:
            return int(await _call(path, os.getxattr, self._place(path), XATTR_CRC32), 16)
        except errors.ReadOnly as exc:
            raise errors.Armed("checksums are not asked for in flight") from exc
        except errors.OtherRefusal:
            if (await self.stat(path)).kind is EntryKind.DIRECTORY:  # which has no such attribute
                raise errors.IsADirectory(_sentence(errors.IsADirectory, path)) from None
            raise

    async def mkdir(self, path: bytes) -> None:
        """As os.mkdir."""
        with _about_parent(path):
            await self._changes.call(path, os.mkdir, self._place_to_change(path))

    async def rmdir(self, path: bytes) -> None:
        """As os.rmdir."""
        await self._changes.call(path, os.rmdir, self._place_to_change(path))

    async def unlink(self, path: bytes) -> None:
        """As os.unlink."""
        await self._changes.call(path, os.unlink, self._place_to_change(path))

    async def rename(self, old: bytes, new: bytes) -> None:
        """As os.rename."""
        try:
            await self._changes.call(old, os.rename, self._place_to_change(old), self._place(new))
        except _ABOUT_TARGET as exc:
            raise type(exc)(_sentence(type(exc), new)) from exc
        except errors.InvalidMove as exc:
            raise errors.InvalidMove(f"{old!r} cannot become a part of itself") from exc
        except NotFound as exc:
            await self.stat(old)  # raises, if it is this one
            raise NotFound(_sentence(NotFound, split(new)[0])) from exc

    async def refresh(self) -> None:
        """Make the mount ask the vehicle again. Another user's mount may go on with what it knows."""
        ask = partial(self._ask, {"command": "forget"}, timeout=STATUS_PATIENCE)
        with suppress(errors.MavftpfsError):
            await trio.to_thread.run_sync(ask, abandon_on_cancel=True)

    def _ask(self, request: control.Reply, *, timeout: float) -> control.Reply:
        socket = control.find_socket(os.fsdecode(self._mountpoint), control.own_directories())
        return control.ask(socket, request, timeout=timeout)


def _stat_of(found: os.stat_result) -> Stat:
    kind = EntryKind.DIRECTORY if stat.S_ISDIR(found.st_mode) else EntryKind.FILE
    return Stat(kind, found.st_size, found.st_mtime_ns, 0.0)
