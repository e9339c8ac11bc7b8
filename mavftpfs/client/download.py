"""Brings many files: named ones, or the logs, newest first; compares logs. Layer: client; silent."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from mavftpfs.cache.attributes import Stat
from mavftpfs.client.brought import NAME as MEMORY
from mavftpfs.client.brought import Brought, Memory
from mavftpfs.client.fetch import (
    Fetched,
    Fetcher,
    LocalDiskFull,
    Take,
    Wanted,
    known_time,
    local_disk,
    part_of,
)
from mavftpfs.client.files import Found, Session, Unlisted, walk
from mavftpfs.client.names import fixed_part, matching, matching_files
from mavftpfs.client.proof import BY_CRC32, Proof, Verify, ask_crc32, local_crc32, proof_needed
from mavftpfs.client.selection import EVERYTHING, Selection
from mavftpfs.shared.errors import (
    IsADirectory,
    LinkError,
    MavftpfsError,
    NotADirectory,
    NotFound,
    RequestTimeout,
    UsageError,
)
from mavftpfs.shared.model import EntryKind, join, split
from mavftpfs.shared.readable import name_text

LOG_PLACES = (b"/fs/microsd/log", b"/APM/LOGS", b"/logs", b"/log", b"/var/APM/logs", b"/@MAV_LOG")
"""Where vehicles keep logs: PX4, ArduPilot, ArduPilot's simulator, PX4's simulator, ArduPilot on Linux, and
the standard's alias, which shows one of the others again and so comes last."""

MAX_TIMEOUTS = 2
"""A run ends after so many files in a row whose requests timed out: the others would time out, too."""


@dataclass(frozen=True, slots=True)
class Wish:
    """What to sync. place: the directory on the vehicle, None to find it."""

    local: Path
    place: bytes | None = None
    selection: Selection = EVERYTHING
    dry_run: bool = False


@dataclass(slots=True)
class Outcome:
    """How far a run came. place: the directory of logs; here: files that were here already.

    proofs: how the compared files were verified. failed: why a file, or the files of a directory, are not
    here. differing: what `check` found. checked: this was a run of `check`.
    """

    place: bytes = b""
    here: list[Wanted] = field(default_factory=list)
    wanted: list[Wanted] = field(default_factory=list)
    fetched: list[Fetched] = field(default_factory=list)
    proofs: dict[bytes, Proof] = field(default_factory=dict)
    failed: dict[bytes, MavftpfsError] = field(default_factory=dict)
    differing: dict[bytes, str] = field(default_factory=dict)
    checked: bool = False
    finished: bool = False

    @property
    def complete(self) -> bool:
        """Whether all wanted files are here; for `check`, whether all are proven to be the same."""
        unproven = self.checked and bool(self.lacking)
        return self.finished and not (self.failed or self.differing or unproven)

    @property
    def lacking(self) -> Counter[str]:
        """Why checksums were not compared although they should have been, and for how many files."""
        return Counter(proof.lacking for proof in self.proofs.values() if proof.lacking)


