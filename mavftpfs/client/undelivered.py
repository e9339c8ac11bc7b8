"""Files that did not reach a vehicle: their places on this computer, and descriptions. Layer: client.

A mount keeps pending changes in a spool. At its end it moves them to a recovery directory, with a `NAME.json`
beside each file (cache.recovery). After a kill the next mount of the vehicle does that.
"""

from __future__ import annotations

import json
import logging
import os
import re
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mavftpfs.cache.recovery import SpoolDirectory, left_in
from mavftpfs.link.messages import Address
from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.model import normalise
from mavftpfs.shared.readable import count_files

log = logging.getLogger("mavftpfs.mount")


# -- directories ----------------------------------------------------------------------------------


def state_directory() -> Path:
    """Return the directory for files that must survive this user's mounts (XDG base directories)."""
    given = os.environ.get("XDG_STATE_HOME", "")
    base = Path(given) if given.startswith("/") else Path.home() / ".local" / "state"
    return base / "mavftpfs"


def recovered_directory() -> Path:
    """Return the directory where all mounts of this user leave files that did not reach a vehicle."""
    return state_directory() / "recovered"


def recovery_directory(source: str) -> Path:
    """Return a new name for the files that one mount leaves behind now."""
    what = re.sub(r"[^A-Za-z0-9._-]+", "_", source)[:60]
    return recovered_directory() / f"{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}-{what}"


# -- recovered files -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Recovered:
    """The local copy of a file that did not reach the vehicle.

    facts: the description beside it, from JSON.
    """

    file: Path
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def path(self) -> bytes | None:
        """Its path on the vehicle, None if the description lacks it."""
        path = self.facts.get("path")
        return normalise(os.fsencode(path)) if isinstance(path, str) and path else None

    @property
    def size(self) -> int:
        """Bytes of the local copy."""
        return self.file.stat().st_size

    @property
    def vehicle(self) -> str:
        """Its vehicle, for people; "" if the description lacks it."""
        system, uid = self.facts.get("system"), self.facts.get("uid")
        if system is None:
            return ""
        return f"vehicle {system} (id {uid})" if uid else f"vehicle {system}"

    def is_of_another(self, vehicle: Mapping[str, Any]) -> bool:
        """Return whether the file belongs to another vehicle than this one (as in `status --json`). False if
        one of them has no unique id.

        A board may have a long id and a short one, and MAVLink 1 carries only the short one. If the file has
        one of them and the vehicle the other, they count as different boards.
        """
        mine, other = self.facts.get("uid"), vehicle.get("uid")
        return bool(mine and other and mine != other)

    @property
    def hindrance(self) -> str:
        """The reason why `recover` cannot upload the file, or ""."""
        if self.path is None:
            return "its path on the vehicle is unknown"
        if "whole" not in self.facts:
            return "its program had not closed it, so it may be incomplete"
        if not self.facts.get("whole"):
            return "only the changed parts of it are here, and zeros between them"
        broken = self.facts.get("broken")
        return "a write failed, so this is only the part that was written before" if broken else ""


def recovered_below(base: Path) -> list[Recovered]:
    """Return all files in the recovery directories, the oldest directory first.

    Raises:
        UsageError: the directories cannot be read.
    """
    try:
        directories = sorted(path for path in base.iterdir() if path.is_dir())
    except FileNotFoundError:
        return []
    except OSError as exc:
        raise UsageError(f"{base}: {exc.strerror}") from exc
    return [copy for directory in directories for copy in recovered_in(directory)]


def recovered_in(directory: Path) -> list[Recovered]:
    """Return the files in one recovery directory. Remove descriptions whose files a person removed.

    Raises:
        UsageError: the directory cannot be read.
    """
    try:
        paths = {path for path in directory.iterdir() if path.is_file() and not path.is_symlink()}
    except OSError as exc:
        raise UsageError(f"{directory}: {exc.strerror}") from exc
    files = {path for path in paths if not (path.suffix == ".json" and path.with_suffix("") in paths)}
    strays = {path for path in files if Path(f"{path}.json") not in paths and _is_description(path)}
    for stray in strays:
        with suppress(OSError):
            stray.unlink()
    return [Recovered(path, _read_facts(Path(f"{path}.json"))) for path in sorted(files - strays)]


def _is_description(path: Path) -> bool:
    """Return whether a file describes another one; a user's file may have such a name, too."""
    return path.suffix == ".json" and _read_facts(path).keys() >= {"path", "system", "uid"}


def _read_facts(path: Path) -> dict[str, Any]:
    """Return the content of a description; {} if it is damaged."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def chosen(names: Sequence[str], base: Path) -> list[Recovered]:
    """Return the files that a person named: by their paths, or by a directory for all files in it.

    Raises:
        UsageError: there is no such file.
    """
    found: list[Recovered] = []
    for name in names:
        path = Path(name) if os.path.exists(name) else base / name
        if path.is_dir():
            found += recovered_in(path)
            continue
        if not path.is_file():
            raise UsageError(
                f"there is no recovered file {name}; give DIRECTORY/FILE as listed by: mavftpfs recover"
            )
        found += [copy for copy in recovered_in(path.parent) if copy.file.name == path.name]
    return found


def what_to_do(source: str, directory: Path) -> str:
    """Return the command for people who have a recovery directory; `recover` refuses parts of files."""
    found = recovered_in(directory)
    them = "it" if len(found) == 1 else "them"
    if all(copy.hindrance for copy in found):
        return f"list {them} with: mavftpfs recover"
    return f"upload {them} with: {shlex.join(['mavftpfs', 'recover', source, str(directory)])}"


# -- spools ---------------------------------------------------------------------------------------


def spool_base(vehicle: Address | None) -> Path:
    """Return the directory with the spools of one vehicle's mounts, which its address names, whatever the
    link."""
    name = "unknown" if vehicle is None else f"{vehicle.system}-{vehicle.component}"
    return state_directory() / "spool" / name


def left_by_killed_mounts() -> list[Path]:
    """Return the undelivered files that killed mounts of this user left. The next mount of each vehicle
    offers them."""
    try:
        slots = sorted((state_directory() / "spool").glob("*/slot*"))
    except OSError:  # the directory is another user's, in whose environment this program runs
        return []
    return [data for slot in slots for data in left_in(slot)]


@contextmanager
def spool_for(vehicle: Address | None) -> Iterator[SpoolDirectory | None]:
    """Claim a spool directory for the length of the body; None if this user can have none."""
    base = spool_base(vehicle)
    try:
        spool = SpoolDirectory(base)
    except OSError as exc:
        log.warning("pending changes will not survive this process: %s: %s", base, exc)
        yield None
        return
    try:
        yield spool
    finally:
        spool.close()


def rescue(spool: SpoolDirectory, source: str) -> str:
    """Move the files that a killed mount of this vehicle, or of another one with its system id, left to a
    recovery directory; return a line about them, or ""."""
    directory = recovery_directory(source)
    try:
        found = spool.rescue(directory)
    except OSError as exc:
        message = (
            f"an earlier mount left files that did not reach their vehicle in {spool.path.parent}: {exc}"
        )
    else:
        if not found:
            return ""
        place = f"it is in {directory}" if len(found) == 1 else f"they are in {directory}"
        message = (
            f"{count_files(len(found))} of an earlier mount did not reach the vehicle; {place}; "
            + what_to_do(source, directory)
        )
    return message
