"""Brings many files: what is named, or the logs, the newest first. Layer: client; prints nothing."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mavftpfs.cache.attributes import Stat
from mavftpfs.client.fetch import (
    Fetched,
    Fetcher,
    LocalDiskFull,
    StillGrowing,
    Take,
    Wanted,
    known_time,
    local_disk,
    part_of,
)
from mavftpfs.client.files import Found, Session, Unlisted, walk
from mavftpfs.shared.errors import (
    IsADirectory,
    LinkError,
    MavftpfsError,
    NotADirectory,
    NotFound,
    RequestTimeout,
)
from mavftpfs.shared.model import EntryKind, join, split
from mavftpfs.shared.readable import name_text

LOG_PLACES = (b"/fs/microsd/log", b"/APM/LOGS", b"/logs", b"/log", b"/var/APM/logs", b"/@MAV_LOG")
"""Where vehicles keep logs: PX4, ArduPilot, ArduPilot's simulator, PX4's simulator, ArduPilot on Linux, and
the standard's alias, which shows one of the others again and so comes last."""

NO_LOG = b"LASTLOG.TXT"
"""ArduPilot keeps the number of its last log beside the logs. `sync --newest` is not to count it as one."""

MAX_TIMEOUTS = 2
"""Requests of so many files in a row that nobody answered end a run: the others would fare no better."""


@dataclass(frozen=True, slots=True)
class Wish:
    """What to sync. place: the directory on the vehicle, None to find it; newest: at most so many;
    since: not older, seconds UTC."""

    local: Path
    place: bytes | None = None
    newest: int | None = None
    since: float | None = None
    dry_run: bool = False


@dataclass(slots=True)
class Outcome:
    """How far a run came. place: the directory of logs; here: files that were here already.

    failed: why a file, or what is in a directory, is not here.
    """

    place: bytes = b""
    here: list[Wanted] = field(default_factory=list)
    wanted: list[Wanted] = field(default_factory=list)
    fetched: list[Fetched] = field(default_factory=list)
    failed: dict[bytes, MavftpfsError] = field(default_factory=dict)
    finished: bool = False

    @property
    def complete(self) -> bool:
        """Whether everything that was wished for is here."""
        return self.finished and not self.failed

    def facts(self) -> dict[str, Any]:
        """Return what `sync --json` prints; the guide describes it."""
        fetched = {one.wanted.remote: one for one in self.fetched}
        files = [(wanted, "here") for wanted in self.here] + [(wanted, "wanted") for wanted in self.wanted]
        known = {wanted.remote for wanted, _ in files}
        return {
            "from": os.fsdecode(self.place),
            "complete": self.complete,
            "bytes_fetched": sum(one.size - one.resumed for one in self.fetched),
            "files": [self._facts(wanted, state, fetched.get(wanted.remote)) for wanted, state in files],
            "errors": [named(path, error) for path, error in self.failed.items() if path not in known],
        }

    def _facts(self, wanted: Wanted, state: str, fetched: Fetched | None) -> dict[str, Any]:
        why = self.failed.get(wanted.remote)
        if why is not None:
            state = "growing" if isinstance(why, StillGrowing) else "failed"
        return {
            "path": os.fsdecode(wanted.remote),
            "local": str(wanted.local),
            "size": wanted.size if fetched is None else fetched.size,
            "mtime": wanted.mtime,
            "state": "fetched" if fetched else state,
            "resumed_at": fetched.resumed if fetched else wanted.size if state == "here" else wanted.begun,
            "proof": None if fetched is None else fetched.proof,
            "error": None if why is None else str(why),
        }


