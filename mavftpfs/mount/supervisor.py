"""A mount of all vehicles on a link: one ordinary mount for each, in a process of its own. Layer: mount.

This process has no vehicle. It hears heartbeats through the hub, shows the directory in which the mounts are
(`mount.root`), and starts, watches and ends their processes. If it is killed they go on.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any

import trio

import mavftpfs
from mavftpfs.client import control
from mavftpfs.client.connect import connect_options, opened, plain_nursery
from mavftpfs.client.control import ControlError, Reply
from mavftpfs.client.controlserver import ControlServer
from mavftpfs.client.mountpoint import is_ours, unmount, unmount_what_is_left
from mavftpfs.link.base import Link
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, MAV_TYPE_ONBOARD_CONTROLLER, Address, Heartbeat
from mavftpfs.link.sharing import own_environment
from mavftpfs.mount.daemon import Report
from mavftpfs.mount.kernel import MountRequest, fuse_loop, kernel_mount, presentation
from mavftpfs.mount.root import RootOperations
from mavftpfs.mount.roster import Member, Roster, State
from mavftpfs.session.connection import connected, signing_now
from mavftpfs.shared.errors import ExitCode, FtpNak, MavftpfsError, MountFailed, exit_code_for
from mavftpfs.shared.model import ROOT

log = logging.getLogger("mavftpfs.mount")

FIRST_PATIENCE = 5.0
"""Seconds in which the command that mounts waits for the first vehicle; others come later."""
PERIOD = 0.1
END_PATIENCE = 3600.0
"""Seconds for a vehicle's mount to deliver and end."""
_LAST_REPLIES = 3.0
_OWNER_ONLY = 0o077

Command = Callable[[Member], list[str]]
"""Returns the words that mount one vehicle below the mountpoint, in the foreground."""


def run_all(request: MountRequest, command: Command, report: Report) -> int:
    """Mount all vehicles and serve until unmounted; returns the exit code."""
    return trio.run(_Supervisor(request, command, report).run)


