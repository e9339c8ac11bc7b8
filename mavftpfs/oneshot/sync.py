"""Bringing the vehicle's logs into a local directory: newest first, resumed, proven. Layer: top; silent."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mavftpfs.oneshot.fetch import (
    Complain,
    Fetched,
    Fetcher,
    LocalDiskFull,
    Log,
    Step,
    StillGrowing,
    Wanted,
    decide,
    known_time,
    local_disk,
    named,
    newest_first,
    part_of,
    select,
)
from mavftpfs.oneshot.files import Files, Session
from mavftpfs.shared.errors import LinkError, MavftpfsError, NotADirectory, NotFound, RequestTimeout
from mavftpfs.shared.model import EntryKind, join
from mavftpfs.shared.readable import name_text

LOG_PLACES = (b"/fs/microsd/log", b"/APM/LOGS", b"/logs", b"/log", b"/var/APM/logs", b"/@MAV_LOG")
"""Where vehicles keep logs: PX4, ArduPilot, ArduPilot's simulator, PX4's simulator, ArduPilot on Linux, and
the standard's alias, which shows one of the others again and so comes last."""

MAX_TIMEOUTS = 2
"""Requests of so many files in a row that nobody answered end a run: the others would fare no better."""


@dataclass(frozen=True, slots=True)
class Wish:
    """What to bring. place: the directory on the vehicle, None to find it; newest: at most so many;
    since: not older, seconds UTC."""

    local: Path
    place: bytes | None = None
    newest: int | None = None
    since: float | None = None
    dry_run: bool = False


@dataclass(frozen=True, slots=True)
class Task:
    """One log and what is to be done about it. there: bytes that are here already."""

    log: Log
    local: Path
    part: Path
    step: Step
    there: int


@dataclass(slots=True)
class Outcome:
    """What a run did; `facts` is JSON-able. missing: (log, why it is not here)."""

    place: bytes = b""
    tasks: Sequence[Task] = ()
    fetched: list[Fetched] = field(default_factory=list)
    missing: list[tuple[Log, MavftpfsError]] = field(default_factory=list)
    unlisted: list[str] = field(default_factory=list)
    undated: int = 0
    finished: bool = False

    @property
    def complete(self) -> bool:
        """Whether everything that was wished for is here."""
        return self.finished and not self.missing and not self.unlisted

    @property
    def to_fetch(self) -> list[Task]:
        """The logs that are not here, or not whole."""
        return [task for task in self.tasks if task.step is not Step.SKIP]

    def facts(self) -> dict[str, Any]:
        """Return it for programs; the guide describes it."""
        fetched = {one.remote: one for one in self.fetched}
        why = {log.path: reason for log, reason in self.missing}
        return {
            "from": os.fsdecode(self.place),
            "complete": self.complete,
            "bytes_fetched": sum(one.size - one.resumed for one in self.fetched),
            "files": [
                _facts(task, fetched.get(task.log.path), why.get(task.log.path)) for task in self.tasks
            ],
            "errors": self.unlisted,
        }


def _facts(task: Task, fetched: Fetched | None, why: MavftpfsError | None) -> dict[str, Any]:
    state = "here" if task.step is Step.SKIP else "fetched" if fetched else "wanted"
    if why is not None:
        state = "growing" if isinstance(why, StillGrowing) else "failed"
    return {
        "path": os.fsdecode(task.log.path),
        "local": str(task.local),
        "size": task.log.size if fetched is None else fetched.size,
        "mtime": task.log.mtime,
        "state": state,
        "resumed_at": task.there if fetched is None else fetched.resumed,
        "proof": None if fetched is None else fetched.proof,
        "error": None if why is None else str(why),
    }


# -- what is there --------------------------------------------------------------------------------


async def find_place(session: Session) -> bytes:
    """Return the directory that holds the vehicle's logs: the first known one with a file in it.

    Raises:
        NotFound: there is none.
    """
    empty: bytes | None = None
    for place in LOG_PLACES:
        path = _below(session.root, place)
        if path is None:
            continue
        try:
            if (await session.files.stat(path)).kind is not EntryKind.DIRECTORY:
                continue
            if await _holds_a_file(session.files, path):
                return path
        except (NotFound, NotADirectory):
            continue
        empty = empty or path
    if empty is not None:
        return empty
    places = ", ".join(name_text(place) for place in LOG_PLACES)
    raise NotFound(f"no directory of logs was found (looked at {places}); name it with --from")