@dataclass(frozen=True, slots=True)
class Downloads:
    """Brings files one after the other, and fills `outcome` meanwhile, so that it tells of a run that was
    ended, too. tell: hears of each that came; complain: in a line of each that did not."""

    fetcher: Fetcher
    outcome: Outcome
    tell: Callable[[Fetched], None]
    complain: Callable[[str], None]

    async def sync(self, wish: Wish) -> None:
        """Bring the logs.

        Raises:
            NotFound: no directory of logs. LinkError: the vehicle, or the mount, is gone; UsageError: the
            local disk is full. RequestTimeout: for MAX_TIMEOUTS files. Of what else fails `complain` hears.
        """
        session = self.fetcher.session
        if wish.place is None:
            place, found, unlisted = await find_logs(session)
        else:
            place = wish.place
            found, unlisted = await walk(session.files, place)
        self.outcome.place = session.on_vehicle(place)
        for path, error in unlisted:
            self.fail(path, error)
        logs = [
            _wanted(join(place, below), wish.local / os.fsdecode(below), below, stat, keep_old=True)
            for below, stat in found
            if stat.kind is EntryKind.FILE
        ]
        chosen = _apart(select(newest_first(logs), newest=wish.newest, since=wish.since))
        self.outcome.here = [log for log in chosen if log.here]
        self.outcome.wanted = [log for log in chosen if not log.here]
        if wish.dry_run:
            self.outcome.finished = True
            return
        with local_disk(wish.local):
            wish.local.mkdir(parents=True, exist_ok=True)
        await self._fetch_all(alone=False)

    async def get(self, paths: Sequence[bytes], local: Path, *, recursive: bool) -> None:
        """Fetch files, and with `recursive` directories, to `local`: a directory, or one file's new name.

        Raises:
            As Fetcher.fetch where only one file is asked for, else as `sync`.
        """
        alone = len(paths) == 1
        found: list[Wanted] = []
        for path in paths:
            place = local_name(local, path, single=alone)
            try:
                stat = await self.fetcher.session.files.stat(path)
                if stat.kind is EntryKind.FILE:
                    found.append(_wanted(path, place, path, stat))
                    continue
                if not recursive:
                    raise IsADirectory(f"{name_text(path)} is a directory; get it with -r")
                below, unlisted = await walk(self.fetcher.session.files, path)
                found += _made(path, place, below)
                for unreadable, error in unlisted:
                    self.fail(unreadable, error)
                alone = False
            except MavftpfsError as exc:
                self.fail(path, exc, alone=alone)
        self.outcome.wanted = _apart(found)
        await self._fetch_all(alone=alone)

    async def cat(self, paths: Sequence[bytes], take: Take) -> None:
        """Hand on the bytes of files, one behind the other.

        Raises:
            As Fetcher.write_to where only one file is asked for; LinkError always.
        """
        for path in paths:
            try:
                await self.fetcher.write_to(path, take)
            except MavftpfsError as exc:
                self.fail(path, exc, alone=len(paths) == 1)

    async def _fetch_all(self, *, alone: bool) -> None:
        wanted, progress = self.outcome.wanted, self.fetcher.progress
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
                self.outcome.fetched.append(fetched)
                self.tell(fetched)
            progress.end(one.size)
        self.outcome.finished = True

    def fail(self, path: bytes, error: MavftpfsError, name: str = "", *, alone: bool = False) -> None:
        """Say it and go on, or end where the others would fare no better, or where there are none."""
        self.outcome.failed[path] = error
        if alone or isinstance(error, LinkError | LocalDiskFull):
            raise error
        self.complain(named(name or path, error))


def local_name(local: Path, path: bytes, *, single: bool) -> Path:
    """Return where a remote path goes: into a directory, or under the new name of a single thing."""
    name = os.fsdecode(split(path)[1])
    return local / name if local.is_dir() or not single else local


def _made(path: bytes, place: Path, found: Found) -> list[Wanted]:
    """Make the directories below a directory, and return its files."""
    files = []
    with local_disk(place):
        place.mkdir(parents=True, exist_ok=True)
        for below, stat in found:
            remote, local = join(path, below), place / os.fsdecode(below)
            if stat.kind is EntryKind.FILE:
                files.append(_wanted(remote, local, remote, stat))
            else:
                local.mkdir(exist_ok=True)
    return files


def named(name: bytes | str, error: MavftpfsError) -> str:
    """Return an error with the name of what it is about, which some have already."""
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
    """Return how a directory of the vehicle is called below the root that is used, None if it is not."""
    if root == place or root.startswith(place + b"/"):
        return b"/"
    if root == b"/":
        return place
    return place[len(root) :] if place.startswith(root + b"/") else None


def newest_first(logs: Iterable[Wanted]) -> list[Wanted]:
    """Order logs: by time, then by their numbers. Those without a time come last, then what is no log."""

    def age(log: Wanted) -> tuple[bool, int, object]:
        return not log.remote.endswith(NO_LOG), log.mtime or 0, natural(log.remote)

    return sorted(logs, key=age, reverse=True)


def select(logs: Sequence[Wanted], *, newest: int | None, since: float | None) -> list[Wanted]:
    """Return the newest N, of those that are not older than `since` (seconds UTC).

    A log without a time is not left out by `since`: it may be a new one.
    """
    young = [log for log in logs if since is None or log.mtime is None or log.mtime >= since]
    return young if newest is None else young[:newest]


def natural(name: bytes) -> tuple[tuple[int, int, bytes], ...]:
    """Return a key by which `log10` comes after `log9`."""
    parts = re.split(rb"(\d+)", name)
    return tuple((1, int(part), b"") if part.isdigit() else (0, 0, part) for part in parts)
