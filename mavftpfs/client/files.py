"""The vehicle's files, of a mount that is up or of a connection. Layer: client.

Two programs should not share the vehicle's only FTP session. So while a mount of the vehicle is up, commands
use its files (client/mountfiles.py) in place of a second connection. `Files` and `File` define the calls of
both. Paths are normalised (shared.model.normalise).
"""

from __future__ import annotations

import errno
import os
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import NoReturn, Protocol

import trio

from mavftpfs.cache.attributes import Stat
from mavftpfs.client.connect import NO_SINKS, Attached, Sinks, attached, no_answer
from mavftpfs.client.control import NobodyThere
from mavftpfs.client.mountfiles import MountFiles, connect
from mavftpfs.client.mounts import (
    STATUS_PATIENCE,
    Status,
    is_wanted,
    mounts_on,
    require_usable,
    status_of,
)
from mavftpfs.client.several import Unnamed, unnamed_by
from mavftpfs.client.status import Facts
from mavftpfs.link.base import plain_nursery
from mavftpfs.link.messages import Address, Heartbeat
from mavftpfs.link.uri import LinkSpec
from mavftpfs.shared import errors, readonly
from mavftpfs.shared.errors import NotFound
from mavftpfs.shared.model import ROOT, EntryKind, join, normalise
from mavftpfs.shared.options import Options
from mavftpfs.shared.readable import name_text

WITHDRAWAL_TIME = 45.0
"""Seconds to discard the changes of a file: a request or two without an answer."""
CLOSING_TIME = 5.0
"""Seconds to close a file without further uploads."""
READ_SIZE = 128 * 1024
_TICK = 0.2
"""Seconds between two checks whether a lost vehicle is heard again."""


class File(Protocol):
    """An open file: cache.openfile.OpenFile, or one of a mount's. All calls raise only MavftpfsError.

    `Writing` ends a file that is written.
    """

    @property
    def size(self) -> int:
        """The size in bytes, pending changes included."""

    @property
    def verified(self) -> str:
        """The comparison of the last fsync or release with the card: "size and CRC32", "size", or "" if
        nothing was sent."""

    async def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return `size` bytes at `offset`, or fewer at the end of the file."""

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """Write all of `data`, and return its length."""

    async def truncate(self, size: int) -> None:
        """Cut the file, or extend it with zeros; a pending change like written bytes."""

    async def fsync(self) -> None:
        """Upload pending changes; return when they are on the card, verified."""

    async def release(self) -> None:
        """Upload pending changes, and close the file even if that fails."""

    async def take_back(self) -> bool | None:
        """Close the file, and discard its pending changes: mavftpfs sends nothing of them later.

        Return whether the card has the written content, None if unknown.
        """


class Files(Protocol):
    """A tree of files: cache.tree.Tree, or that of a mount. All calls raise only MavftpfsError."""

    async def stat(self, path: bytes) -> Stat:
        """Return a path's attributes."""

    async def list(self, path: bytes) -> list[tuple[bytes, Stat]]:
        """Return the entries of a directory."""

    async def open(
        self, path: bytes, *, write: bool = False, truncate: bool = False, append: bool = False
    ) -> File:
        """Open an existing file; `truncate` empties it. append: for cache.texts: written bytes go to the
        end."""

    async def create(self, path: bytes, *, exclusive: bool) -> File:
        """Make a file, or open an existing one, for reading and writing."""

    async def crc32(self, path: bytes) -> int:
        """Return the vehicle's CRC32 of a file."""

    async def mkdir(self, path: bytes) -> None:
        """Make a directory."""

    async def rmdir(self, path: bytes) -> None:
        """Remove an empty directory."""

    async def unlink(self, path: bytes) -> None:
        """Remove a file."""

    async def rename(self, old: bytes, new: bytes) -> None:
        """Rename, replacing an existing file or directory as far as rename(2) allows."""

    async def refresh(self) -> None:
        """Drop the cached listings and data of the vehicle."""


@asynccontextmanager
async def reading(files: Files, path: bytes) -> AsyncIterator[File]:
    """Give an open file to the body, and close it.

    Raises:
        As Files.open.
    """
    file = await files.open(path)
    try:
        yield file
    finally:
        await close_reader(file)


