"""Brings logs automatically: connects, looks, fetches and lets go as `flights` decides. Layer: client.

One task listens for vehicles. Another one takes the steps, one at a time; news end a step that must not go
on. A third hands on the logs that came. A transfer lets go by leaving the connection, which closes the
server's session.
"""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from pathlib import Path

import trio

from mavftpfs.client.brought import HEAD, Brought, Memory
from mavftpfs.client.connect import NO_SINKS, Sinks, connect_options, opened, plain_nursery
from mavftpfs.client.contact import TICK, Contact, LinkContact, MountContact
from mavftpfs.client.download import Wish, named, wanted_logs
from mavftpfs.client.fetch import Fetched, Fetcher, LocalDiskFull, StillGrowing, Wanted, local_disk
from mavftpfs.client.files import Session, Target, reading
from mavftpfs.client.flights import Fetch, Log, Look, Policy, Step, Wait
from mavftpfs.client.options import Options
from mavftpfs.client.progress import Progress
from mavftpfs.client.proof import Verify
from mavftpfs.client.selection import is_no_log
from mavftpfs.link.base import Link
from mavftpfs.link.uri import LinkSpec
from mavftpfs.protocol.payload import crc32
from mavftpfs.session.connection import connected
from mavftpfs.shared.errors import LinkClosed, LinkError, MavftpfsError, NotFound, RequestTimeout
from mavftpfs.shared.readable import readable_size

REOPEN = 5.0
"""Seconds until a link that cannot be opened is tried again."""
SPARE = 1 << 20
"""Bytes that are left free on the local disk; they count as needed."""

HandOn = Callable[[Path], Awaitable[str]]
"""Does something with a log that came; returns why it failed, or ""."""


@dataclass(frozen=True, slots=True)
class WatchWish:
    """What is to be brought. logs: as `sync` has it."""

    logs: Wish
    verify: Verify = "auto"


