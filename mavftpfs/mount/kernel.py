"""The kernel mount: composition root, and a mount's life from first heartbeat to unmount. Layer: mount.

Order matters. The vehicle must have answered before the kernel mount appears. At the end the kernel mount
goes first, and then the server's session is closed, each within a time limit. While mounted, nothing in the
event loop may make a system call on the mountpoint: it would wait for itself.
"""

from __future__ import annotations

import errno
import gc
import logging
import math
import os
import select
import signal
import stat
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pyfuse3
import trio

import mavftpfs
from mavftpfs.client.connect import NO_SINKS, Attached, Sinks, attached
from mavftpfs.client.control import Reply
from mavftpfs.client.controlserver import ControlServer
from mavftpfs.client.mountpoint import CannotStart, is_ours, stderr_of, unmount, unmount_what_is_left
from mavftpfs.client.status import network_namespace
from mavftpfs.link.uri import LinkSpec
from mavftpfs.mount.daemon import Report
from mavftpfs.mount.farewell import say_goodbye
from mavftpfs.mount.handles import InodeTable, Presentation
from mavftpfs.mount.operations import Operations
from mavftpfs.mount.options import MountOptions, fuse_words
from mavftpfs.shared.errors import ExitCode, MavftpfsError, MountFailed, exit_code_for
from mavftpfs.shared.model import split

log = logging.getLogger("mavftpfs.mount")

MIN_TASKS = 10
MAX_TASKS = 2000
"""Requests under way at once. With pyfuse3's default of 99, 120 blocked opens freeze even `df`."""

MAX_DROPS = 16
"""Files of which the kernel is told at once to drop its pages; each takes a thread."""

GRACE = 2.0
"""Seconds that requests under way get to finish after a signal, or once the kernel mount is gone."""

FORGETTING_TIME = 2.0
"""Seconds for the kernel to forget what it cached, for a command that waits for that."""

LAST_REPLIES = 3.0
"""Seconds to hand waiting control clients their reply at the end."""


@dataclass(frozen=True, slots=True)
class MountRequest:
    """What to mount where. mountpoint: absolute; control: the control socket's path, None = without."""

    source: str
    spec: LinkSpec
    mountpoint: str
    options: MountOptions
    control: Path | None = None
    sinks: Sinks = NO_SINKS


Attach = Callable[[Callable[[bytes], None]], AbstractAsyncContextManager[Attached]]
"""Connects to the vehicle. Its argument is called for paths whose bytes changed."""


def run_mount(request: MountRequest, report: Report) -> int:
    """Mount and serve until unmounted; returns the exit code."""

    def attach(invalidate: Callable[[bytes], None]) -> AbstractAsyncContextManager[Attached]:
        return attached(
            request.spec,
            request.options.client,
            invalidate=invalidate,
            sinks=request.sinks,
            writing=True,
            rescue_for=request.source,
        )

    return trio.run(serve_mount, request, attach, report)


async def serve_mount(request: MountRequest, attach: Attach, report: Report) -> int:
    """Bring the vehicle up, mount it, serve until unmounted; returns the exit code."""
    life = _Life(request, report)
    async with trio.open_nursery() as nursery:
        await nursery.start(life.watch_signals)
        try:
            with life.scope:
                await life.attach_and_serve(attach, nursery)
        except MavftpfsError as exc:
            life.fail(exc)
        if life.scope.cancelled_caught and not life.mounted:
            life.code = ExitCode.INTERRUPTED
            report(life.code, "interrupted")
        life.finished.set()
        if life.control is not None:
            life.control.close()
            with trio.move_on_after(LAST_REPLIES):
                await life.control.closed.wait()
        nursery.cancel_scope.cancel()
    return life.code


