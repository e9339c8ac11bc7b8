"""Downloads many files, one after the other: those that paths and patterns name. Layer: client; silent."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mavftpfs.cache.attributes import Stat
from mavftpfs.client.compare import Comparison, Match
from mavftpfs.client.fetch import (
    Fetched,
    Fetcher,
    LocalTrouble,
    Take,
    Wanted,
    known_time,
    local_disk,
)
from mavftpfs.client.files import Found, walk
from mavftpfs.client.names import fixed_part, matching, matching_files
from mavftpfs.client.selection import EVERYTHING, Selection
from mavftpfs.shared.errors import (
    IsADirectory,
    LinkError,
    MavftpfsError,
    NotFound,
    RequestTimeout,
    UsageError,
)
from mavftpfs.shared.model import EntryKind, join, split
from mavftpfs.shared.readable import name_text

MAX_TIMEOUTS = 2
"""The number of successive files with timed-out requests that ends a run, because the others would fail,
too."""


class Reports:
    """Receives the news of a run of downloads; this base class ignores them."""

    def begins(self, wanted: Wanted) -> None:
        """Note that a file begins. An error of this call ends the run."""

    def arrived(self, fetched: Fetched) -> None:
        """Note that a file is complete."""

    def failed(self, name: str, error: MavftpfsError) -> None:
        """Note that a file failed, or that a directory could not be listed; the run continues."""
        self.says(named(name, error))

    def says(self, line: str) -> None:
        """Take a line for people."""


@dataclass(slots=True)
class Outcome:
    """The progress of a run. place: the directory of logs; here: files that were here already.

    verified: the comparison of each file. failed: the error of each file, or of a directory. checked: `sync
    --check` ran. finished: the run came to its last file.
    """

    place: bytes = b""
    here: list[Wanted] = field(default_factory=list)
    wanted: list[Wanted] = field(default_factory=list)
    fetched: list[Fetched] = field(default_factory=list)
    verified: dict[bytes, Comparison] = field(default_factory=dict)
    failed: dict[bytes, MavftpfsError] = field(default_factory=dict)
    checked: bool = False
    finished: bool = False

    @property
    def differing(self) -> dict[bytes, str]:
        """The difference of each file that differs, in words."""
        return {path: one.how for path, one in self.verified.items() if one.match is Match.DIFFERS}

    @property
    def complete(self) -> bool:
        """Whether all wanted files are here; after `sync --check`, whether all are verified to be the
        same."""
        unproven = self.checked and bool(self.lacking)
        return self.finished and not (self.failed or self.differing or unproven)

    @property
    def lacking(self) -> Counter[str]:
        """The reasons for missing checksums, each with its number of files."""
        return Counter(one.lacking for one in self.verified.values() if one.lacking)


@dataclass(frozen=True, slots=True)
class Downloads:
    """Downloads files, and keeps `outcome` up to date, so that an interrupted run can be reported, too."""

    fetcher: Fetcher
    outcome: Outcome
    reports: Reports = field(default_factory=Reports)

    async def get(
        self,
        paths: Sequence[bytes],
        local: Path,
        *,
        into: bool,
        recursive: bool,
        selection: Selection = EVERYTHING,
    ) -> None:
        """Download files, and with `recursive` directories; names may be patterns.

        A single file goes into `local` if that is a directory; otherwise it gets that name. Everything else
        goes into `local`, which is made. Files that match a pattern keep their directories from the first
        wildcard on. The patterns of `selection` see the same paths below `local`.

        Raises:
            UsageError: two files would get one local name. NotFound: `selection` takes no file. In both cases
            nothing was downloaded. Otherwise as `fetch_all`.
        """
        refreshed = self.fetcher.session.mountpoint is None
        found: list[Wanted] = []
        for path in paths:
            try:
                refreshed = refreshed or await self._refreshed_for(path)
                names = await self._matching(path, recursive=recursive)
                plain = names == [path]
                top = split(path)[0] if plain else fixed_part(path)
                several = len(paths) > 1 or not plain
                for name in names:
                    place = Place(top, path if plain else top, local, into or several)
                    found += await self._found(name, place, selection, recursive=recursive)
            except MavftpfsError as exc:
                self.fail(path, exc)
        found = list(dict.fromkeys(found))
        if selection.by_name and not found and not self.outcome.failed:
            raise NotFound("--include and --exclude leave no file to download")
        _require_apart(found)
        await self.fetch_all(found)

    async def _refreshed_for(self, path: bytes) -> bool:
        """Have a mount list again if it does not know a path, because the file may be newer than its last
        listing. Return whether the mount did."""
        files = self.fetcher.session.files
        try:
            if await matching(files, path) == [path]:
                await files.stat(path)
        except NotFound:
            await files.refresh()
            return True
        return False

    async def _found(
        self, path: bytes, place: Place, selection: Selection, *, recursive: bool
    ) -> list[Wanted]:
        """Return the wanted files of a path, and make the local directories that they need; without patterns
        in `selection` also those that stay empty."""
        session, stat = self.fetcher.session, await self.fetcher.session.files.stat(path)
        found: Found = [(b"", stat)]
        if stat.kind is EntryKind.DIRECTORY:
            if not recursive:
                raise IsADirectory(f"{name_text(path)} is a directory; get it with -r")
            below, unlisted = await walk(session.files, path)
            found += below
            for unreadable, error in unlisted:
                self.fail(unreadable, error)
        wanted = []
        for inner, one in found:
            remote = join(path, inner) if inner else path
            local = place.of(remote, alone=stat.kind is EntryKind.FILE)
            with local_disk(local):
                if one.kind is EntryKind.DIRECTORY:
                    if not selection.by_name:
                        local.mkdir(parents=True, exist_ok=True)
                elif selection.takes(_below(remote, place.source) or split(remote)[1]):
                    if local != place.local:
                        local.parent.mkdir(parents=True, exist_ok=True)
                    wanted.append(wanted_file(remote, local, session.on_vehicle(remote), one))
        return wanted

    async def _matching(self, path: bytes, *, recursive: bool = False) -> list[bytes]:
        files = self.fetcher.session.files
        return await (matching(files, path) if recursive else matching_files(files, path, self.reports.says))

    async def cat(self, paths: Sequence[bytes], take: Take) -> None:
        """Pass on the bytes of files, one behind the other.

        Raises:
            LinkError.
        """
        for path in paths:
            try:
                for name in await self._matching(path):
                    await self.fetcher.write_to(name, take)
            except MavftpfsError as exc:
                self.fail(path, exc)

    async def fetch_all(
        self, wanted: Sequence[Wanted], *, note: Callable[[Fetched], None] | None = None
    ) -> None:
        """Download files, and continue after one that fails. note: called for each downloaded file.

        Raises:
            LinkError, LocalTrouble, and RequestTimeout for MAX_TIMEOUTS successive files, because the others
            would fail, too. Also the errors of Reports.begins.
        """
        progress, timeouts = self.fetcher.progress, 0
        self.outcome.wanted = [*wanted]
        progress.plan(len(wanted), sum(one.size for one in wanted))
        for one in wanted:
            self.reports.begins(one)
            try:
                fetched = await self.fetcher.fetch(one)
                if note is not None:
                    note(fetched)
                self._arrived(fetched)
                timeouts = 0
            except MavftpfsError as exc:
                timeouts = timeouts + 1 if isinstance(exc, RequestTimeout) else 0
                self.fail(one.remote, exc, one.name, ends=timeouts == MAX_TIMEOUTS)
            progress.end(one.size)
        self.outcome.finished = True

    def _arrived(self, fetched: Fetched) -> None:
        self.outcome.verified[fetched.wanted.remote] = fetched.verified
        if fetched.was_here:
            self.outcome.wanted.remove(fetched.wanted)
            self.outcome.here.append(fetched.wanted)
        else:
            self.outcome.fetched.append(fetched)
        self.reports.arrived(fetched)

    def fail(self, path: bytes, error: MavftpfsError, name: str = "", *, ends: bool = False) -> None:
        """Report a failure; or raise the error, if it ends the run, because the other files would fail,
        too."""
        self.outcome.failed[path] = error
        if ends or isinstance(error, LinkError | LocalTrouble):
            raise error
        self.reports.failed(name or name_text(path), error)


@dataclass(frozen=True, slots=True)
class Place:
    """The local place for paths of the vehicle. `local` stands for the directory `top`; into: as a directory,
    which is made. source: the directory or file that the user named; for a pattern, `top`."""

    top: bytes
    source: bytes
    local: Path
    into: bool

    def of(self, path: bytes, *, alone: bool) -> Path:
        """Return the local path for a path; alone: `local` may be the name of the file."""
        if alone and not (self.into or self.local.is_dir()):
            return self.local
        return self.local / os.fsdecode(_below(path, self.top))


def _require_apart(wanted: Iterable[Wanted]) -> None:
    """Check that no file would overwrite another one of the same run."""
    names: dict[Path, str] = {}
    for one in wanted:
        if one.local in names:
            raise UsageError(
                f"{names[one.local]} and {one.name} would both become {one.local}; nothing was downloaded: "
                "get each into a directory of its own"
            )
        names[one.local] = one.name


def _below(path: bytes, top: bytes) -> bytes:
    return path.removeprefix(top).lstrip(b"/")


def named(name: str, error: MavftpfsError) -> str:
    """Return an error's text with the name of its file, which some texts already contain."""
    text = str(error)
    return text if name in text else f"{name}: {text}"


def wanted_file(remote: bytes, local: Path, name: bytes, stat: Stat, *, keep_old: bool = False) -> Wanted:
    """Return the Wanted for a listed file; name: its path for people."""
    mtime = known_time(stat.mtime)
    return Wanted(remote, name_text(name), stat.size, mtime, local, keep_old)