@dataclass(frozen=True, slots=True)
class Downloads:
    """Brings files one after the other, and fills `outcome` meanwhile, so it is right even for a run that was
    ended. tell: called for each file that came; complain: called with a line for each that did not."""

    fetcher: Fetcher
    outcome: Outcome
    tell: Callable[[Fetched], None]
    complain: Callable[[str], None]

    async def sync(self, wish: Wish) -> None:
        """Bring the logs. Also prove the logs that are here, if that is wanted, or was not possible before.

        Raises:
            NotFound: no directory of logs. LinkError: the vehicle, or the mount, is gone; UsageError: the
            local disk is full. RequestTimeout: for MAX_TIMEOUTS files. Other failures go to `complain`.
        """
        logs = await self._logs(wish)
        if wish.dry_run:
            self.outcome.here = [log for log in logs if log.here]
            self.outcome.wanted = [log for log in logs if not log.here]
            self.outcome.finished = True
            return
        with local_disk(wish.local):
            wish.local.mkdir(parents=True, exist_ok=True)
            memory = Memory(wish.local)
        for log in logs:
            trusted = log.here and not self._to_be_proven(log, memory)
            (self.outcome.here if trusted else self.outcome.wanted).append(log)
        await self._fetch_all(alone=False, memory=memory)

    async def check(self, wish: Wish) -> None:
        """Compare the logs that are here with the vehicle's, and fetch nothing.

        Raises:
            As `sync`.
        """
        self.outcome.checked = True
        logs, progress = await self._logs(wish), self.fetcher.progress
        self.outcome.here = [log for log in logs if log.local.is_file()]
        self.outcome.wanted = [log for log in logs if not log.local.is_file()]
        progress.plan(len(self.outcome.here), sum(log.size for log in self.outcome.here))
        for log in self.outcome.here:
            progress.begin(log.name, log.size, log.size)
            progress.check()
            try:
                await self._compare(log)
            except MavftpfsError as exc:
                self.fail(log.remote, exc, log.name)
            progress.end(log.size)
        self.outcome.finished = True

    async def _compare(self, log: Wanted) -> None:
        if not log.here:
            with local_disk(log.local):
                size = log.local.stat().st_size
            self.outcome.differing[log.remote] = f"{size} bytes here, {log.size} on the vehicle"
            return
        answer = await ask_crc32(self.fetcher.session, log.remote)
        if answer.crc is None:
            self.outcome.proofs[log.remote] = Proof("size", answer.lacking, answer.later)
            return
        with local_disk(log.local):
            ours = await local_crc32(log.local)
        if ours == answer.crc:
            self.outcome.proofs[log.remote] = BY_CRC32
        else:
            self.outcome.differing[log.remote] = f"CRC32 {ours:08x} here, {answer.crc:08x} on the vehicle"

    async def _logs(self, wish: Wish) -> list[Wanted]:
        """Find the logs; return the wanted ones, newest first."""
        session = self.fetcher.session
        if session.mountpoint is not None:  # a log of the last flight is not in what a mount listed before
            await session.files.refresh()
        place, logs, unlisted, unmatched = await wanted_logs(session, wish, wish.local)
        self.outcome.place = session.on_vehicle(place)
        if unmatched:
            self.complain(f"--include and --exclude leave no log to fetch ({unmatched} in all)")
        for path, error in unlisted:
            self.fail(path, error)
        warning = wish.selection.warning(logs)
        if warning and not self.outcome.checked:
            self.complain(warning)
        return logs

    def _to_be_proven(self, log: Wanted, memory: Memory) -> bool:
        """Return whether a log that is here is compared: all logs are, or its checksum could not be had
        before."""
        verify: Verify = self.fetcher.verify
        known = memory.of(None, self._path(log))
        unproven = known is not None and not known.proven and known.size == log.size
        return verify == "all" or (unproven and proof_needed(verify, resumed=False, size=log.size))

    def _path(self, log: Wanted) -> str:
        return os.fsdecode(self.fetcher.session.on_vehicle(log.remote))

    def _remember(self, fetched: Fetched, memory: Memory) -> None:
        """Remember a log that was not proven, until it is."""
        log, unproven = fetched.wanted, bool(fetched.proof.lacking) and fetched.proof.later
        path = self._path(log)
        if unproven or memory.of(None, path) is not None:
            with local_disk(log.local):
                memory.note(Brought(path, log.name, fetched.size, log.mtime, proven=not unproven))

    async def get(
        self,
        paths: Sequence[bytes],
        local: Path,
        *,
        into: bool,
        recursive: bool,
        selection: Selection = EVERYTHING,
    ) -> None:
        """Fetch files, and with `recursive` directories; names may be patterns.

        One file goes into `local` if that is a directory, else it gets that name. All else goes into `local`,
        which is made. Files that match a pattern go there with their directories, from the first wildcard on.
        The patterns of `selection` see the same paths below `local`.

        Raises:
            UsageError: two files would get one local name. NotFound: `selection` takes no file. In both cases
            nothing was fetched. Else as Fetcher.fetch where only one file is asked for, else as `sync`.
        """
        alone, refreshed = len(paths) == 1, self.fetcher.session.mountpoint is None
        found: list[Wanted] = []
        for path in paths:
            try:
                refreshed = refreshed or await self._refreshed_for(path)
                names = await self._matching(path, recursive=recursive)
                alone = alone and names == [path]
                plain = names == [path]
                top = split(path)[0] if plain else fixed_part(path)
                for name in names:
                    place = Place(name, top, path if plain else top, local, into or not alone)
                    found += await self._found(place, selection, recursive=recursive)
            except MavftpfsError as exc:
                self.fail(path, exc, alone=alone)
        found = list(dict.fromkeys(found))
        if selection.by_name and not found and not self.outcome.failed:
            raise NotFound("--include and --exclude leave no file to fetch")
        _require_apart(found)
        self.outcome.wanted = _apart(found)
        await self._fetch_all(alone=alone and [one.remote for one in found] == [*paths])

    async def _refreshed_for(self, path: bytes) -> bool:
        """Have a mount ask the vehicle again if it does not know a path: the file may be newer than what the
        mount listed before. Return whether the mount did."""
        files = self.fetcher.session.files
        try:
            if await matching(files, path) == [path]:
                await files.stat(path)
        except NotFound:
            await files.refresh()
            return True
        return False

    async def _found(self, place: Place, selection: Selection, *, recursive: bool) -> list[Wanted]:
        """Make the local directories for the files of a path, and return the files."""
        session, path = self.fetcher.session, place.path
        stat = await session.files.stat(path)
        if stat.kind is EntryKind.FILE:
            if not selection.takes(place.below_source(path)):
                return []
            return [_wanted(path, place.of_file(), session.on_vehicle(path), stat)]
        if not recursive:
            raise IsADirectory(f"{name_text(path)} is a directory; get it with -r")
        found, unlisted = await walk(session.files, path)
        for unreadable, error in unlisted:
            self.fail(unreadable, error)
        return _made(session, place, found, selection)

    async def _matching(self, path: bytes, *, recursive: bool = False) -> list[bytes]:
        files = self.fetcher.session.files
        return await (matching(files, path) if recursive else matching_files(files, path, self.complain))

    async def cat(self, paths: Sequence[bytes], take: Take) -> None:
        """Hand on the bytes of files, one behind the other.

        Raises:
            As Fetcher.write_to where only one file is asked for; LinkError always.
        """
        for path in paths:
            try:
                for name in await self._matching(path):
                    await self.fetcher.write_to(name, take)
            except MavftpfsError as exc:
                self.fail(path, exc, alone=len(paths) == 1)

    async def _fetch_all(self, *, alone: bool, memory: Memory | None = None) -> None:
        wanted, progress = list(self.outcome.wanted), self.fetcher.progress
        progress.plan(len(wanted), sum(one.size for one in wanted))
        timeouts = 0
        for one in wanted:
            try:
                fetched = await self.fetcher.fetch(one)
            except MavftpfsError as exc:
                timeouts = timeouts + 1 if isinstance(exc, RequestTimeout) else 0
                self.fail(one.remote, exc, one.name, alone=alone or timeouts == MAX_TIMEOUTS)
            else:
                timeouts = 0
                self._arrived(fetched)
                if memory is not None:
                    self._remember(fetched, memory)
            progress.end(one.size)
        self.outcome.finished = True

    def _arrived(self, fetched: Fetched) -> None:
        self.outcome.proofs[fetched.wanted.remote] = fetched.proof
        if fetched.was_here:
            self.outcome.wanted.remove(fetched.wanted)
            self.outcome.here.append(fetched.wanted)
        else:
            self.outcome.fetched.append(fetched)
        self.tell(fetched)

    def fail(self, path: bytes, error: MavftpfsError, name: str = "", *, alone: bool = False) -> None:
        """Complain and go on; or raise the error, if the other files would fail, too, or there are none."""
        self.outcome.failed[path] = error
        if alone or isinstance(error, LinkError | LocalDiskFull):
            raise error
        self.complain(named(name or path, error))


