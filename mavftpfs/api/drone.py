"""A vehicle's files for programs and notebooks: `mavftpfs.connect`. Layer: api.

The calls are synchronous. The event loop's thread (`api.portal`) does their work.
"""

from __future__ import annotations

import logging
import os
import stat
import warnings
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import partial, wraps
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Concatenate, ParamSpec, TypeVar

import trio

from mavftpfs.api.entry import Entry, PathLike, entry, names_directory, remote
from mavftpfs.api.errors import NotDelivered, UsageError, os_error, translated
from mavftpfs.api.opened import Opened
from mavftpfs.api.params import Number, Params, get_values, set_values
from mavftpfs.api.portal import LoopThread
from mavftpfs.api.pythonfile import Mode, python_file
from mavftpfs.api.wanted import Patterns, Since, selection_of, verify_of
from mavftpfs.client import download, logs, names, upload
from mavftpfs.client.compare import Verify
from mavftpfs.client.connect import open_sinks
from mavftpfs.client.fetch import Fetcher
from mavftpfs.client.files import File, Files, Session, Target, is_directory, walk
from mavftpfs.client.options import options_of
from mavftpfs.client.progress import Progress
from mavftpfs.client.several import IN_PYTHON
from mavftpfs.client.source import target_of
from mavftpfs.shared.errors import AlreadyExists, IsADirectory, NotADirectory, NotFound
from mavftpfs.shared.model import ROOT, EntryKind, join
from mavftpfs.shared.readable import name_text

__all__ = ["Drone", "Entry", "NotDelivered", "UsageError", "connect"]

log = logging.getLogger("mavftpfs.api")
logging.getLogger("mavftpfs.cache").addHandler(logging.NullHandler())
"""A program without logging sees each problem once, because the calls raise the caches' warnings as
errors."""

ArgsT = ParamSpec("ArgsT")
ResultT = TypeVar("ResultT")


# -- connecting -----------------------------------------------------------------------------------


def connect(source: str, *, use_mount: bool = True, **options: object) -> Drone:
    """Return a vehicle's files; close the result at the end, or use it in a `with` statement.

    source: a link as for the command (`udpin:0.0.0.0:14550`, `/dev/ttyACM0`), or the directory of a mount. If
    that vehicle is already mounted, the calls use its mount, unless `use_mount` is False. options: those of a
    mount, by name: `target_system=2, signing_key="key", ro=True`. A removed option is a DeprecationWarning.

    Raises:
        TimeoutError: no vehicle answers within `connect_timeout`. OSError: the link cannot be opened.
        UsageError (a ValueError): source or an option is wrong; the text names it.
    """
    with translated():
        target = target_of(source, options_of(options))
        if target.mount is not None and not use_mount:
            raise UsageError(f"{source} is a mount, and use_mount=False refuses it; name the vehicle's link")
    for line in target.options.gone:
        warnings.warn(line, DeprecationWarning, stacklevel=2)
    return Drone(source, LoopThread(partial(_connected, target, use_mount=use_mount), source))


@dataclass(slots=True)
class _Connected:
    """A vehicle in the event loop's thread. opened: the open files. is_meant: the vehicle is known to be the
    one that the program changes."""

    session: Session
    opened: set[Opened] = field(default_factory=set)
    is_meant: bool = False

    async def require_one_vehicle(self) -> None:
        """Check before the first change that the program can mean only one vehicle. Vehicles that appear
        later are not checked.

        Raises:
            UsageError: several vehicles are on the link, and `target_system` does not name one.
        """
        if not self.is_meant:
            await self.session.require_changeable(IN_PYTHON)
            self.is_meant = True

    async def close_files(self) -> None:
        """Close the open files, discard their changes, and log each file."""
        for opened in list(self.opened):
            if opened.writable:
                log.error("%s was not closed: its changes are discarded", opened.name)
            await opened.abandon()


@asynccontextmanager
async def _connected(target: Target, *, use_mount: bool) -> AsyncIterator[_Connected]:
    """Connect for the length of the body; return after the vehicle's session has been closed."""
    with translated(), open_sinks(target.options, debug=False, tell=log.info) as sinks:
        target = replace(target, sinks=sinks)
        up = target.session(writing=True, list_root=True, use_mount=use_mount)
        async with up as session, session.noting_others(log.warning, IN_PYTHON):
            connected = _Connected(session)
            try:
                yield connected
            finally:
                with trio.CancelScope(shield=True):
                    await connected.close_files()


