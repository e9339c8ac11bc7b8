"""The life of a mount: its state, the signals, and the programs that wait for its end. Layer: mount.

docs/processes.md has a table of the events that end a mount in each state. The first SIGINT, SIGTERM or
SIGHUP makes the mount leave, the next one makes it hurry.

The two kinds of mount, `mount.single` and `mount.supervisor`, define how to leave.
"""

from __future__ import annotations

import logging
import os
import secrets
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

import trio

import mavftpfs
from mavftpfs.client import wire
from mavftpfs.client.connect import NO_SINKS, Sinks
from mavftpfs.client.control import FOREIGN, SYSTEM, Reply
from mavftpfs.client.mounts import network_namespace
from mavftpfs.link.uri import LinkSpec
from mavftpfs.mount.controlserver import ControlServer
from mavftpfs.mount.daemon import Report, ending_signals
from mavftpfs.mount.fileserver import FileServer
from mavftpfs.shared.errors import ExitCode, MavftpfsError, MountFailed, UsageError, exit_code_for
from mavftpfs.shared.options import Options

log = logging.getLogger("mavftpfs.mount")

LAST_REPLIES = 3.0
"""Seconds to send their reply to the programs that wait for the end."""


class State(Enum):
    """The states of a mount."""

    STARTING = "starting"
    """The mount waits for the vehicle; the kernel has no mount yet."""
    MOUNTED = "mounted"
    """Programs get answers."""
    LEAVING = "leaving"
    """Programs get no more answers. The mount uploads pending changes, or saves them."""
    ENDED = "ended"
    """The exit code is known; the programs that waited for it get their reply."""


NEXT = {
    State.STARTING: {State.MOUNTED, State.ENDED},
    State.MOUNTED: {State.LEAVING, State.ENDED},  # ENDED: by an error
    State.LEAVING: {State.ENDED, State.MOUNTED},  # MOUNTED: one vehicle of several is in use
    State.ENDED: set[State](),
}
"""State -> the states that may follow."""


@dataclass(frozen=True, slots=True)
class MountRequest:
    """A mount to make. mountpoint: absolute; control: the control socket's path, None = without."""

    source: str
    spec: LinkSpec
    mountpoint: str
    options: Options
    control: Path | None = None
    sinks: Sinks = NO_SINKS