class Invalidator:
    """Tells the kernel that what it cached is old, by its calls `notify(ino, attr_only)` and
    `notify_name(parent ino, name)`.

    These run in a worker thread. In them the kernel waits for pages that are being read and for names that
    are being looked up, and the event loop has to answer those.
    """

    def __init__(
        self,
        inodes: InodeTable,
        notify: Callable[[int, bool], None],
        notify_name: Callable[[int, bytes], None] = lambda parent, name: None,
    ) -> None:
        self._inodes = inodes
        self._notify = notify
        self._notify_name = notify_name
        self._pending: set[int] = set()
        self._wake = trio.Event()
        self._calls: set[object] = set()
        self._drops = trio.CapacityLimiter(MAX_DROPS)
        # Without a limit: a call that queued and was cancelled would count as running.
        self._limiter = trio.CapacityLimiter(math.inf)

    @property
    def busy(self) -> bool:
        """Whether a thread is inside the kernel's call at this moment."""
        return bool(self._calls)

    def on_changed(self, path: bytes) -> None:
        """Make the kernel drop its pages and attributes of a path, because its bytes changed."""
        ino = self._inodes.known(path)
        if ino is not None:
            self._pending.add(ino)
            self._wake.set()

    async def run(self) -> None:
        """Work until cancelled."""
        async with trio.open_nursery() as nursery:
            while True:
                await self._wake.wait()
                self._wake = trio.Event()
                pending, self._pending = self._pending, set()
                for ino in pending:
                    nursery.start_soon(self._drop, ino)

    async def _drop(self, ino: int) -> None:
        """Make the kernel drop a file's pages and attributes. Other files do not wait for it, since one of
        its pages may be read from a lost vehicle just now."""
        async with self._drops:
            await self._tell(ino, attr_only=False)

    async def forget_attributes(self, ino: int) -> None:
        """Make the kernel ask for attributes again; return when it has forgotten them."""
        await self._tell(ino, attr_only=True)

    async def forget_name(self, path: bytes) -> None:
        """Make the kernel look a name up again; return when it has forgotten it."""
        directory, name = split(path)
        parent = self._inodes.known(directory)
        if parent is not None:
            await self._in_thread([partial(self._notify_name, parent, name)])

    async def forget_beliefs(self) -> None:
        """Make the kernel ask again for all that it would answer by itself; return when it has forgotten
        it."""
        inodes, absent = self._inodes.believed(trio.current_time())
        calls = [partial(self._notify, ino, True) for ino in inodes]
        await self._in_thread(calls + [partial(self._notify_name, *name) for name in absent])

    async def _tell(self, ino: int, *, attr_only: bool) -> None:
        await self._in_thread([partial(self._notify, ino, attr_only)])

    async def _in_thread(self, calls: Sequence[Callable[[], None]]) -> None:
        await trio.lowlevel.checkpoint_if_cancelled()
        running = object()
        self._calls.add(running)
        action = partial(self._call, running, calls)
        await trio.to_thread.run_sync(action, abandon_on_cancel=True, limiter=self._limiter)

    def _call(self, running: object, calls: Sequence[Callable[[], None]]) -> None:
        try:
            for call in calls:
                try:
                    call()
                except OSError as exc:
                    if exc.errno != errno.ENOENT:  # the kernel forgot it by itself
                        log.warning("the kernel refused to drop what it cached: %s", exc)
        finally:
            self._calls.discard(running)