async def close_reader(file: File) -> None:
    """Close a file that was only read, even if the task is cancelled."""
    with trio.CancelScope(deadline=trio.current_time() + CLOSING_TIME, shield=True):
        await file.release()


class Writing:
    """The end of a file that is written: delivery, or discarding. `there` has the result.

    Attributes:
        there: whether the card has the file as it was written. False: the card has the old file, or none, and
            nothing is sent later. None: unknown, or undecided.
    """

    def __init__(self, file: File) -> None:
        self._file = file
        self.there: bool | None = None

    async def deliver(self) -> None:
        """Close the file when all of it is on the card, verified.

        Raises:
            NotDelivered: the changes are discarded; the cause is attached.
        """
        try:
            await self._file.fsync()
        except BaseException as exc:
            await self.take_back(whole=True)
            self._raise_undelivered(exc)
        await self._file.release()

    async def fail(self, error: BaseException) -> NoReturn:
        """Discard the changes because writing the file failed, and raise that error.

        Raises:
            NotDelivered: in place of a MavftpfsError, which is its cause. Otherwise the error itself.
        """
        await self.take_back()
        self._raise_undelivered(error)

    async def take_back(self, *, whole: bool = False) -> None:
        """Close the file without delivering it. whole: all of it was written; otherwise its delivered bytes
        are a part."""
        with trio.CancelScope(deadline=trio.current_time() + WITHDRAWAL_TIME, shield=True):
            there = await self._file.take_back()
            self.there = None if there and not whole else there

    def _raise_undelivered(self, error: BaseException) -> NoReturn:
        if isinstance(error, errors.MavftpfsError):
            raise errors.NotDelivered(str(error), there=self.there) from error
        raise error


@asynccontextmanager
async def written(file: File) -> AsyncIterator[Writing]:
    """Write a file in the body. Deliver it after the body; discard its changes after an error.

    Raises:
        NotDelivered: see Writing.
    """
    writing = Writing(file)
    try:
        yield writing
    except BaseException as exc:
        await writing.fail(exc)
    await writing.deliver()


@dataclass(frozen=True, slots=True)
class Session:
    """A vehicle's files for the length of one command.

    status: returns the facts of `status --json` about vehicle, link and transfers. root: the vehicle's
    directory that is `/` in `files`. mountpoint: of the mount that serves the files, None for a connection of
    this program's own. patience: seconds to wait for a lost vehicle. unnamed: the vehicles on the link; None
    if SOURCE or the options name one. read_only: the user's options forbid changes.
    """

    files: Files
    status: Callable[[], Awaitable[Facts]]
    root: bytes = ROOT
    mountpoint: str | None = None
    patience: float = 0.0
    unnamed: Unnamed | None = None
    read_only: bool = False

    async def require_changeable(self, option: str) -> None:
        """Check, before a change, that the user allows changes, and can mean only this vehicle.

        Raises:
            ReadOnly. UsageError: several vehicles are on the link, and the user named none.
        """
        if self.read_only:
            raise errors.ReadOnly(readonly.NOTHING_BY_OPTION)
        if self.unnamed is not None:
            await self.unnamed.require_one(option)

    @asynccontextmanager
    async def noting_others(self, tell: Callable[[str], None], option: str) -> AsyncIterator[None]:
        """Print a line once during the body if the user may mean another vehicle."""
        async with nullcontext() if self.unnamed is None else self.unnamed.noted(tell, option):
            yield

    async def lost(self) -> bool:
        """Return whether the vehicle is lost.

        Raises:
            LinkClosed: the mount is gone.
        """
        return (await self.status())["link"]["state"] in ("lost", "replaced")

    async def returned(self) -> bool:
        """Wait for a lost vehicle; return whether it was heard again in time. Raises: as `lost`."""
        with trio.move_on_after(self.patience):
            while await self.lost():  # noqa: ASYNC110 (a mount is asked)
                await trio.sleep(_TICK)
            return True
        return False

    def on_vehicle(self, path: bytes) -> bytes:
        """Return the path of a file on the vehicle."""
        return self.root.rstrip(b"/") + path if path != b"/" else self.root

    def text_of(self, path: bytes) -> str:
        """Return the path of a file on the vehicle as in `status --json`."""
        return self.on_vehicle(path).decode(errors="replace")

    async def size_now(self, path: bytes) -> int:
        """Ask the vehicle for a file's size, even if one is known."""
        await self.files.refresh()
        return (await self.files.stat(path)).size


