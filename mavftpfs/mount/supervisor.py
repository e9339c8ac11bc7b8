"""A mount of all vehicles on a link: one ordinary mount for each, in a process of its own. Layer: mount.

This process has no vehicle, and no mount. It hears heartbeats through the hub, and starts, watches and ends
the mounts of the vehicles, each on a directory below the mountpoint (`mount.places`). If this process is
killed, the mounts continue.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import trio

from mavftpfs.client import control
from mavftpfs.client.connect import opened
from mavftpfs.client.listening import listening
from mavftpfs.client.mountpoint import is_dead, is_ours, timeout_note
from mavftpfs.link.base import plain_nursery
from mavftpfs.link.messages import Heartbeat
from mavftpfs.link.sharing import own_environment
from mavftpfs.mount import places
from mavftpfs.mount.daemon import Report
from mavftpfs.mount.life import Life, MountRequest, State
from mavftpfs.mount.members import Member, Members, MemberState
from mavftpfs.shared.errors import MountFailed

log = logging.getLogger("mavftpfs.mount")

PERIOD = 0.1
END_PATIENCE = 3600.0
"""Seconds for a vehicle's mount to upload pending changes and end."""

Command = Callable[[Member], list[str]]
"""Returns the words that mount one vehicle below the mountpoint, in the foreground."""


def run_all(request: MountRequest, command: Command, report: Report) -> int:
    """Mount all vehicles and serve until unmounted; return the exit code."""
    return trio.run(Supervisor(request, command, report).run)


class Supervisor(Life):
    """The mount of all vehicles. To leave, it has every vehicle's mount upload its changes and end."""

    def __init__(self, request: MountRequest, command: Command, report: Report) -> None:
        super().__init__(request, report)
        self._command = command
        self._members = Members()
        self._processes: dict[str, trio.Process] = {}
        self._first = trio.Event()
        self._left = trio.Event()
        self._ending = trio.Lock()
        self._nursery: trio.Nursery | None = None

    async def serve(self, nursery: trio.Nursery) -> None:
        """See Life.serve."""
        self._nursery = nursery
        options = self.request.options
        async with (
            opened(self.request.spec, options, shared=True) as link,
            listening(link, options, self._on_heard),
        ):
            self.enter(State.MOUNTED)
            await self.start_control(nursery)
            async with plain_nursery() as tasks:
                tasks.start_soon(self._keep_members, tasks)
                tasks.start_soon(self._tell_when_up)
                await self._left.wait()
        await trio.to_thread.run_sync(places.remove, self.request.mountpoint)

    async def _tell_when_up(self) -> None:
        with trio.move_on_after(self.request.options.connect_timeout):
            await self._first.wait()
            self.tell_mounted(timeout_note())
            return
        self.tell_mounted(
            f"no vehicle is heard on {self.request.spec.description} yet; each appears as it comes"
        )

    # -- vehicles

    def _on_heard(self, heartbeat: Heartbeat) -> None:
        self._members.hear(heartbeat, trio.current_time())

    async def _keep_members(self, nursery: trio.Nursery) -> None:
        """Start a mount for each heard vehicle without one."""
        while True:
            if self.state is State.MOUNTED:
                for member in self._members.due(trio.current_time()):
                    member.start()
                    nursery.start_soon(self._keep_mounted, member)
            await trio.sleep(PERIOD)

    async def _keep_mounted(self, member: Member) -> None:
        """Run a vehicle's mount until it ends."""
        place = self._place(member)
        try:
            await trio.to_thread.run_sync(places.make, self.request.mountpoint, member.name)
            # In a session of its own: Ctrl-C reaches only this process, which ends the mount in order.
            process = await trio.lowlevel.open_process(
                self._command(member),
                stdin=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                cwd="/",
                env=own_environment(),
                start_new_session=True,
            )
        except (OSError, MountFailed) as exc:
            reason = exc.strerror if isinstance(exc, OSError) else exc
            member.ended(1, f"its mount cannot be started: {reason}", trio.current_time())
            log.warning("vehicle %s: %s", member.name, member.problem)
            return
        self._processes[member.name] = process
        said: list[str] = []
        async with trio.open_nursery() as nursery:
            nursery.start_soon(_collect, process, said)
            while member.state is MemberState.STARTING and process.poll() is None:
                if await trio.to_thread.run_sync(_is_up, place):
                    member.mounted()
                    self._first.set()
                    log.info("vehicle %s is mounted on %s", member.name, place)
                await trio.sleep(PERIOD)
            code = await process.wait()
        del self._processes[member.name]
        member.ended(code, said[-1] if said else f"its mount ended with {code}", trio.current_time())
        if member.state is MemberState.FAILED:
            log.warning("the mount of vehicle %s ended: %s", member.name, member.problem)

    def _place(self, member: Member) -> str:
        return os.path.join(self.request.mountpoint, member.name)

    # -- the end

    def leave(self) -> None:
        """See Life.leave."""
        assert self._nursery is not None
        self._nursery.start_soon(partial(self.unmount, lazy=True))

    def hurry(self) -> None:
        """See Life.hurry: each vehicle's mount gets a signal of its own."""
        for process in self._processes.values():
            process.send_signal(signal.SIGTERM)

    async def unmount(self, *, lazy: bool) -> None:
        """See Life.unmount."""
        async with self._ending:
            if self.state is not State.MOUNTED:
                return
            self.enter(State.LEAVING)
            outcomes = await self._end_members(lazy=lazy)
            problems = "; ".join(filter(None, outcomes.values()))
            if problems:
                self.enter(State.MOUNTED)
                gone = ", ".join(name for name, problem in outcomes.items() if not problem)
                raise MountFailed(f"{problems}; unmounted: {gone}" if gone else problems)
        self._left.set()

    async def _end_members(self, *, lazy: bool) -> dict[str, str]:
        """Have all vehicles' mounts upload their changes and end, at the same time; return for each name the
        reason why it did not, or "". If lazy, all do."""
        outcomes = {member.name: "" for member in self._members if member.name in self._processes}
        async with trio.open_nursery() as nursery:
            for member in self._members:
                if member.name in outcomes:
                    nursery.start_soon(self._end_member, member, lazy, outcomes)
        return outcomes

    async def _end_member(self, member: Member, lazy: bool, outcomes: dict[str, str]) -> None:
        process, place = self._processes[member.name], self._place(member)
        request = {"command": "umount", "lazy": lazy}
        try:
            socket = control.find_socket(place)
            action = partial(control.ask, socket, request, timeout=END_PATIENCE)
            reply = await trio.to_thread.run_sync(action)
        except control.ControlError as exc:
            if not lazy and not isinstance(exc, control.NobodyThere):
                outcomes[member.name] = str(exc)
                return
            process.send_signal(signal.SIGTERM)  # the mount is still starting, or cannot unmount
        else:
            self.note_end(reply["exit_code"], reply["message"])
        await process.wait()

    def status(self) -> Mapping[str, Any]:
        """See Life.status."""
        members = [
            {"name": member.name, "state": member.state.value, "problem": member.problem or None}
            for member in self._members
        ]
        return {"members": members}


def _is_up(place: str) -> bool:
    """Return whether a vehicle is mounted there; a killed mount may still be at that place."""
    return is_ours(place) and not is_dead(place)


async def _collect(process: trio.Process, said: list[str]) -> None:
    """Keep a mount's last line, and pass all lines on."""
    assert process.stderr is not None
    rest = b""
    async for data in process.stderr:
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            text = line.decode(errors="replace")
            said[:] = [text.removeprefix("mavftpfs: ")]
            print(text, file=sys.stderr, flush=True)