class _Life:
    """One mount from start to end."""

    def __init__(self, request: MountRequest, report: Report) -> None:
        self.request = request
        self.report = report
        self.code = ExitCode.OK
        self.scope = trio.CancelScope()
        self.mounted = False
        self.finished = trio.Event()
        self.farewell = ""
        self.control: ControlServer | None = None
        self._loop_scope: trio.CancelScope | None = None
        self._stop_asked = False
        self._let_go = False
        self._started = time.time()

    def fail(self, error: MavftpfsError) -> None:
        """The vehicle failed: tell the command that waits for the mount, or else the log."""
        self.code = exit_code_for(error)
        if self.mounted:
            log.error("unmounted: %s", error)
        else:
            self.report(self.code, str(error))

    async def attach_and_serve(self, attach: Attach, nursery: trio.Nursery) -> None:
        """Run until the kernel mount is gone, and everything that programs wrote is delivered or kept.

        A second signal ends the delivery, not the keeping.
        """
        inodes = InodeTable()
        invalidator = Invalidator(inodes, pyfuse3.invalidate_inode, pyfuse3.invalidate_entry)
        async with attach(invalidator.on_changed) as vehicle:
            nursery.start_soon(vehicle.watcher.run)
            operations = Operations(
                vehicle.tree,
                presentation(self.request.options),
                inodes=inodes,
                refresh=invalidator.forget_attributes,
                space=vehicle.space,
                status=lambda: self.status(vehicle, operations),
            )
            try:
                with kernel_mount(operations, self.request, busy=lambda: invalidator.busy):
                    self.mounted = True
                    await self._start_control(vehicle, operations, invalidator, nursery)
                    await self._serve(invalidator, vehicle.notice)
            finally:
                await say_goodbye(vehicle.tree, self.request.source, self._on_undelivered)
            await vehicle.tree.keep_whole_files()

    def _on_undelivered(self, line: str) -> None:
        self.farewell = line
        self.code = ExitCode.UNDELIVERED

    async def _serve(self, invalidator: Invalidator, notice: Callable[[], str]) -> None:
        async with trio.open_nursery() as nursery:
            nursery.start_soon(invalidator.run)
            gc.collect()
            gc.freeze()  # else a full collection would go through all imported modules during a transfer
            # Move old files only now. If mounting failed afterwards, nobody would hear where they are.
            self.report(0, notice())
            with trio.CancelScope() as self._loop_scope:
                if not self._stop_asked:
                    await fuse_loop(self._bound_the_loop)
            self._loop_scope = None
            self._let_go = True
            nursery.cancel_scope.cancel()

    # -- control ----------------------------------------------------------------------------------

    async def _start_control(
        self, vehicle: Attached, operations: Operations, invalidator: Invalidator, nursery: trio.Nursery
    ) -> None:
        if self.request.control is None:
            return

        async def status(_: Reply) -> Reply:
            return {"status": self.status(vehicle, operations)}

        async def forget(_: Reply) -> Reply:
            vehicle.tree.forget_caches()
            # The kernel waits for lookups that are under way, and these wait for the vehicle.
            with trio.move_on_after(FORGETTING_TIME):
                await invalidator.forget_beliefs()
            return {}

        async def withdraw(request: Reply) -> Reply:
            path = os.fsencode(request["path"])
            there = await vehicle.tree.withdraw(path)
            if there is False:
                operations.inodes.unlink(path)  # a reader keeps the withdrawn file, under a number of its own
            with trio.move_on_after(FORGETTING_TIME):
                await invalidator.forget_name(path)
            return {"there": there}

        commands = {"status": status, "umount": self._umount, "forget": forget, "withdraw": withdraw}
        server = ControlServer(self.request.control, commands)
        try:
            await nursery.start(server.run)
        except OSError as exc:
            log.warning("no control socket, so no `mavftpfs status`: %s", exc)
        else:
            self.control = server

    async def _umount(self, request: Reply) -> Reply:
        lazy = bool(request.get("lazy"))
        action = partial(unmount, self.request.mountpoint, lazy=lazy)
        if not self._let_go:
            try:
                await trio.to_thread.run_sync(action, abandon_on_cancel=True)
            except CannotStart:
                raise
            except MountFailed:
                if await trio.to_thread.run_sync(is_ours, self.request.mountpoint):
                    raise
                # It was unmounted meanwhile: wait for the end, too.
        if lazy:
            self._stop_gently()  # the kernel ends it only with its last user, which may be never
        await self.finished.wait()
        return {"exit_code": int(self.code), "pid": os.getpid(), "message": self.farewell}

    def status(self, vehicle: Attached, operations: Operations) -> dict[str, Any]:
        """Return facts for people and scripts; JSON-able."""
        return {
            "mountpoint": self.request.mountpoint,
            "state": "unmounting" if self._let_go else "mounted",
            "problem": None,
            "source": self.request.source,
            "root": os.fsdecode(self.request.options.client.root),
            "network_namespace": network_namespace(),
            "pid": os.getpid(),
            "version": mavftpfs.__version__,
            "read_only": self.request.options.client.read_only,
            "uptime": round(time.time() - self._started, 1),
            **vehicle.status(),
            "kernel": operations.counts(),
        }

    # -- signals ----------------------------------------------------------------------------------

    async def watch_signals(self, task_status: trio.TaskStatus[None] = trio.TASK_STATUS_IGNORED) -> None:
        """Unmount on the first signal; stop waiting on the second, or once the mount is gone."""
        with trio.open_signal_receiver(signal.SIGINT, signal.SIGTERM, signal.SIGHUP) as signals:
            task_status.started()
            async for number in signals:
                log.info("signal %s", signal.Signals(number).name)
                if self._stop_asked or self._let_go or not self.mounted:
                    self.scope.cancel()
                else:
                    self._stop_gently()

    def _stop_gently(self) -> None:
        self._stop_asked = True
        if self._loop_scope is not None:
            pyfuse3.terminate()
            self._bound_the_loop()

    def _bound_the_loop(self) -> None:
        """No program gets an answer now, and a read may wait for a lost vehicle as long as op_deadline."""
        assert self._loop_scope is not None
        self._loop_scope.deadline = min(self._loop_scope.deadline, trio.current_time() + GRACE)


async def fuse_loop(on_gone: Callable[[], None] = lambda: None) -> None:
    """Serve the kernel until the mount is gone, from inside or outside, and every request has ended.

    on_gone: called, more than once, when it is gone; requests may be under way.
    """
    try:
        with never_blocking(on_gone):
            await pyfuse3.main(min_tasks=MIN_TASKS, max_tasks=MAX_TASKS)
    except* OSError as group:
        # Reading from /dev/fuse fails when the connection was aborted (`umount -f`, fusectl).
        log.warning("the kernel ended the mount: %s", group.exceptions[0])