async def is_directory(files: Files, path: bytes) -> bool:
    """Return whether a path is a directory; False if it does not exist."""
    try:
        return (await files.stat(path)).kind is EntryKind.DIRECTORY
    except NotFound:
        return False


Found = list[tuple[bytes, Stat]]
"""Everything below a directory: (path from there, attributes)."""
Unlisted = list[tuple[bytes, errors.MavftpfsError]]
"""Directories that cannot be listed, with the reasons."""


async def walk(files: Files, top: bytes) -> tuple[Found, Unlisted]:
    """Return everything below a directory, parents first, and the directories that could not be listed.

    Raises:
        LinkError; for `top` itself the errors of Files.list.
    """
    found: Found = []
    unlisted: Unlisted = []
    pending = [b""]
    while pending:
        below = pending.pop()
        path = join(top, below) if below else top
        try:
            entries = await files.list(path)
        except errors.MavftpfsError as exc:
            if not below or isinstance(exc, errors.LinkError):
                raise
            unlisted.append((path, exc))
            continue
        inner = [(join(below, name) if below else name, stat) for name, stat in entries]
        found += inner
        pending += [name for name, stat in reversed(inner) if stat.kind is EntryKind.DIRECTORY]
    return found, unlisted


# -- which mount ----------------------------------------------------------------------------------


@asynccontextmanager
async def open_mount(mountpoint: str, subtree: bytes, options: Options) -> AsyncIterator[Session]:
    """Give the files below `subtree` of a mount to the body.

    Raises:
        LinkClosed: the mount does not answer. NotFound, NotADirectory: the subtree is not a directory.
        UsageError: the options ask for another vehicle or component.
    """
    status = await usable_status(mountpoint)
    if "members" in status:
        names = [member["name"] for member in status["members"]]
        example = f"{mountpoint}/{names[0] if names else 1}"
        raise errors.UsageError(
            f"{mountpoint} is for several vehicles ({', '.join(names) or 'none yet'}); name one, as {example}"
        )
    system, component = status["vehicle"]["system"], status["vehicle"]["component"]
    if options.target_system not in (0, system) or options.target_component not in (0, component):
        raise errors.UsageError(f"{mountpoint} is the mount of vehicle {system}/{component}")
    root = normalise(os.fsencode(status["root"]) + b"/" + subtree)
    async with _session_on(status, mountpoint, root, options) as session:
        if subtree != ROOT:
            place = name_text(os.fsencode(mountpoint) + subtree)
            try:
                kind = (await session.files.stat(ROOT)).kind
            except errors.NotFound as exc:
                raise errors.NotFound(f"{place}: {os.strerror(errno.ENOENT)}") from exc
            if kind is EntryKind.FILE:
                raise errors.NotADirectory(
                    f"{place} is a file; give a directory, and the file's name behind it"
                )
        yield session


@asynccontextmanager
async def _session_on(
    status: Status, mountpoint: str, root: bytes, options: Options
) -> AsyncIterator[Session]:
    """Give the files below `root` of a vehicle to the body, by the mount with this status."""
    dial = partial(connect, status, mountpoint)
    files = MountFiles(dial, mountpoint, os.fsencode(status["root"]), root)
    try:
        yield Session(
            files,
            files.status,
            root,
            mountpoint,
            options.connect_timeout,
            read_only=options.read_only,
        )
    finally:
        files.close()


async def usable_status(mountpoint: str) -> Status:
    """Return the status of a mount.

    Raises:
        LinkClosed: the mount does not answer, or does not serve this program; the text gives the reason.
    """
    ask = partial(status_of, mountpoint, STATUS_PATIENCE)
    try:
        status = await trio.to_thread.run_sync(ask, abandon_on_cancel=True)
    except NobodyThere as exc:
        raise errors.LinkClosed(str(exc)) from exc
    require_usable(status, mountpoint)
    return status


async def find_mount(spec: LinkSpec, options: Options) -> Status | None:
    """Return the status of the mount that has this link, if it has the wanted vehicle and serves this user.

    Raises:
        LinkClosed: the mount has another version.
    """
    look = partial(mounts_on, spec)
    for status in await trio.to_thread.run_sync(look, abandon_on_cancel=True):
        if is_wanted(status, options):
            require_usable(status, status["mountpoint"])
            return status
    return None