class Life(ABC):
    """A mount from start to end."""

    def __init__(self, request: MountRequest, report: Report) -> None:
        self.request = request
        self.state = State.STARTING
        self._code = ExitCode.OK
        self._last_words: list[str] = []
        self._report: Report | None = report
        self._scope = trio.CancelScope()
        self._ended = trio.Event()
        self._control: ControlServer | None = None
        self._started = time.time()
        self._id = secrets.token_hex(8)

    # -- what the two kinds of mount say

    @abstractmethod
    async def serve(self, nursery: trio.Nursery) -> None:
        """Mount, and serve until the mount has left. nursery: for tasks that run until the mount has
        ended."""

    @abstractmethod
    async def unmount(self, *, lazy: bool) -> None:
        """Unmount, and leave; lazy: even if programs use the mount.

        Raises:
            MountFailed: programs use the mount, which continues.
        """

    @abstractmethod
    def leave(self) -> None:
        """Leave, even if programs use the mount."""

    @abstractmethod
    def hurry(self) -> None:
        """Upload no more: save the remaining pending changes."""

    @abstractmethod
    def status(self) -> Mapping[str, Any]:
        """Return the facts beside those of every mount; JSON-able."""

    # -- from start to end

    async def run(self) -> int:
        """Live; return the exit code."""
        async with trio.open_nursery() as nursery:
            await nursery.start(self._watch_signals)
            try:
                with self._scope:
                    await self.serve(nursery)
            except MavftpfsError as error:
                self._fail(exit_code_for(error), str(error))
            if self._scope.cancelled_caught and self.state is State.STARTING:
                self._fail(ExitCode.INTERRUPTED, "interrupted")
            self.enter(State.ENDED)
            self._ended.set()
            if self._control is not None:
                self._control.close()
                with trio.move_on_after(LAST_REPLIES):
                    await self._control.closed.wait()
            nursery.cancel_scope.cancel()
        return self._code

    def enter(self, state: State) -> None:
        """Enter another state."""
        assert state in NEXT[self.state], (self.state, state)
        self.state = state

    def stop(self) -> None:
        """Cancel `serve`."""
        self._scope.cancel()

    def tell_mounted(self, notice: str) -> None:
        """Tell the command that waits for the mount that it is up; notice: a line for its user."""
        if notice:
            log.warning("%s", notice)
        report, self._report = self._report, None
        if report is not None:
            report(ExitCode.OK, notice)

    def note_end(self, code: int, words: str) -> None:
        """Note the exit code of a part of the mount, and a line for the program that unmounts, or ""."""
        self._code = max(self._code, ExitCode(code))
        self._last_words += [words] if words else []

    def _fail(self, code: ExitCode, reason: str) -> None:
        """Report a failure to the command that waits for the mount; once that has its answer, to the log."""
        self.note_end(code, "")
        if self._report is not None:
            self._report(code, reason)
        else:
            log.error("unmounted: %s", reason)

    # -- what ends it

    async def _watch_signals(self, task_status: trio.TaskStatus[None] = trio.TASK_STATUS_IGNORED) -> None:
        with trio.open_signal_receiver(*ending_signals()) as signals:
            task_status.started()
            async for number in signals:
                log.info("signal %s", signal.Signals(number).name)
                match self.state:
                    case State.STARTING:
                        self.stop()
                    case State.MOUNTED:
                        self.leave()
                    case State.LEAVING:
                        self.hurry()

    async def start_control(self, nursery: trio.Nursery, files: FileServer | None = None) -> None:
        """Answer `mavftpfs status` and `umount`, and serve files to commands and programs."""
        path = self.request.control
        if path is None:
            return

        async def status(_: Reply) -> Reply:
            return {"status": self.facts()}

        commands = {"status": status, "umount": self._umount}
        if files is not None:
            commands["files"] = partial(self._serve_files, files)
        mode = 0o666 if path.parent == SYSTEM else 0o600
        server = ControlServer(path, commands, files=files, refusal=self._refusal, mode=mode)
        try:
            await nursery.start(server.run)
        except OSError as exc:
            log.warning("no control socket, so no `mavftpfs status`: %s", exc)
        else:
            self._control = server

    def _refusal(self, uid: int) -> str:
        """Return the reason why a user may not use the mount by commands, or ""."""
        served = uid in (0, os.getuid(), self.request.options.uid)
        return "" if served else FOREIGN

    async def _serve_files(self, files: FileServer, request: Reply) -> Reply:
        if request.get("version") != wire.VERSION:
            raise UsageError(
                f"this mount is of mavftpfs {mavftpfs.__version__}, and the program of another version"
            )
        refusal = files.refusal()
        if refusal:
            raise UsageError(refusal)
        return {"id": self._id}

    async def _umount(self, request: Reply) -> Reply:
        ours, place = os.getuid(), self.request.mountpoint
        if request["uid"] not in (0, ours):
            raise MountFailed(
                f"cannot unmount {place}: another user mounted it, and only uid {ours} or root may"
            )
        await self.unmount(lazy=bool(request.get("lazy")))
        await self._ended.wait()
        return {"exit_code": int(self._code), "pid": os.getpid(), "message": "; ".join(self._last_words)}

    def identity(self) -> dict[str, Any]:
        """Return the facts for any program that may look at the mount, JSON-able: the mount's identity and
        its control socket."""
        return {
            "mountpoint": self.request.mountpoint,
            "source": self.request.source,
            "version": mavftpfs.__version__,
            "protocol": wire.VERSION,
            "id": self._id,
            "socket": None if self._control is None else str(self._control.path),
            "network_namespace": network_namespace(),
        }

    def facts(self) -> dict[str, Any]:
        """Return the status for people and scripts; JSON-able."""
        return {
            **self.identity(),
            "state": "unmounting" if self.state is State.LEAVING else "mounted",
            "problem": None,
            "pid": os.getpid(),
            "uptime": round(time.time() - self._started, 1),
            **self.status(),
        }
