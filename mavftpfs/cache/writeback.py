"""Everything that differs from the vehicle's listings and blocks because we write. Layer: cache.

The tree asks here first. A file that has a draft is answered from it; all else is the vehicle's. Paths are
the vehicle's, normalised; those below `@` never come here for a change.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from random import Random

import trio

from mavftpfs.cache.context import Context
from mavftpfs.cache.delivery import PASSING, Deliverer, may_pass
from mavftpfs.cache.directories import Directories
from mavftpfs.cache.draft import State
from mavftpfs.cache.files import Files
from mavftpfs.cache.names import Names
from mavftpfs.cache.namespace import Namespace
from mavftpfs.cache.nodes import Node, Nodes
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.recovery import SpoolDirectory, describe, move
from mavftpfs.cache.remote import VehicleStore
from mavftpfs.cache.repair import Repair
from mavftpfs.cache.reserved import OwnNames, new_owner, require_writable
from mavftpfs.cache.spool import Spool
from mavftpfs.cache.throttle import Throttle, WriteLimit
from mavftpfs.cache.writefile import Parts, ReadFile, WriteFile
from mavftpfs.shared import readonly
from mavftpfs.shared.errors import (
    AlreadyExists,
    Armed,
    IsADirectory,
    LinkClosed,
    MavftpfsError,
    NoSpace,
    NotFound,
    SpoolFailed,
)
from mavftpfs.shared.model import EntryKind, require_listable
from mavftpfs.shared.readable import readable
from mavftpfs.shared.sameness import Known

log = logging.getLogger("mavftpfs.cache")

RETRY_PAUSE = 1.0
"""Seconds between two rounds of delivering everything."""

PAUSES = (2.0, 30.0)
"""Seconds between two attempts to deliver what no program has open: at first, and at most."""


class Writeback:
    """The writing half of the tree (see cache.tree.Tree for what each call does).

    Attributes:
        context: what its parts share. namespace: mkdir, rmdir, unlink and rename. repair: see there.
    """

    def __init__(
        self,
        *,
        store: VehicleStore,
        directories: Directories,
        files: Files,
        nodes: Nodes,
        options: CacheOptions,
        wall: Callable[[], float],
        rng: Random,
        nursery: trio.Nursery,
        spool_directory: SpoolDirectory | None,
    ) -> None:
        """Build on the parts for reading.

        Without a spool directory, bytes that wait lie in one that does not outlive the process.
        """
        self._limit = limit = WriteLimit()
        self.context = self._context = context = Context(
            store=store,
            directories=directories,
            files=files,
            nodes=nodes,
            options=options,
            clock=directories.clock,
            wall=wall,
            own=OwnNames(new_owner(rng), rng),
            paths=files.paths,
            spool=Spool(
                None if spool_directory is None else spool_directory.path,
                vehicle=lambda: {"system": store.address()[0], "uid": store.board()},
            ),
            retry_later=self._retry_later,
            list_later=self._list_later,
            look_later=lambda: self.repair.look_later(),
        )
        self._throttle = throttle = Throttle(context, limit)
        self._names = names = Names(context)
        self._deliverer = deliverer = Deliverer(context, names, throttle)
        self.repair = Repair(context, names, nursery, deliverer.look_at_all)
        self._nursery = nursery
        self._retrying, self._news = False, trio.Event()
        self.namespace = Namespace(context, names, deliverer)
        self._parts = Parts(context, deliverer, throttle)

    # --- opening

    async def open_reader(self, path: bytes) -> OpenFile:
        """Open a file for reading."""
        async with self._context.paths.hold(path, shared=True):
            node, handle = self._context.nodes.get(path), None
            if node is None or node.draft is None:
                handle = await self._context.files.open(path)
            return ReadFile(self._parts, self._context.nodes.need(path), handle)

    async def open(self, path: bytes, *, truncate: bool) -> OpenFile:
        """Open a file for writing."""
        self._context.require_disarmed()
        await self._deliverer.remove_parts(path)
        async with self._context.paths.hold(path, shared=True):
            file = WriteFile(self._parts, await self._need_draft(path, truncate=truncate))
        if truncate:
            try:
                await file.truncate(0)
            except BaseException:
                file.close()
                raise
        return file

    async def create(self, path: bytes, *, exclusive: bool) -> OpenFile:
        """Make a file, or open the one that is there."""
        self._context.require_disarmed()
        require_writable(path)
        require_listable(path)
        await self._deliverer.remove_parts(path)
        async with self._context.paths.hold(path, shared=True):
            context, node = self._context, self._context.nodes.get(path)
            drafted = node is not None and node.draft is not None  # it is shown, stale or not
            if not drafted and await context.entry(path) is None:
                await self._names.require_new(path)
                node = context.nodes.need(path)
                made = node.draft is None
                if made and node.handles:
                    # A program has a file open that others removed: it must not read the one made now.
                    context.nodes.on_name_taken(node)
                    context.files.kill_all(path)
                    node = context.nodes.need(path)
                if made:
                    node.begin_draft(context.spool, None, context.clock())
                    context.touch(path)
                file = WriteFile(self._parts, node)
                if made:
                    file.on_made()
                return file
        if exclusive:
            raise AlreadyExists(f"{path!r} exists")
        return await self.open(path, truncate=False)

    async def _need_draft(self, path: bytes, *, truncate: bool) -> Node:
        """Return the node of a file that exists, with a draft."""
        context, handle = self._context, None
        node = context.nodes.get(path)
        if node is not None and node.draft is not None:
            return node
        require_writable(path)
        entry = await context.entry(path)
        if entry is None:
            raise NotFound(f"{path!r} does not exist")
        if entry.kind is not EntryKind.FILE:
            raise IsADirectory(f"{path!r} is a directory")
        if truncate:
            # If the size is 0 there is nothing to do: so it has to be true, not remembered.
            base = Known(entry.size or await context.store.stat_size(path))
        else:
            handle = await context.files.open(path)  # its ACK tells the size better than a listing
            listed = context.directories.entry(path)
            told = listed is not None and listed.size == handle.size
            base = Known(handle.size, listed.mtime if listed and told else None)
        try:
            context.require_idle(path)
            node = context.nodes.need(path)
            if node.draft is None:
                node.begin_draft(context.spool, base, context.clock())
                node.base_handle, handle = handle, node.base_handle
        finally:
            if handle is not None:
                handle.close()
        return node

    # --- names

    async def truncate(self, path: bytes, size: int) -> None:
        """See Tree.truncate."""
        self._context.require_changeable()
        async with self._context.paths.hold(path, shared=True):
            node = await self._need_draft(path, truncate=size == 0)
            file = WriteFile(self._parts, node)  # also beside other writers: they may end meanwhile
        had = node.undelivered
        try:
            await file.truncate(size)
            if node.writers > 1:
                file.close()  # the others deliver it
            else:
                await self._deliverer.deliver(node)  # an error undoes the call, and breaks no file
                await file.release()
        except BaseException:
            file.close()
            if not had and not node.writers:
                await self._undo_truncate(node)
            raise

    async def _undo_truncate(self, node: Node) -> None:
        """Forget the draft of a call that failed: its bytes are not wanted any more. If the vehicle may have
        some of them, the draft is kept, and delivered later."""
        async with node.lock, self._context.paths.steady(node, lasting=True):
            await self._deliverer.abandon(node)
            draft = node.draft
            if node.writers or draft is None or self._context.nodes.is_changing(node.path):
                return
            node.forget_draft()
        self._context.nodes.maybe_forget(node)

    # --- the mount's life

    def undelivered(self) -> list[bytes]:
        """See Tree.undelivered."""
        return [node.path for node in self._context.nodes if node.undelivered]

    def broken(self) -> list[bytes]:
        """See Tree.broken."""
        return list(self._context.nodes.broken)

    async def break_unfinished(self) -> None:
        """See Tree.break_unfinished. A file that was closed in vain (its error is known) is whole."""
        reason = LinkClosed("the mount was taken away while a program wrote it")
        for node in list(self._context.nodes):
            if node.writers and node.undelivered and node.error is None:
                async with node.lock:
                    if node.draft is not None and node.draft.state in (State.DIRTY, State.SENDING):
                        await self._deliverer.break_off(node, reason)

    async def drain(self, timeout: float) -> None:
        """See Tree.drain."""
        with trio.move_on_after(timeout):
            await self._deliver_each(lambda node: True)
            while any(node.undelivered and may_pass(node) for node in self._context.nodes):
                await trio.sleep(RETRY_PAUSE)
                await self._deliver_each(may_pass)

    async def tidy_up(self) -> None:
        """See Tree.tidy_up."""
        if self._context.store.why_lost() is not None:
            return
        with suppress(MavftpfsError):
            await self._deliverer.remove_parts()
        await self.repair.finish()

    def recover_to(self, directory: Path) -> list[Path]:
        """See Tree.recover_to."""
        context, kept = self._context, []
        failed: OSError | NoSpace | SpoolFailed | None = None
        for node in [*context.nodes, *context.nodes.broken.values()]:
            if not (node.undelivered or node.broken) or node.draft is None:
                continue
            facts = describe(node.path, node.draft, node.error, context.wall)
            try:
                data = Path(node.draft.content.persist(facts))
                kept.append(move(data, facts, directory))
            except (OSError, NoSpace, SpoolFailed) as error:
                log.error("%r could not be saved: %s", node.path, error)
                failed = error
            else:
                if node.broken:
                    del context.nodes.broken[node.path]
                node.forget_draft()
        if failed is not None and not kept:
            raise failed
        return kept

    def armed_changed(self, armed: bool) -> None:
        """See Tree.armed_changed."""
        blocked = armed and not self._context.options.write_armed
        if blocked == self._context.blocked:
            return
        self._context.blocked = blocked
        self._throttle.waiting.unpark_all()
        self.retry()

    def retry(self) -> None:
        """Deliver what no program writes any more: the vehicle is back, or may be written again. Errors that
        this ends are forgotten."""
        for node in self._context.nodes:
            if isinstance(node.error, PASSING):
                node.error = None
        self.repair.retry()
        if self._deliverer.parts or self.undelivered():
            self._news.set()
            self._retry_later()

    def status(self) -> dict[str, object]:
        """Return counters; bytes_... in bytes. bytes_undelivered: of whole files; bytes_held: what they take
        here."""
        nodes, broken = list(self._context.nodes), self._context.nodes.broken.items()
        sizes = [node.draft.size for node in nodes if node.undelivered and node.draft is not None]
        errors = {n.path: readable(str(n.error)) for n in nodes if n.error is not None}
        return {
            "bytes_held": self._context.spool.held,
            "unacked_max": self._limit.bytes(),
            "write_rate": self._throttle.speed,
            "files_undelivered": len(self.undelivered()),
            "broken": {path.decode(errors="replace"): _reason_then(node.error) for path, node in broken},
            "bytes_undelivered": sum(sizes),
            "transfers": self._throttle.transfers(),
            "errors": {path.decode(errors="replace"): text for path, text in errors.items()},
            **self._deliverer.verifier.counts,
        }

    # --- delivering while nobody waits for it

    async def _deliver_each(self, wanted: Callable[[Node], bool]) -> None:
        """Try once to deliver each file that is wanted, as long as it is; errors are kept with the file."""
        for node in self._context.nodes:
            if not node.undelivered or not wanted(node):
                continue
            try:
                await self._deliverer.deliver(node, wanted=partial(wanted, node))
            except MavftpfsError as error:
                log.debug("%r is still not delivered: %s", node.path, error)
            else:
                self._context.nodes.maybe_forget(node)

    def _list_later(self, directory: bytes, seconds: float = 0.0, *, only_in_doubt: bool = False) -> None:
        self.repair.list_later(directory, seconds, only_in_doubt=only_in_doubt)

    def _retry_later(self) -> None:
        """Try again later: something was not delivered, or a broken file left a part on the card."""
        if not self._retrying:
            self._retrying = True
            self._nursery.start_soon(self._retry)

    async def _retry(self) -> None:
        """Deliver what no program writes: with growing pauses as long as
        that may help, because a link may fail and return between two heartbeats. When there are news of the
        vehicle, everything is tried at once, also what was refused."""
        nodes, (pause, longest) = self._context.nodes, PAUSES
        parts = self._deliverer.parts
        try:
            while self._news.is_set() or parts or any(n.undelivered and may_pass(n) for n in nodes):
                with trio.move_on_after(pause):
                    await self._news.wait()
                is_new, pause = self._news.is_set(), min(2 * pause, longest)
                if is_new:
                    self._news, pause = trio.Event(), PAUSES[0]
                    for node in nodes:
                        node.start_after = float("-inf")
                with suppress(MavftpfsError):
                    await self._deliverer.remove_parts()
                await self._deliver_each(partial(self._is_left_to_us, is_new))
        finally:
            self._retrying = False

    @staticmethod
    def _is_left_to_us(is_new: bool, node: Node) -> bool:
        """Return whether a file is to be delivered unasked."""
        return not node.writers and (is_new or may_pass(node))


def _reason_then(error: Exception | None) -> str:
    """Return why a write failed, told later: the vehicle may be disarmed meanwhile."""
    return readonly.WAS_ARMED if isinstance(error, Armed) else readable(str(error))
