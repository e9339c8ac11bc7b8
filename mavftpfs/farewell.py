"""What outlives a mount that was written to: the spool, and what could not be delivered. Layer: top."""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from random import SystemRandom
from typing import Protocol

from mavftpfs.cache.recovery import SpoolDirectory, left_in
from mavftpfs.link.messages import Address
from mavftpfs.shared.errors import MavftpfsError

log = logging.getLogger("mavftpfs.mount")

DRAIN_LIMIT = 300.0
"""Seconds to go on delivering after the kernel let go; a second signal ends it sooner."""


class Holder(Protocol):
    """What may still hold bytes the vehicle does not have (cache.tree.Tree)."""

    def undelivered(self) -> Sequence[bytes]: ...
    async def drain(self, timeout: float) -> Sequence[bytes]: ...
    def recover_to(self, directory: Path) -> Sequence[Path]: ...


def state_directory(environment: Mapping[str, str]) -> Path:
    """Return where this user's programs keep what must survive them (XDG base directories)."""
    given = environment.get("XDG_STATE_HOME", "")
    return Path(given) if given.startswith("/") else Path.home() / ".local" / "state"


def recovered_directory(environment: Mapping[str, str]) -> Path:
    """Return where all mounts of this user leave what did not reach a vehicle."""
    return state_directory(environment) / "mavftpfs" / "recovered"


def recovery_directory(environment: Mapping[str, str], source: str, at: float) -> Path:
    """Return a new name for what one mount leaves behind; `at` is seconds since 1970."""
    when = time.strftime("%Y%m%d-%H%M%S", time.localtime(at))
    what = re.sub(r"[^A-Za-z0-9._-]+", "_", source)[:60]
    return recovered_directory(environment) / f"{when}-{os.getpid()}-{what}"


async def deliver(holder: Holder, limit: float = DRAIN_LIMIT) -> None:
    """Deliver what is held, saying so, for at most `limit` seconds."""
    waiting = holder.undelivered()
    if not waiting:
        return
    log.warning("delivering %d file(s) to the vehicle before ending", len(waiting))
    await holder.drain(limit)


def keep_the_rest(holder: Holder, choose: Callable[[], Path]) -> str:
    """Move what is still undelivered to a local directory; return the line that says so, or ""."""
    left = holder.undelivered()
    if not left:
        return ""
    directory = choose()
    try:
        kept = holder.recover_to(directory)
    except OSError as exc:
        return (
            f"{len(left)} file(s) did not reach the vehicle, and {directory} is not writable: {exc.strerror}"
        )
    except MavftpfsError as exc:
        return f"{len(left)} file(s) did not reach the vehicle, and could not be moved to {directory}: {exc}"
    if len(kept) == len(left):
        return f"{len(left)} file(s) did not reach the vehicle; they are kept in {directory}"
    return (
        f"{len(left)} file(s) did not reach the vehicle; only {len(kept)} could be kept, in {directory}; "
        "the log says why, and the next mount looks for the others"
    )


async def say_goodbye(holder: Holder, source: str, tell: Callable[[str], None]) -> None:
    """Deliver or keep; `tell` gets the line that goes with exit code 4. Keeps also when cancelled."""
    try:
        await deliver(holder)
    finally:
        message = keep_the_rest(holder, lambda: recovery_directory(os.environ, source, time.time()))
        if message:
            log.error("%s", message)
            tell(message)


# -- what an earlier mount left ---------------------------------------------------------------------


def spool_base(environment: Mapping[str, str], vehicle: Address | None) -> Path:
    """Return where the mounts of one vehicle keep what they hold: by its address, whatever the link."""
    name = "unknown" if vehicle is None else f"{vehicle.system}-{vehicle.component}"
    return state_directory(environment) / "mavftpfs" / "spool" / name


def left_by_killed_mounts(environment: Mapping[str, str]) -> list[Path]:
    """Return what killed mounts of this user hold that no vehicle has; the next mount of each offers it."""
    spools = state_directory(environment) / "mavftpfs" / "spool"
    try:
        slots = sorted(spools.glob("*/slot*"))
    except OSError:  # another user's, who left us his environment
        return []
    return [data for slot in slots for data in left_in(slot)]


@contextmanager
def spool_for(vehicle: Address | None) -> Iterator[SpoolDirectory | None]:
    """Claim a spool directory for the length of the body; None if this user can have none."""
    base = spool_base(os.environ, vehicle)
    try:
        spool = SpoolDirectory(base, SystemRandom())
    except OSError as exc:
        log.warning("what waits for the vehicle will not survive this process: %s: %s", base, exc)
        yield None
        return
    try:
        yield spool
    finally:
        spool.close()


def rescue(spool: SpoolDirectory, source: str) -> str:
    """Move what a killed mount of this vehicle left to a recovery directory; return a line on it, or ""."""
    directory = recovery_directory(os.environ, source, time.time())
    try:
        found = spool.rescue(directory)
    except OSError as exc:
        message = f"an earlier mount left files that did not reach the vehicle in {spool.path.parent}: {exc}"
    else:
        if not found:
            return ""
        message = (
            f"{len(found)} file(s) of an earlier mount did not reach the vehicle; they are in {directory}"
        )
    log.warning("%s", message)
    return message
