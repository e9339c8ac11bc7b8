"""A port that we open ourselves, or share with other programs of ours through a hub. Layer: link.

`SharedLink.run` is in one of three states:

| state | what happens | then |
|---|---|---|
| SEEKING: we have no port | a program of ours has it: we join its hub | JOINED |
| | no program of ours has it, and it opens: we make a door beside it | ALONE |
| | neither | SEEKING; at the first start an error, after 2 s if it may pass |
| ALONE: we have the port | another program knocks, or we need a hub: we start one, and join it | JOINED |
| | the hub does not start | ALONE, and the others are told why; SEEKING if we need it |
| JOINED: a hub has the port | the hub is gone | SEEKING |

The port goes from one process to the other as an open descriptor, and so does the door: no datagram is lost,
no serial line falls, and no third program takes the port.
"""

from __future__ import annotations

import errno
import logging
import os
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import trio

from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.base import Link, LinkStats, Seat, background
from mavftpfs.link.hublink import HubLink, Wish, join, pack_facts
from mavftpfs.link.opening import open_link
from mavftpfs.link.rendezvous import Busy, Door, knock, only_one, open_door
from mavftpfs.link.samelink import port_name
from mavftpfs.link.uri import LinkKind, LinkSpec
from mavftpfs.shared.errors import LinkClosed

log = logging.getLogger("mavftpfs.link")

GRACE = 2.0
"""Seconds to wait for a port that is taken, because a hub may be just closing it."""
_TAKEN = (errno.EADDRINUSE, errno.EBUSY, errno.EAGAIN)
_NO_NUMBER = "port 0 is another one each time, so it cannot be shared; name a port"
_PAUSE = 0.1
_LONG_PAUSE = 1.0
_START_PATIENCE = 60.0
_NAME = "mavftpfs: "
_PACKAGES = str(Path(__file__).parents[2])
"""Where this program was imported from: the hub is to be the same program, whatever its working directory."""