class Watch:
    """Brings the logs of each vehicle that comes, into a directory for each. say: gets lines for people.

    Raises:
        UsageError: the directory cannot be used.
    """

    def __init__(
        self,
        wish: WatchWish,
        say: Callable[[str], None],
        hand_on: HandOn | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._wish = wish
        self._local = wish.logs.local
        self._say = say
        self._hand_on = hand_on
        self._progress = progress or Progress()
        self._policy = Policy()
        self._step: Step | None = None
        self._scope = trio.CancelScope()
        self._leave = False
        self._broken: LinkError | None = None
        self._wanted_system = 0
        self._logs: dict[int, dict[bytes, Wanted]] = {}
        self._names: dict[int, str] = {}
        self._target: Target | None = None
        self._same_heads: set[tuple[str, str]] = set()
        self._to_hand_on, self._handed_over = trio.open_memory_channel[Brought](inf)
        self._complaints: dict[str, str] = {}
        with local_disk(self._local):
            self._local.mkdir(parents=True, exist_ok=True)
            self._memory = Memory(self._local)
            self._memory.begin()

    # --- what is heard (Hearing)

    def heard(self, system: int, *, armed: bool) -> None:
        """See contact.Hearing."""
        news = self._policy.heard(system, armed, trio.current_time())
        if not news:
            return
        if news in ("here", "back"):
            self._same_heads.clear()
            news += f", {'armed' if armed else 'disarmed'}"
        self._tell_of(system, f"is {news}")

    def refused(self, system: int) -> None:
        """See contact.Hearing."""
        now = trio.current_time()
        was_free = self._policy.may_transfer(system, now)
        self._policy.refused(system, now)
        if was_free:
            self._tell_of(system, "refused to be armed: nothing is transferred for a minute")

    def restarted(self, system: int) -> None:
        """See contact.Hearing."""
        self._same_heads.clear()
        self._policy.restarted(system, trio.current_time())
        self._tell_of(system, "restarted")

    def replaced(self, system: int) -> None:
        """See contact.Hearing."""
        self._policy.replaced(system)
        self._leave = True
        self._tell_of(system, "is another one now")

    def ended(self, error: LinkError) -> None:
        """See contact.Hearing."""
        self._leave, self._broken = True, error
        self._end_step()

    def time_passed(self) -> None:
        """See contact.Hearing."""
        for system in self._policy.newly_lost(trio.current_time()):
            self._tell_of(system, "is lost")

    def _tell_of(self, system: int, news: str) -> None:
        self._end_step()
        stopped = isinstance(self._step, Fetch) and self._scope.cancel_called
        self._say(f"vehicle {system} {news}{'; the transfer waits' if stopped else ''}")

    def _end_step(self) -> None:
        """News came: end the step under way, unless it asks a vehicle and may go on."""
        step, now = self._step, trio.current_time()
        asks = isinstance(step, Look | Fetch) and self._policy.may_transfer(step.system, now)
        if self._leave or not asks:
            self._scope.cancel()

    # --- what is done

    async def run(self, target: Target) -> None:
        """Bring logs, by a mount that is up or over a link of our own, until cancelled.

        Raises:
            UsageError: SOURCE or the options are wrong.
        """
        self._target = target
        async with plain_nursery() as nursery:
            nursery.start_soon(self._hand_on_all)
            while True:
                try:
                    mounted = await target.mounted()
                    if mounted is not None:
                        self._forget_complaint("link")
                        await self.serve(MountContact(mounted))
                        continue
                    assert target.spec is not None
                    async with opened(target.spec, target.options) as link:
                        self._forget_complaint("link")
                        await self.run_on(link, target.spec, target.options, target.sinks)
                except (LinkError, RequestTimeout) as exc:
                    self._complain("link", str(exc))
                await trio.sleep(REOPEN)

    async def run_on(self, link: Link, spec: LinkSpec, options: Options, sinks: Sinks = NO_SINKS) -> None:
        """Serve each vehicle that is heard on an open link.

        Raises:
            LinkClosed: it was closed for good.
        """
        while True:
            system = options.target_system or self._wanted_system
            settings = replace(connect_options(options), target_system=system)
            async with connected(
                link, settings, on_payload=sinks.payload, on_frame=sinks.frame
            ) as connection:
                await self.serve(LinkContact(connection, spec, options))

    async def serve(self, contact: Contact) -> None:
        """Take the steps for a vehicle. Return when the contact has to be left, to close its session or to
        serve another vehicle.

        Raises:
            LinkError: the contact broke.
        """
        self._leave, self._broken = False, None
        async with plain_nursery() as nursery, AsyncExitStack() as stack:
            nursery.start_soon(contact.listen, self)
            session: Session | None = None
            while not self._leave:
                step = self._policy.next(trio.current_time())
                if isinstance(step, Wait):
                    await self._take(step, partial(trio.sleep_until, step.until))
                elif contact.system is None:
                    await trio.sleep(TICK)
                elif step.system != contact.system:
                    self._wanted_system = step.system
                    await trio.sleep(TICK)
                    break
                elif session is None:
                    session = await contact.enter(stack)  # then another step may be due
                else:
                    await self._take(step, partial(self._work, step, contact, session))
                    if self._scope.cancel_called:
                        break
        if self._broken is not None:
            raise self._broken

    async def _take(self, step: Step, work: Callable[[], Awaitable[None]]) -> None:
        """Take a step, which `_end_step` may end."""
        with trio.CancelScope() as self._scope:
            self._step = step
            try:
                await work()
            finally:
                self._step = None

    async def _work(self, step: Look | Fetch, contact: Contact, session: Session) -> None:
        if not self._local_is_ready(step):
            self._policy.local_trouble(trio.current_time())
        elif isinstance(step, Fetch):
            await self._fetch(step.system, step.log, session)
        elif isinstance(contact, LinkContact) and await self._is_mounted():
            raise LinkClosed("a mount has this vehicle now: its files are used")
        else:
            await self._look(step.system, contact, session)

    async def _is_mounted(self) -> bool:
        """Return whether a mount of that vehicle came up: we would share its only session."""
        return self._target is not None and await self._target.mounted() is not None

    async def _look(self, system: int, contact: Contact, session: Session) -> None:
        """List the logs, and tell the policy which are new."""
        name = self._names[system] = await contact.identity() or f"system-{system}"
        local = self._local / name
        self._complain(f"name of {system}", f"vehicle {system} is {name}; its logs go into {local}")
        await session.files.refresh()
        self._logs[system] = {}
        failed = False
        try:
            with local_disk(self._local):
                self._memory = Memory(self._local)
            _, logs, unlisted, _ = await wanted_logs(session, self._wish.logs, local)
            logs = [log for log in logs if not is_no_log(log)]
            new = [log for log in logs if not await self._is_known(name, log, session)]
            warning = self._wish.logs.selection.warning(new)
            if warning:
                self._complain(f"times of {system}", f"vehicle {system}: {warning}")
        except NotFound as exc:
            self._complain(f"logs of {system}", f"vehicle {system}: {exc}")
            return self._policy.looked(system, (), trio.current_time())
        except MavftpfsError as exc:
            self._complain(f"logs of {system}", f"vehicle {system}: {exc}")
            return self._policy.failed(system, None, trio.current_time())
        for path, error in unlisted:
            failed = True
            self._complain(f"logs of {system}", f"vehicle {system}: {named(path, error)}")
        if not failed:
            self._forget_complaint(f"logs of {system}")
        self._logs[system] = {log.remote: log for log in new}
        self._policy.looked(system, [Log(log.remote, log.size) for log in new], trio.current_time())
        if failed:
            self._policy.failed(system, None, trio.current_time())

    async def _is_known(self, name: str, log: Wanted, session: Session) -> bool:
        """Return whether a log was brought before. Logs without a time are told apart by their first bytes,
        which are asked for once, until the vehicle was away."""
        key = name, os.fsdecode(session.on_vehicle(log.remote))
        known = self._memory.of(*key)
        if known is None or known.size != log.size or not known.proven:
            return False
        if log.mtime is not None and known.mtime is not None:
            return log.mtime == known.mtime
        if known.head is None or key in self._same_heads:
            return True
        async with reading(session.files, log.remote) as file:
            same = crc32(await file.read(0, min(HEAD, log.size))) == known.head
        if same:
            self._same_heads.add(key)
        return same

    async def _fetch(self, system: int, log: Log, session: Session) -> None:
        """Fetch a log, and tell the policy how it went."""
        wanted = self._logs[system][log.path]
        key = self._names[system], os.fsdecode(session.on_vehicle(log.path))
        if not wanted.here:
            begun = f", from {readable_size(wanted.begun)} on" if wanted.begun else ""
            self._say(f"vehicle {system}: {wanted.name} begins, {readable_size(wanted.size)}{begun}")
        self._progress.plan(1, wanted.size)
        try:
            fetched = await Fetcher(session, self._progress, self._wish.verify).fetch(wanted)
            with local_disk(wanted.local):
                self._arrived(system, log, fetched, key)
        except NotFound:
            self._policy.fetched(system, log)
        except StillGrowing as exc:
            if self._policy.grows(system, log, trio.current_time()):
                came = f"its first {readable_size(exc.came)} are here as {wanted.part.name}"
                self._say(f"vehicle {system}: {wanted.name} still grows after the flight; {came}")
        except LocalDiskFull as exc:
            self._complain("local", f"{exc}; waiting for room")
            self._policy.local_trouble(trio.current_time())
        except MavftpfsError as exc:
            self._complain(wanted.name, f"vehicle {system}: {named(wanted.name, exc)}; it is tried again")
            self._policy.failed(system, log, trio.current_time())
        else:
            self._forget_complaint("local")
            self._forget_complaint(wanted.name)
        finally:
            self._progress.end(wanted.size)
            self._progress.plan(0, 0)

    def _arrived(self, system: int, log: Log, fetched: Fetched, key: tuple[str, str]) -> None:
        wanted, proof = fetched.wanted, fetched.proof
        proven = not (proof.lacking and proof.later)
        with wanted.local.open("rb") as file:
            head = crc32(file.read(HEAD))
        name, path = key
        place = str(wanted.local.relative_to(self._local))
        brought = Brought(path, place, fetched.size, wanted.mtime, name, head, proven)
        self._memory.note(replace(brought, handed_on=not proven or self._hand_on is None))
        if not proven:
            self._policy.failed(system, log, trio.current_time())
            self._say(f"vehicle {system}: {wanted.name} is here, not proven: {proof.lacking}")
            return
        self._policy.fetched(system, log)
        self._say(f"vehicle {system}: {wanted.name} is here, verified by {proof.words}{fetched.kept_words}")
        if self._hand_on is not None:
            self._to_hand_on.send_nowait(brought)

    # --- the local directory

    def _local_is_ready(self, step: Look | Fetch) -> bool:
        """Return whether the directory is there and has room; if not, complain once."""
        if not self._memory.is_there():
            self._complain("local", f"{self._local} is not there any more; waiting for it")
            return False
        if isinstance(step, Fetch):
            wanted = self._logs[step.system][step.log.path]
            missing = 0 if wanted.here else wanted.size - wanted.begun
            free = free_space(self._local)
            if free - SPARE < missing:
                needed = f"{readable_size(missing + SPARE)} are needed, {readable_size(free)} are free"
                self._complain("local", f"{self._local} is full: {needed}; waiting for room")
                return False
        self._forget_complaint("local")
        return True

    # --- what is handed on

    async def _hand_on_all(self) -> None:
        """Hand on the logs that came, one after the other; first those that an earlier run did not hand
        on."""
        if self._hand_on is None:
            return
        for log in self._memory.logs():
            if log.proven and not log.handed_on:
                await self._hand_on_one(log, self._hand_on)
        async for log in self._handed_over:
            await self._hand_on_one(log, self._hand_on)

    async def _hand_on_one(self, log: Brought, hand_on: HandOn) -> None:
        path = self._local / log.file
        if not is_file(path):  # a user took it away
            return
        problem = await hand_on(path)
        if problem:
            self._say(f"{log.file}: {problem}; it is tried again at the next start")
            return
        try:
            with local_disk(path):
                self._memory.note(replace(log, handed_on=True))
        except MavftpfsError as exc:
            self._say(f"{log.file} was handed on, which could not be noted: {exc}")

    # --- what is said once

    def _complain(self, about: str, line: str) -> None:
        """Print a line, unless it was the last one about the same thing."""
        if self._complaints.get(about) != line:
            self._complaints[about] = line
            self._say(line)

    def _forget_complaint(self, about: str) -> None:
        """Forget the last line about something, because it is over."""
        self._complaints.pop(about, None)


def is_file(path: Path) -> bool:
    """Return whether a file is there."""
    return path.is_file()


def free_space(directory: Path) -> float:
    """Return the bytes that are free on a local disk, infinite if it does not tell."""
    try:
        facts = os.statvfs(directory)
    except OSError:
        return inf
    return facts.f_bavail * facts.f_frsize
