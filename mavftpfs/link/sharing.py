"""The link of every program: a port of its own, or one shared through the hub. Layer: link.

The first program holds the port's name and opens the port itself. If a second program calls, the first one
starts the hub. The hub calls, too; then the first program closes the port, and the hub opens it. From then on
each program's link leads to the hub. To its users this is a link that was lost and returned, as when the hub
is killed.
"""

from __future__ import annotations

import errno
import logging
import os
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import ExitStack, asynccontextmanager, contextmanager
from pathlib import Path

import trio

from mavftpfs.link import ports
from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.base import REOPENED, Link, LinkStats, Piece, Seat, background, plain_nursery
from mavftpfs.link.hublink import PROTOCOL, Facts, PortRequest, hear, join, tell
from mavftpfs.link.opening import open_link
from mavftpfs.link.uri import LinkKind, LinkSpec
from mavftpfs.shared.errors import LinkClosed

log = logging.getLogger("mavftpfs.link")

PATIENCE = 20.0
"""Seconds for the mavftpfs program that has the port to end, or to share it."""
GRACE = 0.2
"""Seconds for a killed program's port to become free: the kernel frees it with the port's name."""
HELLO_PATIENCE = 1.0
"""Seconds for a program that calls to send its request."""
START_PATIENCE, COMING = 25.0, 5.0
"""Seconds for the hub to start, and then to call."""
_TAKEN = (errno.EADDRINUSE, errno.EBUSY, errno.EAGAIN)
_NO_NUMBER = "port 0 is a different port each time, so it cannot be shared; name a port"
_OTHER_VERSION = "{}: process {} has this port, with another version of mavftpfs; end that first"
_FOREIGN = "{}: process {} of another user has this port; only that user and root may share it"
_UPGRADED = "mavftpfs was upgraded since this program started; restart it"
_PAUSE, _LONGEST_PAUSE = 0.02, 1.0
_SHARED = "%s is shared with another program from now on: a hub opens it, and all programs use the hub%s"
_LINE = {LinkKind.SERIAL: "; DTR of the line falls for a moment"}
_NAME = "mavftpfs: "
_PACKAGES = str(Path(__file__).parents[2])
"""This program's packages: the hub must run the same program, whatever its working directory."""


class SharedLink:
    """Implements link.base.Link by the port itself, or by the hub that has it. Made by `open_shared`."""

    def __init__(self, spec: LinkSpec, wanted: PortRequest) -> None:
        self.stats = LinkStats()
        self.seat: Seat | None = None
        self.is_stream = not spec.kind.is_udp
        self.is_serial = spec.kind is LinkKind.SERIAL
        self.description = spec.description
        self._spec = spec
        self._wanted = wanted
        self._name = ports.port_name(spec)
        self._inner: Link | None = None
        self._was_open = False
        self._news: list[Piece] = []
        self._changed = trio.lowlevel.ParkingLot()

    # -- opening, again and again

    async def run(self, task_status: trio.TaskStatus[None] = trio.TASK_STATUS_IGNORED) -> None:
        """Keep the link open until cancelled. This task counts as started once the link is open.

        Raises:
            LinkClosed: the link cannot be opened the first time.
        """
        lost_at, said = trio.current_time(), ""
        while True:
            try:
                sock = ports.call(self._name, self._spec)
                if sock is None:
                    sock = await self._hold_port(task_status)
                    lost_at, said = trio.current_time(), ""
                hub = await join(sock, self._spec, self._wanted, self.seat)
                async with background(hub.run, hub.aclose):
                    with self._used(hub, task_status):
                        await hub.wait_closed()
                lost_at, said = trio.current_time(), ""
                log.warning("the hub of %s is gone; opening the port again", self.description)
            except LinkClosed as exc:
                waited = trio.current_time() - lost_at
                if not _may_pass(exc, waited):
                    if not self._was_open:
                        raise
                    if str(exc) != said:
                        said = str(exc)
                        log.warning("%s; trying again", exc)
                await trio.sleep(min(max(waited / 4, _PAUSE), _LONGEST_PAUSE))

    async def _hold_port(self, task_status: trio.TaskStatus[None]) -> socket.socket:
        """Hold the port until a hub claims it. Return the hub's connection, with port and name closed.

        Raises:
            Busy: another program has just taken the name.
            LinkClosed: the port cannot be opened, or this program needs a hub and the hub does not start.
        """
        name = ports.take_name(self._name)
        if name is None:
            raise ports.Busy(f"{self.description}: another program is opening this port; try again")
        with name:
            async with open_link(self._spec, source_port=ports.source_port(self._spec)) as link:
                if self._wanted.needs_hub:
                    return await self._started_hub(name)
                with self._used(link, task_status):
                    hub = await self._hub_that_comes(name)
            log.info(_SHARED, self.description, _LINE.get(self._spec.kind, ""))
            return hub

    async def _hub_that_comes(self, name: socket.socket) -> socket.socket:
        """Return the connection of the hub that claims the port; start a hub when another program calls."""
        while True:
            caller, request = await _next_call(name)
            if _is_hub(caller, request):
                return caller
            with caller:
                if "join" not in request:
                    continue
                problem = _FOREIGN.format(self.description, os.getpid())
                if request.get("protocol") != PROTOCOL:
                    problem = _OTHER_VERSION.format(self.description, os.getpid())
                elif ports.is_ours(caller):
                    try:
                        return await self._started_hub(name)
                    except LinkClosed as exc:
                        problem = f"{self.description} cannot be shared: {exc}"
                        log.warning("%s", problem)
                tell(caller, {"refused": problem})

    async def _started_hub(self, name: socket.socket) -> socket.socket:
        """Start a hub, and return its connection. The hub answers programs that call meanwhile.

        Raises:
            LinkClosed: the hub did not start; the text gives the reason.
        """
        await start_hub(self._spec)
        with ExitStack() as others, trio.move_on_after(COMING):
            while True:
                caller, request = await _next_call(name)
                if _is_hub(caller, request):
                    return caller
                others.enter_context(caller)
                if "hub" in request and request.get("protocol") != PROTOCOL:
                    raise LinkClosed(_UPGRADED)
        raise LinkClosed("the hub ended at once")

    @contextmanager
    def _used(self, link: Link, task_status: trio.TaskStatus[None]) -> Iterator[None]:
        """Use a link that was opened, during the body. This program's seat stays."""
        link.stats = self.stats
        self.seat = link.seat or self.seat
        self._inner = link
        if self._was_open:
            self.stats.reopened += 1
            self._news.append(REOPENED)
        else:
            self._was_open = True
            self.description = link.description
            task_status.started()
        self._changed.unpark_all()
        try:
            yield
        finally:
            self._inner = None

    # -- link.base.Link

    @property
    def backlog(self) -> int:
        """Bytes accepted by `send` and not yet handed to the kernel."""
        return 0 if self._inner is None else self._inner.backlog

    async def receive(self) -> list[Piece]:
        """See link.base.Link."""
        await trio.lowlevel.checkpoint_if_cancelled()
        while True:
            inner = self._inner
            if inner is None:
                await self._changed.park()
            elif self._news:
                await trio.lowlevel.cancel_shielded_checkpoint()
                return [self._news.pop()]
            else:
                try:
                    return await inner.receive()
                except LinkClosed:
                    if self._inner is inner:
                        await self._changed.park()

    def send(self, frames: Sequence[bytes], to: NetAddress | None = None) -> None:
        """See link.base.Link."""
        if self._inner is None:
            self.stats.dropped_sends += len(frames)
        else:
            self._inner.send(frames, to)