@dataclass(frozen=True, slots=True)
class Place:
    """Where a path of the vehicle goes. `local` stands for the directory `top` above it; into: as a
    directory, which is made. source: the directory or file that was asked for; for a pattern, `top`."""

    path: bytes
    top: bytes
    source: bytes
    local: Path
    into: bool

    @property
    def whole(self) -> Path:
        """The local path, if `local` is a directory."""
        return self.local / os.fsdecode(_below_top(self.path, self.top))

    def below_source(self, path: bytes) -> bytes:
        """Return the path of a file below the source, by which it is chosen."""
        return _below_top(path, self.source) or split(path)[1]

    def of_file(self) -> Path:
        """Return where one file goes."""
        if self.into:
            with local_disk(self.local):
                self.whole.parent.mkdir(parents=True, exist_ok=True)
        return self.whole if self.local.is_dir() else self.local


def _require_apart(wanted: Iterable[Wanted]) -> None:
    """Check that no file would overwrite another one of the same run."""
    names: dict[Path, str] = {}
    for one in wanted:
        if one.local in names:
            raise UsageError(
                f"{names[one.local]} and {one.name} would both become {one.local}; nothing was fetched: "
                "get each into a directory of its own"
            )
        names[one.local] = one.name


def _below_top(path: bytes, top: bytes) -> bytes:
    return path.removeprefix(top).lstrip(b"/")


