"""A vehicle's files for trio programs: `mavftpfs.trio`. Layer: api."""

from __future__ import annotations

import errno
import io
import logging
import os
import stat
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import trio

from mavftpfs.api import params
from mavftpfs.api.errors import os_error, translated
from mavftpfs.api.opened import Opened
from mavftpfs.api.portal import TaskPortal
from mavftpfs.api.pythonfile import Mode, python_file
from mavftpfs.api.triofile import AsyncFile
from mavftpfs.cache.attributes import Stat
from mavftpfs.client import download, names, upload
from mavftpfs.client.choice import Choice
from mavftpfs.client.connect import open_sinks, plain_nursery
from mavftpfs.client.fetch import Fetcher, known_time
from mavftpfs.client.files import File, Files, Session, walk
from mavftpfs.client.options import options_of
from mavftpfs.client.progress import Progress
from mavftpfs.client.proof import Verify
from mavftpfs.client.several import IN_PYTHON
from mavftpfs.client.source import target_of
from mavftpfs.shared.errors import AlreadyExists, IsADirectory, NotADirectory, NotFound, UsageError
from mavftpfs.shared.model import ROOT, EntryKind, join, normalise, split

log = logging.getLogger("mavftpfs.api")
logging.getLogger("mavftpfs.cache").addHandler(logging.NullHandler())
"""The caches' warnings are raised as errors, too: a program without logging sees them once."""

PathLike = str | bytes | os.PathLike[str]
"""A path on the vehicle. A relative one begins at the root."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A file or directory. size: bytes; mtime: seconds since 1970 UTC, None if the vehicle does not tell."""

    name: str
    path: str
    size: int
    mtime: float | None
    kind: EntryKind

    def is_dir(self) -> bool:
        """Return whether it is a directory."""
        return self.kind is EntryKind.DIRECTORY

    def is_file(self) -> bool:
        """Return whether it is a file."""
        return self.kind is EntryKind.FILE


def remote(path: PathLike) -> bytes:
    """Return a path as the client has it.

    Raises:
        LocalProtocolError: it holds `..` or NUL.
    """
    return normalise(b"/" + os.fsencode(path))


def names_directory(path: PathLike) -> bool:
    """Return whether a path ends in a slash."""
    return os.fsencode(path).endswith(b"/")


def entry(path: bytes, stat: Stat) -> Entry:
    """Return what a program gets for a path."""
    mtime = None if known_time(stat.mtime) is None else stat.mtime_ns / 1e9
    name = split(path)[1]
    return Entry(os.fsdecode(name), os.fsdecode(path), stat.size, mtime, stat.kind)


