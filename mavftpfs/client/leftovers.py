"""Where undelivered files lie on this computer: spools, and recovery directories. Layer: client."""

from __future__ import annotations

import logging
import os
import re
import shlex
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mavftpfs.cache.recovery import SpoolDirectory, left_in
from mavftpfs.client.recovered import recovered_in
from mavftpfs.link.messages import Address
from mavftpfs.shared.readable import count_files

log = logging.getLogger("mavftpfs.mount")


def state_directory() -> Path:
    """Return where this user's mounts keep files that must survive them (XDG base directories)."""
    given = os.environ.get("XDG_STATE_HOME", "")
    base = Path(given) if given.startswith("/") else Path.home() / ".local" / "state"
    return base / "mavftpfs"


def recovered_directory() -> Path:
    """Return where all mounts of this user leave files that did not reach a vehicle."""
    return state_directory() / "recovered"


def recovery_directory(source: str) -> Path:
    """Return a new name for what one mount leaves behind now."""
    what = re.sub(r"[^A-Za-z0-9._-]+", "_", source)[:60]
    return recovered_directory() / f"{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}-{what}"


def what_to_do(source: str, directory: Path) -> str:
    """Return the words that tell people what to do with a recovery directory: `recover` refuses parts."""
    found = recovered_in(directory)
    them = "it" if len(found) == 1 else "them"
    if all(copy.hindrance for copy in found):
        return f"list {them} by: mavftpfs recover"
    return f"put {them} back by: {shlex.join(['mavftpfs', 'recover', source, str(directory)])}"


def spool_base(vehicle: Address | None) -> Path:
    """Return where the mounts of one vehicle have their spools: by its address, whatever the link."""
    name = "unknown" if vehicle is None else f"{vehicle.system}-{vehicle.component}"
    return state_directory() / "spool" / name


def left_by_killed_mounts() -> list[Path]:
    """Return the undelivered files that killed mounts of this user left. The next mount of each vehicle
    offers them."""
    try:
        slots = sorted((state_directory() / "spool").glob("*/slot*"))
    except OSError:  # another user's: we run in that user's environment
        return []
    return [data for slot in slots for data in left_in(slot)]


@contextmanager
def spool_for(vehicle: Address | None) -> Iterator[SpoolDirectory | None]:
    """Claim a spool directory for the length of the body; None if this user can have none."""
    base = spool_base(vehicle)
    try:
        spool = SpoolDirectory(base)
    except OSError as exc:
        log.warning("what waits for the vehicle will not survive this process: %s: %s", base, exc)
        yield None
        return
    try:
        yield spool
    finally:
        spool.close()


def rescue(spool: SpoolDirectory, source: str) -> str:
    """Move the files that a killed mount of this vehicle, or of another one with its system id, left to a
    recovery directory; return a line on them, or ""."""
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