def in_loop(
    method: Callable[Concatenate[Drone, ArgsT], Awaitable[ResultT]],
) -> Callable[Concatenate[Drone, ArgsT], ResultT]:
    """Turn an async method into one that waits for its result and raises the errors of programs."""

    @wraps(method)
    def call(self: Drone, /, *args: ArgsT.args, **kwargs: ArgsT.kwargs) -> ResultT:
        async def work() -> ResultT:
            with translated():
                return await method(self, *args, **kwargs)

        return self._loop.call(work)

    return call


def changing(
    method: Callable[Concatenate[Drone, ArgsT], Awaitable[ResultT]],
) -> Callable[Concatenate[Drone, ArgsT], ResultT]:
    """As in_loop, for a method that changes the vehicle: check first that the program can mean only this
    one."""

    @wraps(method)
    async def checked(self: Drone, /, *args: ArgsT.args, **kwargs: ArgsT.kwargs) -> ResultT:
        await self._connected.require_one_vehicle()
        return await method(self, *args, **kwargs)

    return in_loop(checked)


# -- the calls ------------------------------------------------------------------------------------


class Drone:
    """A vehicle's files. Made by `connect`; several threads may make calls at once.

    Paths are text, bytes or path-like; relative ones begin at the root. Errors are OSErrors of the right kind
    (FileNotFoundError, PermissionError, TimeoutError ...), whose text is a sentence for people. After a fork
    every call raises RuntimeError, and after `close` ValueError.

    Attributes:
        source: as it was given. mountpoint: of the mount that serves the files; None for a connection of its
            own.
    """

    def __init__(self, source: str, loop: LoopThread[_Connected]) -> None:
        self.source = source
        self._loop = loop
        self._connected = loop.value
        self._session = loop.value.session
        self._files = self._session.files
        self.mountpoint = self._session.mountpoint

    @property
    def closed(self) -> bool:
        """Whether every further call raises ValueError."""
        return self._loop.closed

    @property
    def has_open_files(self) -> bool:
        """Whether the program has a file of this vehicle open."""
        return bool(self._connected.opened)

    def close(self) -> None:
        """Close the vehicle's session. Discard the changes of files that are still open, and log these
        files."""
        self._loop.close()

    def __enter__(self) -> Drone:
        """Return the drone."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        """Close the drone."""
        self.close()

    def __del__(self) -> None:
        """Have the connection closed, and return at once."""
        loop = getattr(self, "_loop", None)
        if loop is not None and not loop.closed:
            loop.stop()
            warnings.warn(f"{self!r} was not closed", ResourceWarning, stacklevel=2, source=self)

    def __repr__(self) -> str:
        return f"<Drone {self.source}>"

    async def _existing(self, path: PathLike) -> bytes:
        """Return a path as the client takes it. If the path ends in a slash, check that it is a directory.

        Raises:
            NotADirectory, NotFound: the path ends in a slash, and is a file or nothing.
        """
        wanted = remote(path)
        if names_directory(path) and (await self._files.stat(wanted)).kind is EntryKind.FILE:
            raise NotADirectory(f"{wanted!r} is not a directory")
        return wanted

    # --- looking

    @in_loop
    async def stat(self, path: PathLike) -> Entry:
        """Return the entry of a path.

        Raises:
            FileNotFoundError, NotADirectoryError.
        """
        wanted = await self._existing(path)
        return entry(wanted, await self._files.stat(wanted))

    @in_loop
    async def scandir(self, path: PathLike = "/") -> Iterator[Entry]:
        """Yield the entries of a directory. An incomplete listing is an error.

        Raises:
            FileNotFoundError, NotADirectoryError.
        """
        wanted = remote(path)
        return iter([entry(join(wanted, name), stat) for name, stat in await self._files.list(wanted)])

    def listdir(self, path: PathLike = "/") -> list[str]:
        """Return the names in a directory."""
        return [found.name for found in self.scandir(path)]

    @in_loop
    async def walk(self, path: PathLike = "/") -> Iterator[Entry]:
        """Yield everything below a directory, parents first.

        Raises:
            As scandir, of any directory below, too.
        """
        top = remote(path)
        found, unlisted = await walk(self._files, top)
        for _, error in unlisted:
            raise error
        return iter([entry(join(top, below), stat) for below, stat in found])

    def exists(self, path: PathLike) -> bool:
        """Return whether the path exists."""
        return self._kind(path) is not None

    def is_dir(self, path: PathLike) -> bool:
        """Return whether the path is a directory."""
        return self._kind(path) is EntryKind.DIRECTORY

    def is_file(self, path: PathLike) -> bool:
        """Return whether the path is a file."""
        return self._kind(path) is EntryKind.FILE

    @in_loop
    async def _kind(self, path: PathLike) -> EntryKind | None:
        try:
            return (await self._files.stat(await self._existing(path))).kind
        except (NotFound, NotADirectory):
            return None

    @in_loop
    async def crc32(self, path: PathLike) -> int:
        """Have the vehicle compute a file's CRC32: start value 0, and no final xor."""
        return await self._files.crc32(await self._existing(path))

    @in_loop
    async def status(self) -> dict[str, Any]:
        """Return the facts of `mavftpfs status --json` about vehicle, link and transfers."""
        return dict(await self._session.status())

    @in_loop
    async def refresh(self) -> None:
        """Drop the cached listings and data, because others may have changed the vehicle's files."""
        await self._files.refresh()

    # --- parameters

    @property
    def params(self) -> Params:
        """The vehicle's parameters, a mapping: `drone.params["MPC_XY_CRUISE"] = 4.5`."""
        return Params(self._get_params, self._set_params)

    @in_loop
    async def _get_params(self) -> dict[str, Number]:
        return await get_values(self._session)

    @changing
    async def _set_params(self, values: Mapping[str, Number]) -> None:
        await set_values(self._session, values)

    # --- changing names

    @changing
    async def mkdir(self, path: PathLike, *, parents: bool = False, exist_ok: bool = False) -> None:
        """Make a directory, and with `parents` those above it.

        Raises:
            FileExistsError, FileNotFoundError.
        """
        wanted = remote(path)
        if wanted == ROOT:
            if exist_ok:
                return
            raise AlreadyExists("the root is there")
        for above in names.ancestors(wanted) if parents else []:
            await names.make_directory(self._files, above, may_exist=True)
        await names.make_directory(self._files, wanted, may_exist=exist_ok)

    @changing
    async def rmdir(self, path: PathLike) -> None:
        """Remove an empty directory."""
        await names.remove_directories(self._session, [remote(path)])

    @changing
    async def remove(self, path: PathLike, *, recursive: bool = False) -> None:
        """Remove a file; with `recursive` a directory with all below, too.

        Raises:
            FileNotFoundError, IsADirectoryError.
        """
        wanted = await self._existing(path)
        names.refuse_root([wanted])
        if recursive:
            await names.remove_paths(self._session, [wanted], recursive=True)
        else:
            await self._files.unlink(wanted)

    unlink = remove

    @changing
    async def rename(self, old: PathLike, new: PathLike) -> None:
        """Rename, replacing an existing file. Where the card cannot rename, the file is copied and then
        removed."""
        source, target = await self._existing(old), remote(new)
        if names_directory(new) and (await self._files.stat(source)).kind is EntryKind.FILE:
            raise NotADirectory(f"{source!r} is not a directory")
        await names.move(self._files, source, target)

    @changing
    async def copy(self, old: PathLike, new: PathLike) -> None:
        """Copy a file through this computer."""
        source = await self._existing(old)
        if names_directory(new):
            raise IsADirectory(f"{remote(new)!r} is a directory")
        await names.copy(self._files, source, remote(new))

    def truncate(self, path: PathLike, size: int) -> None:
        """Cut a file, or extend it with zeros."""
        with self.open(path, "r+b", 0) as file:
            file.truncate(size)

    # --- files

    def open(
        self,
        path: PathLike,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
    ) -> IO[Any]:
        """Open a file as the builtin does; text is UTF-8 unless `encoding` says otherwise.

        When `close` returns, the written bytes are on the card and verified.

        Raises:
            FileNotFoundError, FileExistsError, IsADirectoryError ... ValueError: of the mode.
        """
        how = Mode(mode, buffering, encoding, errors, newline)
        opened: list[Opened] = []

        async def work() -> None:
            with translated():
                opened.append(await self._open(path, how.plain))

        try:
            self._loop.call(work)
        except BaseException:  # Ctrl-C may come after it was opened
            for one in opened:
                self._loop.post(one.abandon)
            raise
        return python_file(opened[0], self._loop, how, owner=self)

    async def _open(self, path: PathLike, mode: str) -> Opened:
        """Open a file without a buffer; mode: r, w, a or x, perhaps with +."""
        if mode != "r":
            await self._connected.require_one_vehicle()
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
        opened = Opened(
            os.fsdecode(wanted), file, writable=mode != "r", forget=self._connected.opened.discard
        )
        self._connected.opened.add(opened)
        return opened

    def read_bytes(self, path: PathLike) -> bytes:
        """Return a file's content."""
        with self.open(path, "rb", 0) as file:
            content: bytes = file.read()
            return content

    def write_bytes(self, path: PathLike, data: bytes) -> None:
        """Make a file or replace its content; return when the content is on the card, verified.

        Raises:
            NotDelivered: the card does not have it; `on_vehicle` says more.
        """
        with self.open(path, "wb", 0) as file:
            file.write(data)

    def read_text(self, path: PathLike, encoding: str = "utf-8") -> str:
        """Return a file's content as text, with every line ending as `\\n`."""
        with self.open(path, encoding=encoding) as file:
            text: str = file.read()
            return text

    def write_text(self, path: PathLike, text: str, encoding: str = "utf-8") -> None:
        """Make a file or replace its content by a text."""
        self.write_bytes(path, text.encode(encoding))

    # --- many files

    @in_loop
    async def get(
        self,
        path: PathLike,
        local: str | os.PathLike[str] = ".",
        *,
        recursive: bool = False,
        include: Patterns = (),
        exclude: Patterns = (),
        verify: Verify = "auto",
    ) -> list[Path]:
        """Download a file, or with `recursive` a directory, and verify it; return the local files.

        If `local` is a directory, the file or directory goes into it. Otherwise `local` is the file's new
        name. include, exclude: a pattern or several, as of `mavftpfs get`.

        Raises:
            OSError: a file did not arrive; the text says how much did. UsageError: an argument is wrong.
        """
        selection = selection_of(include=include, exclude=exclude)

        async def work(downloads: download.Downloads) -> None:
            wanted = await self._existing(path)
            if not recursive and await is_directory(self._files, wanted):
                raise IsADirectory(f"{wanted!r} is a directory; get it with recursive=True")
            await downloads.get([wanted], Path(local), into=False, recursive=recursive, selection=selection)

        outcome = await self._download(verify, work)
        return [*(fetched.wanted.local for fetched in outcome.fetched), *(one.local for one in outcome.here)]

    @in_loop
    async def sync(
        self,
        local: str | os.PathLike[str],
        *,
        place: PathLike | None = None,
        newest: int | None = None,
        since: Since | None = None,
        include: Patterns = (),
        exclude: Patterns = (),
        verify: Verify = "auto",
    ) -> list[Path]:
        """Download the vehicle's logs as `mavftpfs sync` does, and return those that are new here.

        place: their directory on the vehicle; None to find it. newest: the largest number of logs. since: the
        oldest time: a date as of `--since` (`"2h"`, `"2026-05-01"`), a datetime, or seconds since 1970 UTC.
        include, exclude: a pattern or several.

        Raises:
            OSError: a log did not arrive; the text says how many did. UsageError: an argument is wrong.
        """
        where = None if place is None else remote(place)
        selection = selection_of(newest=newest, since=since, include=include, exclude=exclude)
        request = logs.SyncRequest(Path(local), where, selection)
        outcome = await self._download(verify, lambda downloads: logs.sync(downloads, request))
        return [fetched.wanted.local for fetched in outcome.fetched]

    async def _download(
        self, verify: Verify, work: Callable[[download.Downloads], Awaitable[None]]
    ) -> download.Outcome:
        outcome = download.Outcome()
        fetcher = Fetcher(self._session, Progress(), verify_of(verify))
        await work(download.Downloads(fetcher, outcome))
        for path, error in outcome.failed.items():
            count, of = len(outcome.fetched) + len(outcome.here), len(outcome.wanted) + len(outcome.here)
            text = download.named(name_text(path), error)
            raise os_error(error, f"{text}; {count} of {of} files are here" if of > 1 else text) from error
        return outcome

    @changing
    async def put(
        self, local: str | os.PathLike[str], path: PathLike, *, recursive: bool = False
    ) -> list[str]:
        """Upload a file, or with `recursive` a directory; return the vehicle's new paths.

        `path` is an existing directory, or the new name.

        Raises:
            FileNotFoundError, IsADirectoryError: of `local`. NotDelivered: the vehicle does not have a file.
        """
        told: list[str] = []
        if stat.S_ISDIR(os.stat(local).st_mode) and not recursive:
            raise IsADirectory(f"{os.fspath(local)} is a directory; put it with recursive=True")
        found = upload.collect(Path(local), recursive=recursive)
        batches = [(Path(local), found)]
        tell = lambda where, size, how: told.append(os.fsdecode(where))  # noqa: E731
        into = names_directory(path)
        await upload.put_paths(self._session, batches, remote(path), Progress(), tell, into=into)
        return told


async def _opened_or_made(files: Files, path: bytes) -> File:
    try:
        return await files.open(path, write=True, append=True)
    except NotFound:
        return await files.create(path, exclusive=False)