def _may_pass(problem: LinkClosed, waited: float) -> bool:
    """Return whether a link that could not be opened for so many seconds may soon become free."""
    if isinstance(problem, ports.Busy):
        return waited < PATIENCE
    return waited < GRACE and getattr(problem.__cause__, "errno", None) in _TAKEN


async def _next_call(name: socket.socket) -> tuple[socket.socket, Facts]:
    """Return the next connection to the port's name, and its request."""
    caller = await ports.next_caller(name)
    try:
        caller.setblocking(False)
        return caller, await hear(caller, HELLO_PATIENCE) or {}
    except BaseException:
        caller.close()
        raise


def _is_hub(caller: socket.socket, request: Facts) -> bool:
    """Return whether the caller is a hub that may have the port: of this version, and of this user."""
    return (
        "hub" in request and request.get("protocol") == PROTOCOL and ports.peer_of(caller).uid == os.getuid()
    )


@asynccontextmanager
async def open_shared(spec: LinkSpec, wanted: PortRequest) -> AsyncIterator[Link]:
    """Open the link that a SOURCE names, alone or with other mavftpfs programs, for the length of the body.

    Raises:
        LinkClosed: it cannot be opened; the text is one line that says what to do.
    """
    if spec.kind is not LinkKind.SERIAL and spec.port == 0:  # other programs cannot find the port
        if wanted.needs_hub:
            raise LinkClosed(_NO_NUMBER)
        async with open_link(spec) as alone:
            yield alone
        return
    link, lasting = SharedLink(spec, wanted), trio.CancelScope()

    async def run(task_status: trio.TaskStatus[None]) -> None:
        with lasting:
            await link.run(task_status)

    async with plain_nursery() as nursery:
        await nursery.start(run)
        lasting.shield = True  # a cancelled command (Ctrl-C) still closes the vehicle's session
        try:
            yield link
        finally:
            lasting.cancel()


def own_environment() -> dict[str, str]:
    """Return the environment for another process of this very program, in any working directory."""
    path = os.pathsep.join(filter(None, (_PACKAGES, os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path}


async def start_hub(spec: LinkSpec) -> None:
    """Start a hub, which then calls this program, because it has the port. Return once the hub runs.

    Raises:
        LinkClosed: the hub does not start; the text gives the reason.
    """
    command = [sys.executable, "-m", "mavftpfs", "hub", "--serve", spec.description]
    problem = f"it is not ready within {START_PATIENCE:g} s"
    try:
        with trio.fail_after(START_PATIENCE):
            done = await trio.run_process(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                capture_stderr=True,
                cwd="/",
                env=own_environment(),
                check=False,
            )
    except (OSError, trio.TooSlowError) as exc:
        problem = exc.strerror or problem if isinstance(exc, OSError) else problem
        raise LinkClosed(f"the hub cannot be started: {problem}") from exc
    if done.returncode != 0:
        said = done.stderr.decode(errors="replace").splitlines()
        lines = [line.removeprefix(_NAME) for line in said if line.startswith(_NAME)]
        raise LinkClosed(lines[-1] if lines else "the hub did not start")