class SharedLink:
    """Implements link.base.Link by the port itself, or by the hub that has it. Made by `open_shared`."""

    def __init__(self, spec: LinkSpec, wish: Wish) -> None:
        self.stats = LinkStats()
        self.seat: Seat | None = None
        self.is_stream = not spec.kind.is_udp
        self.is_serial = spec.kind is LinkKind.SERIAL
        self.description = spec.description
        self._spec = spec
        self._wish = wish
        self._name = port_name(spec)
        self._inner: Link | None = None
        self._heard_by: Link | None = None
        self._address: NetAddress | None = None
        self._system = 0
        self._was_open = False
        self._reopened = False
        self._changed = trio.Event()
        self._closed = False
        self._task_status: trio.TaskStatus[None] = trio.TASK_STATUS_IGNORED

    # -- the states

    async def run(self, task_status: trio.TaskStatus[None] = trio.TASK_STATUS_IGNORED) -> None:
        """Keep the port open, one way or the other, until cancelled. It has started once the port is open.

        Raises:
            LinkClosed: it cannot be opened at all.
        """
        self._task_status = task_status
        try:
            while True:
                hub = await self._sought()
                async with background(hub.run_writer, hub.aclose):
                    await hub.gone.wait()
                self._inner = None
                self._reopened = True
                self.stats.reopened += 1
                log.warning("the hub of %s is gone; opening the port again", self.description)
        finally:
            if self._inner is not None:
                with trio.CancelScope(shield=True):
                    await self._inner.aclose()

    async def _sought(self) -> HubLink:
        """SEEKING, and ALONE as long as that lasts. Return our link when a hub has the port."""
        began, pause, said = trio.current_time(), _PAUSE, ""
        while True:
            try:
                return await self._joined()
            except LinkClosed as exc:
                may_pass = isinstance(exc, Busy) and trio.current_time() - began < GRACE
                if not may_pass and not self._was_open:
                    raise
                if not may_pass and str(exc) != said:
                    said = str(exc)
                    log.warning("%s; trying again", said)
            await trio.sleep(pause)
            pause = min(2 * pause, _LONG_PAUSE)

    async def _joined(self) -> HubLink:
        """Join the hub of the port. If there is none, have the port until a hub takes it over.

        Raises:
            Busy: another program has the port, and may be just opening or closing it.
            LinkClosed: it cannot be opened, or the hub refuses us, or does not start and we need it.
        """
        async with AsyncExitStack() as stack:
            async with only_one(self._name):
                sock = knock(self._name)
                if sock is None:
                    link = await self._opened_port(stack)
                    door = self._opened_door(stack)
            if sock is not None:
                hub = await join(sock, self._spec, self._wish, self.seat, again=self._was_open)
                self._use(hub)
                return hub
            if door is None:
                self._use(link)
                await trio.sleep_forever()
            if self._wish.needs_hub:
                return await self._handed_over(link, door)
            return await self._alone(link, door)

    async def _opened_port(self, stack: AsyncExitStack) -> Link:
        try:
            return await stack.enter_async_context(open_link(self._spec))
        except LinkClosed as exc:
            if getattr(exc.__cause__, "errno", None) in _TAKEN:
                raise Busy(str(exc)) from exc.__cause__
            raise

    def _opened_door(self, stack: AsyncExitStack) -> Door | None:
        """Return the door of our port. A program that does not need a hub goes on without one."""
        try:
            door = open_door(self._name)
        except LinkClosed as exc:
            if self._wish.needs_hub:
                raise
            log.info("%s cannot be shared: %s", self.description, exc)
            return None
        stack.callback(door.remove)
        return door

    async def _alone(self, link: Link, door: Door) -> HubLink:
        """ALONE: use the port until another program wants it too, and a hub has taken it over."""
        self._use(link)
        while True:
            await door.knocked()
            try:
                return await self._handed_over(link, door)
            except LinkClosed as exc:
                problem = f"{self.description} cannot be shared: {exc}"
            log.warning("%s", problem)
            door.turn_away(pack_facts({"refused": problem}))
            await trio.sleep(_LONG_PAUSE)

    async def _handed_over(self, link: Link, door: Door) -> HubLink:
        """Start a hub that takes over port and door, and use it.

        Raises:
            LinkClosed: it does not start; both are still ours.
        """
        hub = await start_hub(link, door, self._spec, self._wish, self.seat, again=self._was_open)
        self._use(hub)  # before ours is closed: what is sent meanwhile is not lost
        door.leave()
        return hub

    def _use(self, link: Link) -> None:
        """Go on with another link. What is known of the vehicle stays, and so does our seat."""
        link.stats = self.stats
        self.seat = link.seat or self.seat
        if self._address is not None:
            link.answer(self._address)
        if self._system:
            link.focus(self._system)
        self._inner = link
        if not self._was_open:
            self._was_open = True
            self.description = link.description
            self._task_status.started()
        self._changed.set()
        self._changed = trio.Event()

    # -- link.base.Link

    @property
    def backlog(self) -> int:
        """Bytes accepted by send_nowait and not yet handed to the kernel."""
        return 0 if self._inner is None else self._inner.backlog

    async def receive(self) -> list[bytes]:
        """See link.base.Link."""
        await trio.lowlevel.checkpoint_if_cancelled()
        while not self._closed:
            inner = self._inner
            if inner is None:
                await self._changed.wait()
                continue
            if self._reopened:
                self._reopened = False
                await trio.lowlevel.cancel_shielded_checkpoint()
                return []
            try:
                pieces = await inner.receive()
            except LinkClosed:
                if self._inner is inner:
                    await self._changed.wait()
            else:
                self._heard_by = inner
                return pieces
        raise LinkClosed(f"{self.description} is closed")

    def send_nowait(self, frames: Sequence[bytes]) -> None:
        """See link.base.Link."""
        if self._inner is None:
            self.stats.dropped_sends += len(frames)
        else:
            self._inner.send_nowait(frames)

    def sender(self, index: int) -> NetAddress | None:
        """Return the sender of a piece of the list that `receive` returned last."""
        return None if self._heard_by is None else self._heard_by.sender(index)

    def answer(self, address: NetAddress) -> None:
        """From now on send to this address."""
        self._address = address
        if self._inner is not None:
            self._inner.answer(address)

    def focus(self, system: int) -> None:
        """From now on only what concerns one system matters."""
        if system != self._system:
            self._system = system
            if self._inner is not None:
                self._inner.focus(system)

    def descriptors(self) -> list[int]:
        """See link.base.Link."""
        return [] if self._inner is None else self._inner.descriptors()

    async def aclose(self) -> None:
        """No more is sent or received; `run` closes what is open when it is cancelled."""
        self._closed = True
        self._changed.set()
        await trio.lowlevel.checkpoint()


