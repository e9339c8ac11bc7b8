"""The files of a mount that is up, as the one-shot verbs use them. Layer: top.

Two programs cannot share a serial port, and not well the vehicle's only FTP session, so while a mount of the
vehicle is up its files are used in place of a second connection. Every call goes through the kernel, in a
thread: a mount may have to wait for its vehicle.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import trio

from mavftpfs import control
from mavftpfs.cache.attributes import Stat
from mavftpfs.fuse.operations import XATTR_CRC32, XATTR_STATUS
from mavftpfs.fuse.options import MountOptions
from mavftpfs.link.uri import LinkKind, LinkSpec, parse_source
from mavftpfs.mountpoint import canonical, is_ours, mounts
from mavftpfs.oneshot.files import Session, Transfers
from mavftpfs.shared import errors
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.model import ROOT, EntryKind, normalise
from mavftpfs.shared.readable import name_text

STATUS_PATIENCE = 3.0
"""Seconds for a mount to say what it is of; one that does not is not used."""

ResultT = TypeVar("ResultT")


# -- which mount ----------------------------------------------------------------------------------


def mountpoint_of(source: str) -> tuple[str, bytes] | None:
    """Return (mountpoint, subtree) where SOURCE is a mountpoint of ours, else None."""
    place, _, subtree = source.partition("#")
    if not place or (":" in place and not place.startswith("/")):
        return None
    path = canonical(place)
    return (path, normalise(os.fsencode(subtree))) if is_ours(path) else None


async def find_mount(spec: LinkSpec, options: MountOptions) -> Session | None:
    """Return the files of the mount that holds this link now, if one is up and may be read by us."""
    for mountpoint in [path for path in mounts() if is_ours(path)]:
        with suppress(errors.MavftpfsError, ValueError, KeyError, TypeError):
            status = await _status(mountpoint)
            if not _is_wanted(status["vehicle"], options):
                continue
            if same_link(parse_source(status["source"]), spec):
                return session_on(mountpoint, _root_of(status), options.root)
    return None


def _is_wanted(vehicle: Mapping[str, Any], options: MountOptions) -> bool:
    is_system = options.target_system in (0, vehicle["system"])
    return is_system and options.target_component in (0, vehicle["component"])


async def open_mount(mountpoint: str, subtree: bytes) -> Session:
    """Return the files below `subtree` of a mount.

    Raises:
        LinkClosed: it does not answer.
    """
    root = _root_of(await _status(mountpoint))
    return session_on(mountpoint, root, normalise(root + b"/" + subtree))


def session_on(mountpoint: str, mounted: bytes, root: bytes) -> Session:
    """Return the files below `root` of the vehicle, of which `mounted` is on `mountpoint`."""

    async def transfers() -> Transfers:
        found = (await _status(mountpoint))["transfers"]
        return [
            {"path": facts["path"], "size": facts["size"], "bytes_left": facts["size"] - facts["done"]}
            for facts in found
            if facts["direction"] == "write"
        ]

    return Session(MountedFiles(mountpoint, mounted, root), root, transfers, mountpoint)


def same_link(one: LinkSpec, other: LinkSpec) -> bool:
    """Return whether two SOURCEs cannot be open at once, because they are the same link."""
    if one.kind is not other.kind:
        return False
    if one.kind is LinkKind.SERIAL:
        return os.path.realpath(one.device) == os.path.realpath(other.device)
    if one.port != other.port:
        return False
    listens = one.kind in (LinkKind.UDP_IN, LinkKind.TCP_IN)
    return one.host == other.host or (listens and bool({one.host, other.host} & {"0.0.0.0", "::"}))


async def mount_status(mountpoint: str) -> Mapping[str, Any]:
    """Return a mount's status.

    Raises:
        LinkClosed: it does not answer.
    """
    return await _status(mountpoint)


async def _status(mountpoint: str) -> Mapping[str, Any]:
    with trio.move_on_after(STATUS_PATIENCE):
        text = await _in_thread(lambda: os.getxattr(mountpoint, XATTR_STATUS), ROOT)
        facts: Mapping[str, Any] = json.loads(text)
        return facts
    raise errors.LinkClosed(f"the mount on {mountpoint} does not answer")


def _root_of(status: Mapping[str, Any]) -> bytes:
    return os.fsencode(str(status["root"]))


# -- its files ------------------------------------------------------------------------------------

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
    errno.EAGAIN: errors.NotDeliveredYet,  # only the checksum says it, also while armed
}


def _translated(error: OSError, path: bytes) -> errors.MavftpfsError:
    kind = _BY_ERRNO.get(error.errno or 0, errors.MavftpfsError)
    hint = " (the vehicle is armed, or mounted with ro)" if kind is errors.ReadOnly else ""
    return kind(f"{name_text(path)}: {os.strerror(error.errno or errno.EIO)}{hint}")


async def _in_thread(function: Callable[[], ResultT], path: bytes) -> ResultT:
    try:
        return await trio.to_thread.run_sync(function, abandon_on_cancel=True)
    except OSError as exc:
        raise _translated(exc, path) from exc


@dataclass(slots=True)
class MountedFile:
    """An open file of a mount."""

    path: bytes
    fd: int
    size: int

    async def read(self, offset: int, size: int) -> bytes:
        """See files.File."""
        return await _in_thread(lambda: os.pread(self.fd, size, offset), self.path)

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """See files.File."""
        return await _in_thread(lambda: os.pwrite(self.fd, data, offset), self.path)

    async def fsync(self) -> None:
        """See files.File."""
        await _in_thread(lambda: os.fsync(self.fd), self.path)

    def close(self) -> None:
        """See files.File; what was written was brought there by fsync."""
        fd, self.fd = self.fd, -1
        if fd >= 0:
            with suppress(OSError):
                os.close(fd)


class MountedFiles:
    """Implements files.Files."""

    def __init__(self, mountpoint: str, mounted: bytes, root: bytes) -> None:
        """`mounted`: what of the vehicle is on the mountpoint; `root`: what of it is our `/`."""
        self._mountpoint = os.fsencode(mountpoint)
        self._mounted = mounted.rstrip(b"/")
        self._root = root.rstrip(b"/")

    def _place(self, path: bytes) -> bytes:
        remote = normalise(self._root + b"/" + path)
        if remote != (self._mounted or ROOT) and not remote.startswith(self._mounted + b"/"):
            raise errors.NotFound(
                f"{name_text(remote)} lies outside of {name_text(self._mounted)}, which is mounted on "
                f"{os.fsdecode(self._mountpoint)}"
            )
        return self._mountpoint + remote[len(self._mounted) :].rstrip(b"/")

    async def stat(self, path: bytes) -> Stat:
        """See files.Files."""
        place = self._place(path)
        return _stat_of(await _in_thread(lambda: os.stat(place), path))

    async def list(self, path: bytes) -> list[tuple[bytes, Stat]]:
        """See files.Files."""
        place = self._place(path)

        def scan() -> list[tuple[bytes, Stat]]:
            with os.scandir(place) as entries:
                return [(entry.name, _stat_of(entry.stat())) for entry in entries]

        return await _in_thread(scan, path)

    async def open(self, path: bytes, *, write: bool = False, truncate: bool = False) -> MountedFile:
        """See files.Files."""
        flags = (os.O_RDWR if write else os.O_RDONLY) | (os.O_TRUNC if truncate else 0)
        return await self._open(path, flags)

    async def create(self, path: bytes, *, exclusive: bool) -> MountedFile:
        """See files.Files."""
        return await self._open(path, os.O_RDWR | os.O_CREAT | (os.O_EXCL if exclusive else 0))

    async def _open(self, path: bytes, flags: int) -> MountedFile:
        place = self._place(path)

        def opened() -> tuple[int, int]:
            fd = os.open(place, flags | os.O_CLOEXEC, 0o666)
            return fd, os.fstat(fd).st_size

        return MountedFile(path, *await _in_thread(opened, path))

    async def crc32(self, path: bytes) -> int:
        """See files.Files."""
        place = self._place(path)
        return int(await _in_thread(lambda: os.getxattr(place, XATTR_CRC32), path), 16)

    async def mkdir(self, path: bytes) -> None:
        """See files.Files."""
        place = self._place(path)
        await _in_thread(lambda: os.mkdir(place), path)

    async def rmdir(self, path: bytes) -> None:
        """See files.Files."""
        place = self._place(path)
        await _in_thread(lambda: os.rmdir(place), path)

    async def unlink(self, path: bytes) -> None:
        """See files.Files."""
        place = self._place(path)
        await _in_thread(lambda: os.unlink(place), path)

    async def rename(self, old: bytes, new: bytes) -> None:
        """See files.Files."""
        source, target = self._place(old), self._place(new)
        await _in_thread(lambda: os.rename(source, target), old)

    def expire(self, path: bytes) -> None:
        """See files.Files."""
        self.forget_caches()

    def forget_caches(self) -> None:
        """Have the mount ask the vehicle again; a mount of somebody else may go on with what it knows."""
        with suppress(errors.MavftpfsError):
            socket = control.find_socket(os.fsdecode(self._mountpoint), control.own_directories())
            control.ask(socket, {"command": "forget"}, timeout=STATUS_PATIENCE)


def _stat_of(found: os.stat_result) -> Stat:
    kind = EntryKind.DIRECTORY if (found.st_mode & 0o170000) == 0o040000 else EntryKind.FILE
    return Stat(kind, found.st_size, int(found.st_mtime), 0.0)
