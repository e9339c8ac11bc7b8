"""Downloads a vehicle's logs, newest first, or compares those that are here. Layer: client; silent."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from mavftpfs.client.compare import Verify, compare, wants_checksum
from mavftpfs.client.download import Downloads, wanted_file
from mavftpfs.client.fetch import Fetched, Wanted, local_disk
from mavftpfs.client.files import Found, Session, Unlisted, walk
from mavftpfs.client.manifest import NAME, Downloaded, Manifest
from mavftpfs.client.selection import EVERYTHING, Selection
from mavftpfs.shared.errors import MavftpfsError, NotADirectory, NotFound, UsageError
from mavftpfs.shared.model import EntryKind, join
from mavftpfs.shared.readable import name_text

LOG_PLACES = (b"/fs/microsd/log", b"/APM/LOGS", b"/logs", b"/log", b"/var/APM/logs", b"/@MAV_LOG")
"""The directories of logs: PX4's, ArduPilot's, ArduPilot's simulator's, PX4's simulator's, ArduPilot's on
Linux, and the standard's alias. The alias comes last, because it shows one of the others again."""


@dataclass(frozen=True, slots=True)
class SyncRequest:
    """The logs to download. place: their directory on the vehicle, None to find it."""

    local: Path
    place: bytes | None = None
    selection: Selection = EVERYTHING
    dry_run: bool = False


class Record(Protocol):
    """The logs that earlier runs downloaded."""

    async def missing(self, session: Session, logs: Sequence[Wanted]) -> list[Wanted]:
        """Return the logs to download or to verify now."""

    def note(self, session: Session, fetched: Fetched) -> None:
        """Note a downloaded log.

        Raises:
            OSError: the local disk refuses it.
        """


class Unproven:
    """The record of plain `sync`: a log whose name and size are here was downloaded, and the manifest names
    those whose checksum the vehicle did not report then."""

    def __init__(self, local: Path, verify: Verify) -> None:
        """Raises: OSError: the manifest cannot be read."""
        self._manifest = Manifest(local)
        self._verify = verify

    async def missing(self, session: Session, logs: Sequence[Wanted]) -> list[Wanted]:
        """See Record."""
        return [log for log in logs if not log.here or self._verifies(session, log)]

    def _verifies(self, session: Session, log: Wanted) -> bool:
        known = self._manifest.of(None, path_of(session, log))
        unproven = known is not None and not known.proven and known.size == log.size
        return self._verify == "all" or (unproven and wants_checksum(self._verify, log.size))

    def note(self, session: Session, fetched: Fetched) -> None:
        """See Record."""
        log, path = fetched.wanted, path_of(session, fetched.wanted)
        if not fetched.proven or self._manifest.of(None, path) is not None:
            self._manifest.note(Downloaded(path, log.name, fetched.size, log.mtime, proven=fetched.proven))


def path_of(session: Session, log: Wanted) -> str:
    """Return the path of a log on the vehicle, in the manifest's spelling."""
    return os.fsdecode(session.on_vehicle(log.remote))


async def sync(downloads: Downloads, request: SyncRequest, record: Record | None = None) -> None:
    """Download the missing logs, and verify those here as far as the record requires it.

    record: None for that of plain `sync`.

    Raises:
        NotFound: there is no directory of logs. LinkError: the vehicle, or the mount, is gone. UsageError:
        the local disk is full. RequestTimeout: for MAX_TIMEOUTS files. Other failures are reported.
    """
    session, outcome = downloads.fetcher.session, downloads.outcome
    logs = await _listed(downloads, request)
    if request.dry_run:
        wanted = [log for log in logs if not log.here]
    else:
        with local_disk(request.local):
            request.local.mkdir(parents=True, exist_ok=True)
            record = record or Unproven(request.local, downloads.fetcher.verify)
        wanted = await record.missing(session, logs)
    missing = set(wanted)
    outcome.here = [log for log in logs if log.here and log not in missing]
    warning = request.selection.warning(wanted)
    if warning:
        downloads.reports.says(warning)
    if record is None:
        outcome.wanted, outcome.finished = wanted, True
        return

    def note(fetched: Fetched) -> None:
        with local_disk(request.local):
            record.note(session, fetched)

    await downloads.fetch_all(wanted, note=note)


async def check(downloads: Downloads, request: SyncRequest) -> None:
    """Compare the logs that are here with the vehicle's, and download nothing.

    Raises:
        As `sync`.
    """
    session, outcome, progress = downloads.fetcher.session, downloads.outcome, downloads.fetcher.progress
    outcome.checked = True
    for log in await _listed(downloads, request):
        (outcome.here if log.local.is_file() else outcome.wanted).append(log)
    progress.plan(len(outcome.here), sum(log.size for log in outcome.here))
    for log in outcome.here:
        progress.begin(log.name, log.size, log.size)
        progress.check()
        try:
            with local_disk(log.local):
                outcome.verified[log.remote] = await compare(session, log.remote, log.local, size=log.size)
        except MavftpfsError as exc:
            downloads.fail(log.remote, exc, log.name)
        progress.end(log.size)
    outcome.finished = True


async def _listed(downloads: Downloads, request: SyncRequest) -> list[Wanted]:
    """List the logs; return those that the user selected, the newest first.

    Raises:
        NotFound: there is no directory of logs. NotADirectory, UsageError: a file is where a directory is
        needed. Otherwise as `walk`.
    """
    session, selection = downloads.fetcher.session, request.selection
    if request.local.exists() and not request.local.is_dir():
        raise UsageError(f"{request.local} is a file; the logs go into a directory")
    await session.files.refresh()  # a mount may have listed the logs before the last flight
    if request.place is None:
        place, found, unlisted = await find_logs(session)
    else:
        place = request.place
        if (await session.files.stat(place)).kind is EntryKind.FILE:
            raise NotADirectory(f"{name_text(place)} is a file; get it with `mavftpfs get`")
        found, unlisted = await walk(session.files, place)
    downloads.outcome.place = session.on_vehicle(place)
    logs = [
        wanted_file(join(place, below), request.local / os.fsdecode(below), below, stat, keep_old=True)
        for below, stat in found
        if stat.kind is EntryKind.FILE and below != NAME.encode()  # a manifest that was copied to the card
    ]
    taken = [log for log in logs if selection.takes(log.remote.removeprefix(join(place, b"")))]
    if logs and not taken:
        downloads.reports.says(f"--include and --exclude leave no log to download ({len(logs)} in all)")
    for path, error in unlisted:
        downloads.fail(path, error)
    return selection.of_logs(taken)


async def find_logs(session: Session) -> tuple[bytes, Found, Unlisted]:
    """Return the directory with the vehicle's logs, and the result of `walk` for it.

    The function takes the first known directory with a file in it, or with a part that cannot be listed.

    Raises:
        NotFound: no known directory has files.
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
    """Return the path of a vehicle's directory below the session's root, None if it is elsewhere."""
    if root == place or root.startswith(place + b"/"):
        return b"/"
    if root == b"/":
        return place
    return place[len(root) :] if place.startswith(root + b"/") else None