@asynccontextmanager
async def open_shared(spec: LinkSpec, wish: Wish) -> AsyncIterator[Link]:
    """Open the link that a SOURCE names, alone or with other programs of ours, for the length of the body.

    Raises:
        LinkClosed: it cannot be opened; the text is one line that says what to do.
    """
    if spec.kind is not LinkKind.SERIAL and spec.port == 0:  # no other program can find it
        if wish.needs_hub:
            raise LinkClosed(_NO_NUMBER)
        async with open_link(spec) as alone:
            yield alone
        return
    link = SharedLink(spec, wish)
    failure: Exception | None = None
    lasting = trio.CancelScope()

    async def run(task_status: trio.TaskStatus[None]) -> None:
        with lasting:
            await link.run(task_status)

    async with trio.open_nursery() as nursery:
        try:
            await nursery.start(run)
            lasting.shield = True  # a command that is cancelled (Ctrl-C) still closes the vehicle's session
            yield link
        except Exception as exc:  # raised again outside, so that it is not wrapped in a group
            failure = exc
        finally:
            with trio.CancelScope(shield=True):
                await link.aclose()
            lasting.cancel()
    if failure is not None:
        raise failure


def own_environment() -> dict[str, str]:
    """Return the environment of another process of this very program, wherever it works."""
    path = os.pathsep.join(filter(None, (_PACKAGES, os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path}


async def start_hub(
    link: Link, door: Door, spec: LinkSpec, wish: Wish, seat: Seat | None, *, again: bool = False
) -> HubLink:
    """Start a hub that goes on with an open port and its door, and return our link to it. again: as for join.

    Raises:
        LinkClosed: it did not start; we still have the port.
    """
    try:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    except OSError as exc:
        raise LinkClosed(f"the hub cannot be started: {exc.strerror}") from exc
    with theirs:
        inherited = [theirs.fileno(), door.sock.fileno(), *link.descriptors()]
        words = ["-m", "mavftpfs", "hub", "--take-over", ",".join(map(str, inherited)), spec.description]
        try:
            await _run_until_ready([sys.executable, *words], inherited)
        except BaseException:
            ours.close()
            raise
    return await join(ours, spec, wish, seat, again=again)


async def _run_until_ready(command: list[str], inherited: list[int]) -> None:
    """Run the command that starts a hub; it ends when the hub is ready.

    Raises:
        LinkClosed: and why it is not.
    """
    try:
        with trio.fail_after(_START_PATIENCE):
            done = await trio.run_process(
                command,
                pass_fds=inherited,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                capture_stderr=True,
                cwd="/",
                env=own_environment(),
                check=False,
            )
    except (OSError, trio.TooSlowError) as exc:
        problem = (
            exc.strerror if isinstance(exc, OSError) else f"it is not ready within {_START_PATIENCE:g} s"
        )
        raise LinkClosed(f"the hub cannot be started: {problem}") from exc
    if done.returncode != 0:
        said = done.stderr.decode(errors="replace").splitlines()
        lines = [line.removeprefix(_NAME) for line in said if line.startswith(_NAME)]
        raise LinkClosed(lines[-1] if lines else "the hub did not start")
