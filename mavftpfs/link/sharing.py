"""A port that we open ourselves, or share with other programs of ours through a hub. Layer: link.

A program alone has the port itself, and its door open beside it. When a second program knocks, the first one
starts the hub, which inherits port and door, and becomes its first client. A client whose hub is gone opens
the port again, and starts another hub. The port goes from one process to the other as an open descriptor: no
datagram is lost, no serial line falls, and no third program takes it.
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
from functools import partial
from pathlib import Path

import trio

from mavftpfs.link.addresses import NetAddress
from mavftpfs.link.base import Link, LinkStats, Seat, background
from mavftpfs.link.hublink import HubLink, Refused, Wish, join
from mavftpfs.link.opening import open_link
from mavftpfs.link.rendezvous import Door, knock, only_one, open_door
from mavftpfs.link.samelink import port_name
from mavftpfs.link.uri import LinkKind, LinkSpec
from mavftpfs.shared.errors import LinkClosed

log = logging.getLogger("mavftpfs.link")

GRACE = 2.0
"""Seconds to wait for a port that is taken, because a hub may be just closing it."""
_TAKEN = (errno.EADDRINUSE, errno.EBUSY, errno.EAGAIN)
_NO_PLACE = (
    "no private directory for the hub's socket; set XDG_RUNTIME_DIR to a directory that only you can read"
)
_NO_NUMBER = "port 0 is another one each time, so it cannot be shared; name a port"
_PAUSE = 0.1
_LONG_PAUSE = 1.0
_START_PATIENCE = 60.0
_PACKAGES = str(Path(__file__).parents[2])
"""Where this program was imported from: the hub is to be the same program, whatever its working directory."""


class SharedLink:
    """Implements link.base.Link by the port itself, or by the hub that has it. Made by `open_shared`."""

    def __init__(self, spec: LinkSpec, wish: Wish) -> None:
        self.stats = LinkStats()
        self.seat: Seat | None = None
        self.is_stream = False
        self.is_serial = spec.kind is LinkKind.SERIAL
        self.description = spec.description
        self._spec = spec
        self._wish = wish
        self._inner: Link | None = None
        self._heard_by: Link | None = None
        self._address: NetAddress | None = None
        self._system = 0
        self._reopened = False
        self._opened = False
        self._changed = trio.Event()
        self._closed = False
        self._task_status: trio.TaskStatus[None] = trio.TASK_STATUS_IGNORED

    # -- what is open

    async def run(self, task_status: trio.TaskStatus[None] = trio.TASK_STATUS_IGNORED) -> None:
        """Keep the port open, one way or the other, until cancelled.

        Raises:
            LinkClosed: it cannot be opened at all.
        """
        self._task_status = task_status
        said = ""
        while True:
            try:
                hub = await self._obtained()
            except LinkClosed as exc:
                if not self._opened:
                    raise
                if str(exc) != said:
                    said = str(exc)
                    log.warning("%s; trying again", said)
                await trio.sleep(_LONG_PAUSE)
                continue
            said = ""
            async with background(hub.run, hub.aclose):
                self._use(hub)
                await hub.gone.wait()
            self._inner = None
            self._reopened = True
            log.warning("the hub of %s is gone; starting another one", self.description)

    async def _obtained(self) -> HubLink:
        """Return the link to the hub of the port. As long as no other program wants the port, we have it
        alone."""
        deadline = trio.current_time() + GRACE
        while True:
            try:
                hub = await self._joined()
                return hub or await self._alone()
            except _Taken as exc:
                if trio.current_time() > deadline:
                    raise LinkClosed(str(exc)) from exc.__cause__
                await trio.sleep(_PAUSE)

    async def _joined(self) -> HubLink | None:
        """Return a link to the program that has the port, if it is one of ours."""
        sock = knock(port_name(self._spec)) if self._has_name else None
        if sock is None:
            return None
        try:
            return await join(sock, self._spec, self._wish, self.seat, again=self._opened)
        except Refused:
            raise
        except LinkClosed as exc:
            raise _Taken(str(exc)) from exc  # it ended just now, or could not start the hub

    async def _alone(self) -> HubLink:
        """Have the port to ourselves until another program knocks, or hand it to a hub at once if we need
        one."""
        name = port_name(self._spec)
        async with AsyncExitStack() as stack:
            with await only_one(name):
                hub = await self._joined()
                if hub is not None:
                    return hub
                try:
                    link = await stack.enter_async_context(open_link(self._spec))
                except LinkClosed as exc:
                    if getattr(exc.__cause__, "errno", None) in _TAKEN:
                        raise _Taken(str(exc)) from exc.__cause__
                    raise
                door = open_door(name) if self._has_name else None
                if door is not None:
                    stack.callback(door.remove)
            if not self._needs_hub():
                self._use(link)
            while True:
                hub = await self._handed_over(link, door)
                if hub is not None:
                    return hub

    def _needs_hub(self) -> bool:
        return self._opened or bool(self._wish.forward) or self._wish.beats

    async def _handed_over(self, link: Link, door: Door | None) -> HubLink | None:
        """Wait until another program wants to share the port, and start the hub; None if that cannot be done.

        Raises:
            LinkClosed: we need it ourselves.
        """
        if door is None:
            if self._needs_hub() and self._inner is not link:
                raise LinkClosed(_NO_PLACE if self._has_name else _NO_NUMBER)
            await trio.sleep_forever()
        assert door is not None
        alone = self._inner is link
        if alone:
            await door.knocked()
        try:
            hub = await start_hub(link, door, self._spec, self._wish, self.seat)
        except LinkClosed as exc:
            if not alone:
                raise
            log.warning("cannot share %s: %s", self.description, exc)
            door.turn_away()
            return None
        door.leave()
        return hub

    @property
    def _has_name(self) -> bool:
        """Whether other programs can find the port. Port 0 is a different one for each."""
        return self.is_serial or self._spec.port != 0

    def _use(self, link: Link) -> None:
        """Go on with another link. What is known of the vehicle stays."""
        link.stats = self.stats
        self._inner = link
        self.seat = link.seat
        if not self._opened:
            self._opened = True
            self.is_stream = link.is_stream
            self.description = link.description
            self._task_status.started()
        if self._address is not None:
            link.answer(self._address)
        if self._system:
            link.focus(self._system)
        if self._reopened:
            self.stats.reopened += 1
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

    def keep_peer(self) -> None:
        """See link.base.Link."""
        if self._inner is not None:
            self._inner.keep_peer()

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


class _Taken(LinkClosed):
    """The port cannot be opened now; soon it may."""


@asynccontextmanager
async def open_shared(spec: LinkSpec, wish: Wish) -> AsyncIterator[Link]:
    """Open the link that a SOURCE names, alone or with other programs of ours, for the length of the body.

    Raises:
        LinkClosed: it cannot be opened; the text is one line that says what to do.
    """
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


async def start_hub(link: Link, door: Door, spec: LinkSpec, wish: Wish, seat: Seat | None) -> HubLink:
    """Start a hub that goes on with an open port, and return our link to it.

    Raises:
        LinkClosed: it did not start; we still have the port.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        inherited = [theirs.fileno(), door.sock.fileno(), *link.descriptors()]
        words = [sys.executable, "-m", "mavftpfs", "hub", "--take-over", ",".join(map(str, inherited))]
        command = partial(
            subprocess.run,
            [*words, spec.description],
            pass_fds=inherited,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            cwd="/",
            env=own_environment(),
            timeout=_START_PATIENCE,
            check=False,
        )
        try:
            done = await trio.to_thread.run_sync(command)
        except (OSError, subprocess.TimeoutExpired) as exc:
            ours.close()
            raise LinkClosed(f"the hub cannot be started: {exc}") from exc
    if done.returncode != 0:
        ours.close()
        raise LinkClosed(done.stderr.strip().removeprefix("mavftpfs: ") or "the hub did not start")
    return await join(ours, spec, wish, seat)
