"""The end of a mount that was written to: deliver, or keep what could not be delivered. Layer: top."""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

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


def recovery_directory(environment: Mapping[str, str], source: str, at: float) -> Path:
    """Return a new name for what one mount leaves behind; `at` is seconds since 1970."""
    when = time.strftime("%Y%m%d-%H%M%S", time.localtime(at))
    what = re.sub(r"[^A-Za-z0-9._-]+", "_", source)[:60]
    return state_directory(environment) / "mavftpfs" / "recovered" / f"{when}-{os.getpid()}-{what}"


async def deliver(holder: Holder, limit: float = DRAIN_LIMIT) -> None:
    """Deliver what is held, saying so, for at most `limit` seconds."""
    waiting = holder.undelivered()
    if not waiting:
        return
    log.warning("delivering %d file(s) to the vehicle before ending", len(waiting))
    await holder.drain(limit)


def keep_the_rest(holder: Holder, choose: Callable[[], Path]) -> str:
    """Copy what is still undelivered to a local directory; return the line that says so, or ""."""
    left = holder.undelivered()
    if not left:
        return ""
    directory = choose()
    try:
        holder.recover_to(directory)
    except OSError as exc:
        return (
            f"{len(left)} file(s) did not reach the vehicle, and {directory} is not writable: {exc.strerror}"
        )
    return f"{len(left)} file(s) did not reach the vehicle; they are kept in {directory}"


async def say_goodbye(holder: Holder, source: str) -> str:
    """Deliver or keep; returns "" or the line to show with exit code 4. Keeps also when cancelled."""
    message = ""
    try:
        await deliver(holder)
    finally:
        message = keep_the_rest(holder, lambda: recovery_directory(os.environ, source, time.time()))
        if message:
            log.error("%s", message)
    return message