async def vehicles_below(mountpoint: str) -> dict[str, str]:
    """Return the mountpoint of each vehicle of a mount of several, by name; "" for one that is not mounted
    now.

    Raises:
        LinkClosed: the mount does not answer. UsageError: the mount has a single vehicle.
    """
    status = await usable_status(mountpoint)
    if "members" not in status:
        raise errors.UsageError(
            f"only one vehicle is mounted on {mountpoint}; name a FILE to compare it with"
        )
    return {
        member["name"]: os.path.join(mountpoint, member["name"]) if member["state"] == "mounted" else ""
        for member in status["members"]
    }


def _heard_by(status: Status, spec: LinkSpec) -> Unnamed:
    """Return the vehicles that a mount hears on its link."""
    heard = heartbeats_in(status)
    return Unnamed(spec.description, status["vehicle"]["system"], lambda: heard)


def heartbeats_in(status: Status) -> list[Heartbeat]:
    """Return the heartbeats that a mount heard from the components on its link."""
    return [
        Heartbeat(Address(*facts["source"]), facts["vehicle_type"], facts["autopilot"], facts["armed"])
        for facts in status["connection"]["heard"]
    ]


@dataclass(frozen=True, slots=True)
class Target:
    """The vehicle, and the way to it. mount: (mountpoint, subtree) if SOURCE was a mountpoint."""

    spec: LinkSpec | None
    options: Options
    sinks: Sinks = NO_SINKS
    mount: tuple[str, bytes] | None = None

    @asynccontextmanager
    async def mounted(self) -> AsyncIterator[Session | None]:
        """Give the files of a usable mount to the body, None if there is none."""
        if self.mount is not None:
            async with open_mount(*self.mount, self.options) as session:
                yield session
            return
        assert self.spec is not None
        status = await find_mount(self.spec, self.options)
        if status is None:
            yield None
            return
        unnamed = None if self.options.target_system else _heard_by(status, self.spec)
        root = self.options.root
        async with _session_on(status, status["mountpoint"], root, self.options) as session:
            if root != ROOT and (await session.files.stat(ROOT)).kind is EntryKind.FILE:
                raise errors.NotADirectory(f"{root!r} is not a directory")
            yield replace(session, unnamed=unnamed)

    @asynccontextmanager
    async def session(
        self, *, writing: bool = False, list_root: bool = False, use_mount: bool = True
    ) -> AsyncIterator[Session]:
        """Give the vehicle's files for the length of the body.

        list_root: wait for an FTP answer first; otherwise the body's first request serves for that.

        Raises:
            LinkClosed, VehicleLost, NoFtp: no answer within connect_timeout, with the reason.
        """
        async with self.mounted() if use_mount else nullcontext() as mounted:
            if mounted is not None:
                yield mounted
                return
        assert self.spec is not None
        deadline = trio.current_time() + self.options.connect_timeout
        up = attached(self.spec, self.options, sinks=self.sinks, list_root=list_root, writing=writing)
        async with up as vehicle, _answered_by(deadline, vehicle, self.options):
            yield replace(
                session_of(vehicle, self.options), unnamed=unnamed_by(vehicle.connection, self.options)
            )


def session_of(vehicle: Attached, options: Options) -> Session:
    """Return the files of a connection of this program's own."""

    async def status() -> Facts:
        return vehicle.status()

    return Session(
        vehicle.tree, status, options.root, None, options.connect_timeout, read_only=options.read_only
    )


@asynccontextmanager
async def _answered_by(deadline: float, vehicle: Attached, options: Options) -> AsyncIterator[None]:
    """Cancel the body if the vehicle answered no FTP request by the deadline.

    Raises:
        NoFtp: as a mount says it.
    """
    connection = vehicle.connection
    over = trio.CancelScope()

    async def watch() -> None:
        await trio.sleep_until(deadline)
        if connection.engine.stats.replies == 0:
            over.cancel()

    async with plain_nursery() as nursery:
        nursery.start_soon(watch)
        with over:
            yield
    if over.cancelled_caught:
        raise no_answer(connection, options)