class Drone:
    """A vehicle's files. Made by `connect`; every call may be made by several tasks at once.

    Paths are text, bytes or path-like. Errors are OSErrors of the right kind (FileNotFoundError,
    PermissionError, TimeoutError ...), whose text is a sentence for people.

    Attributes:
        source: as it was given. mountpoint: of the mount whose files these are; None for a connection of its
            own.
    """

    def __init__(self, source: str, session: Session, nursery: trio.Nursery) -> None:
        self.source = source
        self.mountpoint = session.mountpoint
        self._session = session
        self._nursery = nursery
        self._opened: set[Opened] = set()
        self._is_meant = False  # the vehicle is known to be the one that the program changes

    def __repr__(self) -> str:
        return f"<Drone {self.source}>"

    @property
    def _files(self) -> Files:
        return self._session.files

    @property
    def has_open_files(self) -> bool:
        """Whether a file of it is open."""
        return bool(self._opened)

    @asynccontextmanager
    async def _changing(self) -> AsyncIterator[None]:
        """Translate the errors of a body that changes something on the vehicle. Raises: see below, too."""
        with translated():
            await self._require_one_vehicle()
            yield

    async def _require_one_vehicle(self) -> None:
        """Check before the first change that no other vehicle may be meant. One that comes later is not.

        Raises:
            UsageError: several vehicles are on the link, and `target_system` does not name one.
        """
        if not self._is_meant:
            await self._session.require_one_vehicle(IN_PYTHON)
            self._is_meant = True

    async def _existing(self, path: PathLike) -> bytes:
        """Return a path as the client has it. If it ends in a slash, it is checked that it is no file.

        Raises:
            NotADirectory, NotFound: it ends in a slash.
        """
        wanted = remote(path)
        if names_directory(path) and (await self._files.stat(wanted)).kind is EntryKind.FILE:
            raise NotADirectory(f"{wanted!r} is not a directory")
        return wanted

    # --- looking

    async def stat(self, path: PathLike) -> Entry:
        """Return what a path is.

        Raises:
            FileNotFoundError, NotADirectoryError.
        """
        with translated():
            wanted = await self._existing(path)
            return entry(wanted, await self._files.stat(wanted))

    async def scandir(self, path: PathLike = "/") -> list[Entry]:
        """Return what is in a directory. An incomplete listing is an error.

        Raises:
            FileNotFoundError, NotADirectoryError.
        """
        with translated():
            wanted = remote(path)
            return [entry(join(wanted, name), stat) for name, stat in await self._files.list(wanted)]

    async def listdir(self, path: PathLike = "/") -> list[str]:
        """Return the names in a directory."""
        return [found.name for found in await self.scandir(path)]

    async def walk(self, path: PathLike = "/") -> list[Entry]:
        """Return all that is below a directory, parents first.

        Raises:
            As scandir, of any directory below, too.
        """
        with translated():
            top = remote(path)
            found, unlisted = await walk(self._files, top)
            for _, error in unlisted:
                raise error
            return [entry(join(top, below), stat) for below, stat in found]

    async def exists(self, path: PathLike) -> bool:
        """Return whether there is something of that name."""
        return await self._kind(path) is not None

    async def is_dir(self, path: PathLike) -> bool:
        """Return whether there is a directory of that name."""
        return await self._kind(path) is EntryKind.DIRECTORY

    async def is_file(self, path: PathLike) -> bool:
        """Return whether there is a file of that name."""
        return await self._kind(path) is EntryKind.FILE

    async def _kind(self, path: PathLike) -> EntryKind | None:
        with translated():
            try:
                return (await self._files.stat(await self._existing(path))).kind
            except (NotFound, NotADirectory):
                return None

    async def crc32(self, path: PathLike) -> int:
        """Have the vehicle compute a file's CRC32: start value 0, and no final xor."""
        with translated():
            return await self._files.crc32(await self._existing(path))

    async def status(self) -> dict[str, Any]:
        """Return what `mavftpfs status --json` tells of vehicle, link and transfers."""
        with translated():
            return dict(await self._session.status())

    async def refresh(self) -> None:
        """Forget what is remembered of the vehicle, so that it is asked again; others may have changed it."""
        await self._files.refresh()

    # --- parameters

    async def get_params(self) -> dict[str, int | float]:
        """Return all parameters, in the vehicle's order.

        Raises:
            FileNotFoundError: the vehicle does not offer them by MAVLink FTP.
        """
        with translated():
            return await params.get_values(self._session)

    async def set_params(self, values: Mapping[str, int | float]) -> None:
        """Set parameters; each is read back. See api.params.Params.update."""
        async with self._changing():
            await params.set_values(self._session, values)

    # --- changing names

    async def mkdir(self, path: PathLike, *, parents: bool = False, exist_ok: bool = False) -> None:
        """Make a directory, and with `parents` those above it.

        Raises:
            FileExistsError, FileNotFoundError.
        """
        async with self._changing():
            wanted = remote(path)
            if wanted == ROOT:
                if exist_ok:
                    return
                raise AlreadyExists("the root is there")
            for above in names.ancestors(wanted) if parents else []:
                await names.make_directory(self._files, above, may_exist=True)
            await names.make_directory(self._files, wanted, may_exist=exist_ok)

    async def rmdir(self, path: PathLike) -> None:
        """Remove an empty directory."""
        async with self._changing():
            await names.remove_directories(self._session, [remote(path)])

    async def remove(self, path: PathLike, *, recursive: bool = False) -> None:
        """Remove a file; with `recursive` a directory with all below, too.

        Raises:
            FileNotFoundError, IsADirectoryError.
        """
        async with self._changing():
            wanted = await self._existing(path)
            names.refuse_root([wanted])
            if recursive:
                await names.remove_paths(self._session, [wanted], recursive=True)
            else:
                await self._files.unlink(wanted)

    unlink = remove

    async def rename(self, old: PathLike, new: PathLike) -> None:
        """Rename, over a file that is there. Where the card cannot rename it is copied, then removed."""
        async with self._changing():
            source, target = await self._existing(old), remote(new)
            if names_directory(new) and (await self._files.stat(source)).kind is EntryKind.FILE:
                raise NotADirectory(f"{source!r} is not a directory")
            await names.move(self._files, source, target)

    async def copy(self, old: PathLike, new: PathLike) -> None:
        """Copy a file, by way of this computer."""
        async with self._changing():
            source = await self._existing(old)
            if names_directory(new):
                raise IsADirectory(f"{remote(new)!r} is a directory")
            await names.copy(self._files, source, remote(new))

    async def truncate(self, path: PathLike, size: int) -> None:
        """Cut a file, or extend it by zeros."""
        if size < 0:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        async with self._changing():
            await self._files.truncate(await self._existing(path), size)

    # --- whole files

    async def read_bytes(self, path: PathLike) -> bytes:
        """Return a file's content."""
        opened = await self.open_raw(path, "r")
        try:
            return await opened.read_to_end(0)
        finally:
            await opened.close()

    async def write_bytes(self, path: PathLike, data: bytes) -> None:
        """Make a file or replace its content; back when it is on the card, checked.

        Raises:
            NotDelivered: it is not; see there.
        """
        view = memoryview(data).cast("B")
        opened = await self.open_raw(path, "w")
        try:
            await opened.write(0, view)
        finally:
            await opened.close()

    async def read_text(self, path: PathLike, encoding: str = "utf-8") -> str:
        """Return a file's content as text, each end of a line as `\\n`."""
        return io.TextIOWrapper(io.BytesIO(await self.read_bytes(path)), encoding).read()

    async def write_text(self, path: PathLike, text: str, encoding: str = "utf-8") -> None:
        """Make a file or replace its content by a text."""
        await self.write_bytes(path, text.encode(encoding))

    # --- many files

    async def get(
        self,
        path: PathLike,
        local: str | os.PathLike[str] = ".",
        *,
        recursive: bool = False,
        verify: Verify = "auto",
    ) -> list[Path]:
        """Fetch a file, or with `recursive` a directory, proven; return the local files.

        A file goes into `local` if that is a directory, else it gets that name. A directory goes into
        `local`.

        Raises:
            OSError: something did not come; the text says how much did.
        """

        async def work(downloads: download.Downloads) -> None:
            wanted = await self._existing(path)
            try:
                await downloads.get([wanted], Path(local), into=False, recursive=recursive)
            except IsADirectory as exc:
                raise IsADirectory(f"{wanted!r} is a directory; get it with recursive=True") from exc

        outcome = await self._download(verify, work)
        return [*(fetched.wanted.local for fetched in outcome.fetched), *(one.local for one in outcome.here)]

    async def sync(
        self,
        local: str | os.PathLike[str],
        *,
        place: PathLike | None = None,
        newest: int | None = None,
        since: float | None = None,
        verify: Verify = "auto",
    ) -> list[Path]:
        """Bring the vehicle's logs as `mavftpfs sync` does, and return those that are new here.

        place: their directory on the vehicle; None to find it. newest: at most so many; since: not older,
        seconds since 1970 UTC.

        Raises:
            OSError: a log did not come; the text says how many did.
        """
        where = None if place is None else remote(place)
        wish = download.Wish(Path(local), where, Choice(newest, since))
        outcome = await self._download(verify, lambda downloads: downloads.sync(wish))
        return [fetched.wanted.local for fetched in outcome.fetched]

    async def _download(
        self, verify: Verify, work: Callable[[download.Downloads], Awaitable[None]]
    ) -> download.Outcome:
        outcome = download.Outcome()
        fetcher = Fetcher(self._session, Progress(), verify)
        with translated():
            await work(download.Downloads(fetcher, outcome, _ignore, _ignore))
        for path, error in outcome.failed.items():
            count, of = len(outcome.fetched) + len(outcome.here), len(outcome.wanted) + len(outcome.here)
            raise os_error(error, f"{download.named(path, error)}; {count} of {of} files are here") from error
        return outcome

    async def put(
        self, local: str | os.PathLike[str], path: PathLike, *, recursive: bool = False
    ) -> list[str]:
        """Put a file, or with `recursive` a directory, on the vehicle; return the paths that are there.

        `path` is an existing directory, or the new name.

        Raises:
            FileNotFoundError, IsADirectoryError: of `local`. NotDelivered: a file is not there; see there.
        """
        told: list[str] = []
        async with self._changing():
            if stat.S_ISDIR(os.stat(local).st_mode) and not recursive:
                raise IsADirectory(f"{os.fspath(local)} is a directory; put it with recursive=True")
            found = upload.collect(Path(local), recursive=recursive)
            batches = [(Path(local), found)]
            tell = lambda where, size, how: told.append(os.fsdecode(where))  # noqa: E731
            into = names_directory(path)
            await upload.put_paths(self._session, batches, remote(path), Progress(), tell, into=into)
        return told

    # --- opening

    async def open(
        self,
        path: PathLike,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
    ) -> AsyncFile:
        """Open a file as the builtin does; its methods are async, as those of trio.open_file.

        Text is UTF-8 unless `encoding` says otherwise. What was written is on the card, checked, when
        `aclose` returns.

        Raises:
            FileNotFoundError, FileExistsError, IsADirectoryError ... ValueError: of the mode.
        """
        how = Mode(mode, buffering, encoding, errors, newline)
        opened = await self.open_raw(path, how.plain)
        return AsyncFile(python_file(opened, TaskPortal(self._nursery), how), opened)

    async def open_raw(self, path: PathLike, mode: str) -> Opened:
        """Open a file without any buffer; mode: r, w, a or x, perhaps with +."""
        with translated():
            if mode != "r":
                await self._require_one_vehicle()
            wanted, files = remote(path), self._files
            if mode[0] == "r":
                await self._existing(path)
            elif names_directory(path):
                raise IsADirectory(f"{wanted!r} is a directory")
            match mode[0]:
                case "r":
                    file = await files.open(wanted, write="+" in mode)
                case "w":
                    file = await names.emptied(files, wanted)
                case "x":
                    file = await files.create(wanted, exclusive=True)
                case _:
                    file = await _opened_or_made(files, wanted)
        opened = Opened(os.fsdecode(wanted), file, writable=mode != "r", forget=self._opened.discard)
        self._opened.add(opened)
        return opened

    async def close_files(self) -> None:
        """Close the open files, take back what was written to them, and log it."""
        for opened in list(self._opened):
            if opened.writable:
                log.error("%s was not closed: what was written to it is withdrawn", opened.name)
            await opened.abandon()