@contextmanager
def kernel_mount(
    operations: pyfuse3.Operations, request: MountRequest, *, busy: Callable[[], bool] = lambda: False
) -> Iterator[None]:
    """Have the kernel show `operations` at the mountpoint for the length of the body.

    busy: returns whether a thread is inside a call of the library.

    Raises:
        MountFailed: with what libfuse or fusermount3 said.
    """
    words = fuse_words(request.options, request.source)
    with stderr_of() as said:
        try:
            with watcher_told_last():
                pyfuse3.init(operations, request.mountpoint, words)
        except RuntimeError as exc:
            reason = said() or str(exc)
            raise MountFailed(f"cannot mount on {request.mountpoint}: {reason}") from exc
    try:
        yield
    finally:
        if busy():
            # Freeing the library's session would pull it away from that thread.
            unmount_what_is_left(request.mountpoint)
        else:
            pyfuse3.close(unmount=True)


@contextmanager
def watcher_told_last() -> Iterator[None]:
    """Mount in the body. With auto_unmount, make sure that the kernel notices our end before fusermount3
    does.

    It waits for the end of a socket that libfuse opens for it, and never uses again. If the kernel has not
    given the mount up by then, fusermount3 takes the mount for a living one and leaves it. When a process is
    killed, Linux releases the descriptors that only it has from the highest number to the lowest, and the
    socket's number is above that of /dev/fuse. So it gets a lower one.
    """
    lowest, before = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC), _sockets()
    try:
        yield
        opened = _sockets() - before
    except BaseException:
        os.close(lowest)
        raise
    if len(opened) == 1:
        (socket,) = opened
        os.dup2(socket, lowest, inheritable=False)
        os.close(socket)
    else:
        os.close(lowest)


def _sockets() -> set[int]:
    """Return this process's descriptors that are sockets."""
    found = set()
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # that of the directory itself is closed by now
            if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                found.add(int(name))
    return found


def presentation(options: MountOptions) -> Presentation:
    """Return how entries look for these options, with this process's user and umask for what is not given."""
    umask = os.umask(0o022)
    os.umask(umask)
    return Presentation(
        uid=os.getuid() if options.uid is None else options.uid,
        gid=os.getgid() if options.gid is None else options.gid,
        file_mode=options.file_mode(umask),
        directory_mode=options.directory_mode(umask),
        op_deadline=options.client.op_deadline,
    )


# -- reading /dev/fuse without blocking -------------------------------------------------------------


@contextmanager
def never_blocking(on_gone: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Have pyfuse3.main read /dev/fuse without blocking for the length of the body.

    It waits until there is a request, and then reads it with a call that blocks, in the event loop's thread.
    In between the request may be gone: the kernel takes it back when its caller is killed. Then everything
    would stand still, the link included, until the next request. So the descriptor is made non-blocking, it
    is checked once more right before each read, and a worker that found nothing starts again. (It loses its
    buffer then: 1 MiB of addresses, of which little was touched.)

    The seam is the one that pyfuse3's own asyncio support uses: what it takes for the module `trio`.
    """
    setattr(pyfuse3, "trio", _Trio(on_gone))  # noqa: B010 (which its types do not tell)
    try:
        yield
    finally:
        setattr(pyfuse3, "trio", trio)  # noqa: B010


class _Delegate:
    """Has the attributes of a module, except those that a subclass defines."""

    def __init__(self, module: object) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


class _LowLevel(_Delegate):
    def __init__(self, on_gone: Callable[[], None]) -> None:
        super().__init__(trio.lowlevel)
        self._on_gone = on_gone

    async def wait_readable(self, fd: int) -> None:
        """Wait until a read finds something, as far as that can be known."""
        os.set_blocking(fd, False)
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        await trio.lowlevel.wait_readable(fd)
        while not (found := poll.poll(0)):
            await trio.lowlevel.wait_readable(fd)
        if any(events & select.POLLERR for _, events in found):  # Linux: the mount has no kernel any more
            self._on_gone()


class _Trio(_Delegate):
    def __init__(self, on_gone: Callable[[], None]) -> None:
        super().__init__(trio)
        self.lowlevel = _LowLevel(on_gone)

    @asynccontextmanager
    async def open_nursery(self) -> AsyncIterator[_Workers]:
        """Open the nursery of pyfuse3's workers."""
        async with trio.open_nursery() as nursery:
            yield _Workers(nursery)


class _Workers:
    """Starts workers that outlive a read which found nothing."""

    def __init__(self, nursery: trio.Nursery) -> None:
        self._nursery = nursery

    def start_soon(self, worker: Callable[..., Awaitable[None]], *args: object, name: object = None) -> None:
        """As trio.Nursery's."""
        self._nursery.start_soon(_work, worker, args, name=name)


async def _work(worker: Callable[..., Awaitable[None]], args: tuple[object, ...]) -> None:
    while True:
        try:
            await worker(*args)
        except BlockingIOError:
            continue  # it counts as running still
        return