def _made(session: Session, place: Place, found: Found, selection: Selection) -> list[Wanted]:
    """Make the directories below a directory, and return its files; if these are chosen by name, make only
    the directories that they need."""
    files, top = [], place.whole
    with local_disk(top):
        if not selection.by_name:
            top.mkdir(parents=True, exist_ok=True)
        for below, stat in found:
            remote, local = join(place.path, below), top / os.fsdecode(below)
            if stat.kind is EntryKind.DIRECTORY:
                if not selection.by_name:
                    local.mkdir(exist_ok=True)
            elif selection.takes(place.below_source(remote)):
                local.parent.mkdir(parents=True, exist_ok=True)
                files.append(_wanted(remote, local, session.on_vehicle(remote), stat))
    return files


def named(name: bytes | str, error: MavftpfsError) -> str:
    """Return an error's text with the name of its file; some texts have it already."""
    shown, text = name if isinstance(name, str) else name_text(name), str(error)
    return text if shown in text else f"{shown}: {text}"


def _wanted(remote: bytes, local: Path, name: bytes, stat: Stat, *, keep_old: bool = False) -> Wanted:
    mtime = known_time(stat.mtime)
    return Wanted(remote, name_text(name), stat.size, mtime, local, part_of(local), keep_old)


def _apart(wanted: Sequence[Wanted]) -> list[Wanted]:
    """Return files of one run, none of which has its .part where another belongs."""
    finals = {one.local for one in wanted}
    return [replace(one, part=part_of(one.local, finals)) for one in wanted]


# -- logs -----------------------------------------------------------------------------------------


def _require_no_file(local: Path) -> None:
    if local.exists() and not local.is_dir():
        raise UsageError(f"{local} is a file; the logs go into a directory")


class Logs(NamedTuple):
    """The vehicle's logs. place: their directory; wanted: the newest first; unlisted: the directories that
    could not be listed; unmatched: how many logs there are, if the patterns match none of them, otherwise
    0."""

    place: bytes
    wanted: list[Wanted]
    unlisted: Unlisted
    unmatched: int


async def wanted_logs(session: Session, wish: Wish, local: Path) -> Logs:
    """List the logs, and choose.

    local: the directory into which they are to go.

    Raises:
        NotFound: there is no directory of logs. NotADirectory, UsageError: a file is where a directory is to
        be. Else as `walk`.
    """
    _require_no_file(local)
    if wish.place is None:
        place, found, unlisted = await find_logs(session)
    else:
        place = wish.place
        if (await session.files.stat(place)).kind is EntryKind.FILE:
            raise NotADirectory(f"{name_text(place)} is a file; get it with `mavftpfs get`")
        found, unlisted = await walk(session.files, place)
    logs = [
        _wanted(join(place, below), local / os.fsdecode(below), below, stat, keep_old=True)
        for below, stat in found
        if stat.kind is EntryKind.FILE and below != MEMORY.encode()  # local logs that were copied to the card
    ]
    takes = wish.selection.takes
    taken = [log for log in logs if takes(log.remote.removeprefix(join(place, b"")))]
    return Logs(place, _apart(wish.selection.of_logs(taken)), unlisted, 0 if taken else len(logs))


async def find_logs(session: Session) -> tuple[bytes, Found, Unlisted]:
    """Return the directory that holds the vehicle's logs, and what `walk` tells of it.

    It is the first known one with a file in it, or with something that cannot be listed.

    Raises:
        NotFound: there is none.
    """
    empty: bytes | None = None
    for known in LOG_PLACES:
        place = _below(session.root, known)
        if place is None:
            continue
        try:
            found, unlisted = await walk(session.files, place)
        except (NotFound, NotADirectory):
            continue
        if unlisted or any(stat.kind is EntryKind.FILE for _, stat in found):
            return place, found, unlisted
        empty = empty or place
    if empty is not None:
        return empty, [], []
    places = ", ".join(name_text(place) for place in LOG_PLACES)
    raise NotFound(f"no directory of logs was found (looked at {places}); name it with --from")


def _below(root: bytes, place: bytes) -> bytes | None:
    """Return the path of a vehicle's directory below the root that is used, None if it is not below it."""
    if root == place or root.startswith(place + b"/"):
        return b"/"
    if root == b"/":
        return place
    return place[len(root) :] if place.startswith(root + b"/") else None