def _below(root: bytes, place: bytes) -> bytes | None:
    """Return how a directory of the vehicle is called below the root that is used, None if it is not."""
    if root == place or root.startswith(place + b"/"):
        return b"/"
    if root == b"/":
        return place
    return place[len(root) :] if place.startswith(root + b"/") else None


async def _holds_a_file(files: Files, path: bytes) -> bool:
    pending = [path]
    while pending:
        here = pending.pop()
        try:
            entries = await files.list(here)
        except LinkError:
            raise
        except MavftpfsError:
            if here == path:
                raise
            return True  # for all we know; `collect` says what it is
        for name, found in entries:
            if found.kind is EntryKind.FILE:
                return True
            pending.append(join(here, name))
    return False


async def collect(files: Files, place: bytes, complain: Complain) -> list[Log]:
    """Return all files below a directory; what cannot be listed is said, and left out.

    Raises:
        LinkError; of `place` itself whatever Files.list raises.
    """
    logs = []
    pending = [(place, b"")]
    while pending:
        path, below = pending.pop()
        try:
            entries = await files.list(path)
        except LinkError:
            raise
        except MavftpfsError as exc:
            if path == place:
                raise
            complain(f"{name_text(path)}: {exc}")
            continue
        for name, found in entries:
            inner = below + b"/" + name if below else name
            if found.kind is EntryKind.DIRECTORY:
                pending.append((join(path, name), inner))
            else:
                logs.append(Log(join(path, name), inner, found.size, known_time(found.mtime)))
    return logs


def look(logs: Sequence[Log], local: Path) -> list[Task]:
    """Compare logs with what is here, and say what to do."""
    places = [local / os.fsdecode(log.below) for log in logs]
    finals = set(places)
    return [_look_at(log, place, part_of(place, finals)) for log, place in zip(logs, places, strict=True)]


def _look_at(log: Log, place: Path, part: Path) -> Task:
    here, begun = _size(place), _size(part)
    step = decide(log.size, here, begun)
    there = {Step.SKIP: log.size, Step.RESUME: begun, Step.EXTEND: here}.get(step) or 0
    return Task(log, place, part, step, there)


def _size(path: Path) -> int | None:
    try:
        return path.stat().st_size if path.is_file() else None
    except OSError:
        return None


# -- the run --------------------------------------------------------------------------------------


async def sync(
    session: Session,
    wish: Wish,
    fetcher: Fetcher,
    outcome: Outcome,
    tell: Callable[[Fetched], None],
    complain: Complain,
) -> None:
    """Bring the logs; `outcome` is filled while it works, so that it tells also of a run that was ended.

    Raises:
        NotFound: no directory of logs. LinkError: the vehicle, or the mount, is gone; UsageError: the local
        disk is full. What else fails is said by `complain`, and the others go on.
    """

    def unlisted(line: str) -> None:
        outcome.unlisted.append(line)
        complain(line)

    place = wish.place if wish.place is not None else await find_place(session)
    outcome.place = session.on_vehicle(place)
    logs = newest_first(await collect(session.files, place, unlisted))
    chosen = select(logs, newest=wish.newest, since=wish.since)
    outcome.tasks = look(chosen, wish.local)
    outcome.undated = 0 if wish.since is None else sum(log.mtime is None for log in chosen)
    if wish.dry_run:
        outcome.finished = True
        return
    tasks = outcome.to_fetch
    fetcher.progress.plan(len(tasks), sum(task.log.size for task in tasks))
    with local_disk(wish.local):
        wish.local.mkdir(parents=True, exist_ok=True)
    timeouts = 0
    for task in tasks:
        try:
            fetched = await _fetch(fetcher, task)
        except MavftpfsError as exc:
            outcome.missing.append((task.log, exc))
            timeouts = timeouts + 1 if isinstance(exc, RequestTimeout) else 0
            if isinstance(exc, LinkError | LocalDiskFull) or timeouts == MAX_TIMEOUTS:
                raise
            complain(named(task.log.below, exc))
        else:
            timeouts = 0
            outcome.fetched.append(fetched)
            tell(fetched)
        fetcher.progress.end(task.log.size)
    outcome.finished = True


async def _fetch(fetcher: Fetcher, task: Task) -> Fetched:
    log = task.log
    with local_disk(task.local):
        task.local.parent.mkdir(parents=True, exist_ok=True)
    name = name_text(log.below)
    wanted = Wanted(log.path, task.local, name, log.size, log.mtime, task.part, keep_old=True)
    return await fetcher.fetch(wanted, beginning=task.local if task.step is Step.EXTEND else None)