class _Supervisor:
    def __init__(self, request: MountRequest, command: Command, report: Report) -> None:
        # The root itself refuses writes; fusermount3 mounts only where the user may write.
        client = replace(request.options.client, read_only=False)
        options = replace(request.options, client=client)
        if os.geteuid() != 0 and not options.allow_other:
            # fusermount3 works as root, and the kernel lets root into a user's mount only so.
            options = replace(options, allow_other=True, dmask=_OWNER_ONLY)
        self._request = replace(request, options=options)
        self._command = command
        self._report = report
        self._roster = Roster()
        self._processes: dict[str, trio.Process] = {}
        self._code = ExitCode.OK
        self._message = ""
        self._started = time.time()
        self._first = trio.Event()
        self._mounted = False
        self._ending = False
        self._finished = trio.Event()
        self._control: ControlServer | None = None
        self._scope = trio.CancelScope()
        self._loop_scope = trio.CancelScope()

    async def run(self) -> int:
        """Serve until unmounted."""
        async with trio.open_nursery() as nursery:
            nursery.start_soon(self._watch_signals)
            try:
                with self._scope:
                    await self._serve(nursery)
            except MavftpfsError as exc:
                self._code = exit_code_for(exc)
                self._report(self._code, str(exc))
                log.error("%s", exc)
            self._finished.set()
            if self._control is not None:
                self._control.close()
                with trio.move_on_after(_LAST_REPLIES):
                    await self._control.closed.wait()
            nursery.cancel_scope.cancel()
        return self._code

    async def _serve(self, nursery: trio.Nursery) -> None:
        request = self._request
        operations = RootOperations(self._roster, presentation(request.options), self._look, self.status)
        async with opened(request.spec, request.options.client, beats=True) as link:
            with ExitStack() as stack:
                try:
                    stack.enter_context(kernel_mount(operations, request))
                except MountFailed as exc:
                    raise _explained(exc) from exc
                self._mounted = True
                await self._start_control(nursery)
                async with plain_nursery() as tasks:
                    tasks.start_soon(self._hear, link)
                    tasks.start_soon(self._keep_members, tasks)
                    tasks.start_soon(self._tell_when_up)
                    with self._loop_scope:
                        await fuse_loop()
                    await self._end_members()  # the root alone was unmounted, lazily

    async def _tell_when_up(self) -> None:
        with trio.move_on_after(FIRST_PATIENCE):
            await self._first.wait()
            self._report(0, "")
            return
        self._report(
            0, f"no vehicle is heard on {self._request.spec.description} yet; each appears as it comes"
        )

    # -- vehicles

    async def _hear(self, link: Link) -> None:
        """Note which vehicles are heard. Some bridges answer only a client that speaks, so we send
        heartbeats."""
        options = self._request.options.client
        own = Address(options.source_system, options.source_component) if link.seat is None else link.seat.own
        key = connect_options(options).signing_key
        framer = Framer(own, stream=False, signing_key=key, signing_clock=signing_now)
        framer.link_id = 0 if link.seat is None else link.seat.number

        async def beat() -> None:
            while options.heartbeat != "none":
                link.send_nowait(
                    [framer.encode_heartbeat(MAV_TYPE_ONBOARD_CONTROLLER, MAV_AUTOPILOT_INVALID)]
                )
                await trio.sleep(1)

        async with trio.open_nursery() as nursery:
            nursery.start_soon(beat)
            while True:
                for chunk in await link.receive():
                    for message in framer.feed(chunk):
                        if isinstance(message, Heartbeat):
                            self._roster.hear(message, trio.current_time())

    async def _look(self, system: int, component: int) -> bool:
        """Return whether a component of a system answers MAVLink FTP."""
        options = replace(
            self._request.options.client, target_system=system, target_component=component, forward=()
        )
        try:
            async with (
                opened(self._request.spec, options) as link,
                connected(link, connect_options(options)) as connection,
            ):
                await connection.ready(options.connect_timeout)
                await connection.store.list_directory(ROOT)
        except FtpNak:
            return True
        except MavftpfsError:
            return False
        return True

    async def _keep_members(self, nursery: trio.Nursery) -> None:
        """Start a mount for each vehicle that is heard and has none."""
        while True:
            for member in () if self._ending else self._roster.due(trio.current_time()):
                member.start()
                nursery.start_soon(self._keep_mounted, member)
            await trio.sleep(PERIOD)

    async def _keep_mounted(self, member: Member) -> None:
        """Run a vehicle's mount until it ends."""
        place = self._place(member)
        # In a session of its own: Ctrl-C reaches only us, and we end it in order.
        try:
            process = await trio.lowlevel.open_process(
                self._command(member),
                stdin=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                cwd="/",
                env=own_environment(),
                start_new_session=True,
            )
        except OSError as exc:
            member.ended(1, f"its mount cannot be started: {exc.strerror}", trio.current_time())
            log.warning("vehicle %s: %s", member.name, member.problem)
            return
        self._processes[member.name] = process
        said: list[str] = []
        async with trio.open_nursery() as nursery:
            nursery.start_soon(_collect, process, said)
            while member.state is State.STARTING and process.poll() is None:
                if await trio.to_thread.run_sync(is_ours, place):
                    member.mounted()
                    self._first.set()
                    log.info("vehicle %s is mounted on %s", member.name, place)
                await trio.sleep(PERIOD)
            code = await process.wait()
        del self._processes[member.name]
        member.ended(code, said[-1] if said else f"its mount ended with {code}", trio.current_time())
        if code != 0:
            log.warning("the mount of vehicle %s ended: %s", member.name, member.problem)
            await trio.to_thread.run_sync(_clear, place)

    def _place(self, member: Member) -> str:
        return os.path.join(self._request.mountpoint, member.name)

    # -- the end

    async def _end_members(self, *, lazy: bool = True) -> list[str]:
        """Make all mounts deliver and end, at the same time; return the words of those that do not."""
        self._ending = True
        problems: list[str] = []
        async with trio.open_nursery() as nursery:
            for member in self._roster:
                if member.name in self._processes:
                    nursery.start_soon(self._end_member, member, lazy, problems)
        return problems

    async def _end_member(self, member: Member, lazy: bool, problems: list[str]) -> None:
        process, place = self._processes[member.name], self._place(member)
        request = {"command": "umount", "lazy": lazy}
        try:
            socket = control.find_socket(place, control.own_directories())
            action = partial(control.ask, socket, request, timeout=END_PATIENCE)
            reply = await trio.to_thread.run_sync(action)
        except ControlError as exc:
            if not isinstance(exc, control.NobodyThere):
                problems.append(str(exc))
                return
            process.send_signal(signal.SIGTERM)  # it is still starting
        else:
            self._code = max(self._code, ExitCode(reply["exit_code"]))
            self._message = "; ".join(filter(None, (self._message, reply.get("message"))))
        await process.wait()

    async def _watch_signals(self) -> None:
        """On the first signal all deliver and end; on the second they end sooner."""
        with trio.open_signal_receiver(signal.SIGINT, signal.SIGTERM, signal.SIGHUP) as signals:
            async with trio.open_nursery() as nursery:
                async for number in signals:
                    log.info("signal %s", signal.Signals(number).name)
                    if not self._mounted:
                        self._code = ExitCode.INTERRUPTED
                        self._report(self._code, "interrupted")
                        self._scope.cancel()
                    elif self._ending:
                        for process in self._processes.values():
                            process.send_signal(signal.SIGTERM)
                    else:
                        nursery.start_soon(self._leave)

    async def _leave(self) -> None:
        await self._end_members()
        await trio.to_thread.run_sync(unmount_what_is_left, self._request.mountpoint)
        self._loop_scope.cancel()  # the kernel ends it only with its last user, which may be never

    # -- control

    async def _start_control(self, nursery: trio.Nursery) -> None:
        if self._request.control is None:
            return

        async def status(_: Reply) -> Reply:
            return {"status": self.status()}

        server = ControlServer(self._request.control, {"status": status, "umount": self._umount})
        try:
            await nursery.start(server.run)
        except OSError as exc:
            log.warning("no control socket, so no `mavftpfs status`: %s", exc)
        else:
            self._control = server

    async def _umount(self, request: Reply) -> Reply:
        lazy = bool(request.get("lazy"))
        problems = await self._end_members(lazy=lazy)
        try:
            if problems:
                raise MountFailed("; ".join(problems))
            await trio.to_thread.run_sync(partial(unmount, self._request.mountpoint, lazy=lazy))
        except MountFailed:
            self._ending = False  # something is in use: what is still mounted goes on
            raise
        if lazy:
            self._loop_scope.cancel()  # as in _leave
        await self._finished.wait()
        return {"exit_code": int(self._code), "pid": os.getpid(), "message": self._message}

    def status(self) -> dict[str, Any]:
        """Return facts for people and scripts; JSON-able."""
        return {
            "mountpoint": self._request.mountpoint,
            "state": "unmounting" if self._ending else "mounted",
            "problem": None,
            "source": self._request.source,
            "pid": os.getpid(),
            "version": mavftpfs.__version__,
            "uptime": round(time.time() - self._started, 1),
            "members": [
                {"name": member.name, "state": member.state.value, "problem": member.problem or None}
                for member in self._roster
            ],
        }


def _explained(error: MountFailed) -> MountFailed:
    if "user_allow_other" not in str(error):
        return error
    return MountFailed(
        "to mount below a mount of yours, fusermount3 needs the line user_allow_other in /etc/fuse.conf: "
        "echo user_allow_other | sudo tee -a /etc/fuse.conf; or mount each vehicle by -o target_system="
    )


async def _collect(process: trio.Process, said: list[str]) -> None:
    """Keep the last line that a mount said, and pass all on."""
    assert process.stderr is not None
    rest = b""
    async for data in process.stderr:
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            text = line.decode(errors="replace")
            said[:] = [text.removeprefix("mavftpfs: ")]
            print(text, file=sys.stderr, flush=True)


def _clear(place: str) -> None:
    """Take away what a killed mount left."""
    try:
        unmount_what_is_left(place)
    except MountFailed:
        log.debug("nothing is mounted on %s", place)