async def _opened_or_made(files: Files, path: bytes) -> File:
    try:
        return await files.open(path, write=True, append=True)
    except NotFound:
        return await files.create(path, exclusive=False)


def _ignore(told: object) -> None:
    """Nothing is shown of single files."""


@asynccontextmanager
async def connect(source: str, *, use_mount: bool = True, **options: object) -> AsyncIterator[Drone]:
    """Give a vehicle's files to the body; return after its session is closed.

    source: as for `mavftpfs`: a link (`udpin:0.0.0.0:14550`, `/dev/ttyACM0`), or where it is mounted. A mount
    of that vehicle that is up is used, unless `use_mount` is False. options: those of a mount, by name:
    `target_system=2, signing_key="key", ro=True`.

    Raises:
        TimeoutError: no vehicle, or none that answers, within `connect_timeout`. OSError: the link cannot be
        opened. UsageError (a ValueError): source or an option is wrong; the text names it.
    """
    with translated():
        # A mount keeps editors' swap files in memory, but a program's files are meant for the card.
        target = target_of(source, replace(options_of(options), local=()))
        if target.mount is not None and not use_mount:
            raise UsageError(f"{source} is a mount, and use_mount=False refuses it; name the vehicle's link")
        with open_sinks(target.options, debug=False, tell=log.info) as sinks:
            target = replace(target, sinks=sinks)
            up = target.session(writing=True, list_root=True, use_mount=use_mount)
            async with (
                up as session,
                session.noting_others(log.warning, IN_PYTHON),
                plain_nursery() as nursery,
            ):
                drone = Drone(source, session, nursery)
                try:
                    yield drone
                finally:
                    with trio.CancelScope(shield=True):
                        await drone.close_files()
