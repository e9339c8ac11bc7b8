"""Downloads logs after each flight: syncs again and again, as `watchpolicy` decides. Layer: client.

`Watch.serve` listens to the vehicles, and starts a sync of one of them when it is due. If the vehicle arms,
refuses to be armed or is lost, `serve` cancels the sync. After each sync, cancelled or not, the watch leaves
the connection, which closes the server's session.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

import trio

from mavftpfs.client.compare import Verify
from mavftpfs.client.connect import NO_SINKS, Sinks, connect_options, opened
from mavftpfs.client.contact import Contact, Heard, LinkContact, MountContact
from mavftpfs.client.download import Downloads, Outcome, Reports, named
from mavftpfs.client.fetch import Fetched, Fetcher, LocalTrouble, StillGrowing, Wanted, local_disk
from mavftpfs.client.files import Session, Target, reading
from mavftpfs.client.logs import SyncRequest, path_of, sync
from mavftpfs.client.manifest import HEAD, NAME, Downloaded, Manifest
from mavftpfs.client.progress import Progress
from mavftpfs.client.selection import is_no_log
from mavftpfs.client.several import ON_COMMAND_LINE
from mavftpfs.client.watchpolicy import Log, Policy
from mavftpfs.link.base import Link, plain_nursery
from mavftpfs.link.uri import LinkSpec
from mavftpfs.protocol.payload import crc32
from mavftpfs.session.connection import connected
from mavftpfs.shared.errors import LinkClosed, LinkError, MavftpfsError, NotFound, RequestTimeout
from mavftpfs.shared.options import Options
from mavftpfs.shared.readable import readable_size

TICK = 0.25
"""Seconds between two looks at heartbeats; a vehicle that arms gets no request a second later."""
REOPEN = 5.0
"""Seconds until the watch tries again to open a link."""
SILENCE = 3600.0
"""Seconds after which the watch prints a line although nothing happened."""

HandOn = Callable[[Path], Awaitable[str]]
"""Runs a command for a downloaded log; returns why the command failed, or ""."""


class Watch:
    """Downloads the logs of each vehicle that appears, into a directory for each. say: gets lines for people.

    Raises:
        UsageError: the directory cannot be used.
    """

    def __init__(
        self,
        request: SyncRequest,
        say: Callable[[str], None],
        hand_on: HandOn | None = None,
        progress: Progress | None = None,
        verify: Verify = "auto",
    ) -> None:
        self._request = request
        self._verify: Verify = verify
        self._print = say
        self._said_at = trio.current_time()
        self._complaints = Complaints(self._say)
        self._progress = progress or Progress()
        self._policies: dict[int, Policy] = {}
        self._sync: VehicleSync | None = None
        self._turn = 0
        self.keeping = Keeping(request.local, self._say, hand_on)

    def _say(self, line: str) -> None:
        self._said_at = trio.current_time()
        self._print(line)

    # --- the way to the vehicles

    async def run(self, target: Target) -> None:
        """Download logs, by a mount that is up or over a link of the watch's own, until cancelled.

        Raises:
            UsageError: SOURCE or the options are wrong.
        """
        async with plain_nursery() as nursery:
            nursery.start_soon(self.keeping.hand_on_all)
            while True:
                try:
                    async with target.mounted() as mounted:
                        if mounted is not None:
                            self._complaints.over("link")
                            if mounted.unnamed is not None:
                                self._complaints.tell("others", mounted.unnamed.note(ON_COMMAND_LINE))
                            contact = MountContact(mounted)
                            while True:
                                await self.serve(contact)
                    await self._run_on_link(target)
                except (LinkError, RequestTimeout) as exc:
                    self._complaints.tell("link", str(exc))
                self._break_silence()
                await trio.sleep(REOPEN)

    async def _run_on_link(self, target: Target) -> None:
        assert target.spec is not None

        async def is_mounted() -> bool:
            async with target.mounted() as mounted:
                return mounted is not None

        async with opened(target.spec, target.options) as link:
            self._complaints.over("link")
            await self.run_on(link, target.spec, target.options, target.sinks, is_mounted)

    async def run_on(
        self,
        link: Link,
        spec: LinkSpec,
        options: Options,
        sinks: Sinks = NO_SINKS,
        is_mounted: Callable[[], Awaitable[bool]] | None = None,
    ) -> None:
        """Serve each vehicle that is heard on an open link, one after the other.

        is_mounted: returns whether a mount has the vehicle now.

        Raises:
            LinkError: the link was closed for good, or a mount has the vehicle now.
        """
        while True:
            settings = replace(connect_options(options), target_system=options.target_system or self._turn)
            async with connected(
                link, settings, on_payload=sinks.payload, on_frame=sinks.frame
            ) as connection:
                await self.serve(LinkContact(connection, spec, options, is_mounted))

    async def serve(self, contact: Contact) -> None:
        """Listen, and sync the logs of one vehicle when that is due. Return when the watch should leave the
        contact.

        Raises:
            LinkError: the contact broke.
        """
        self._sync = None
        async with plain_nursery() as nursery:
            while not contact.replaced:
                self._hear(await contact.listen())
                self._forget_another(contact)
                self._break_silence()
                now = trio.current_time()
                running: VehicleSync | None = self._sync
                if running is not None and (running.over or not running.policy.may_transfer(now)):
                    if running.broken is not None:
                        raise running.broken
                    return
                system = self._due(contact.system, now) if running is None else None
                if system is not None and system == contact.system:
                    self._sync = self._new_sync(system)
                    nursery.start_soon(self._sync.run, contact)
                elif system not in (None, self._turn):
                    self._turn = system
                    return
                await trio.sleep(TICK)
        self._forget_another(contact)

    def _forget_another(self, contact: Contact) -> None:
        """Begin anew with a system id that another vehicle has now."""
        system, uid = contact.system, contact.uid
        policy = None if system is None else self._policies.get(system)
        if system is None or policy is None:
            return
        if contact.replaced or (uid and policy.uid and uid != policy.uid):
            del self._policies[system]
            self._say(f"vehicle {system} is another one now")
        else:
            policy.uid = uid or policy.uid

    def _due(self, served: int | None, now: float) -> int | None:
        """Return a vehicle whose logs are due, None if there is none; `served` comes first."""
        due = sorted(system for system, policy in self._policies.items() if policy.due(now))
        return served if served in due else due[0] if due else None

    def _new_sync(self, system: int) -> VehicleSync:
        policy = self._policies[system]
        told = self._complaints, self._say, self._progress
        return VehicleSync(system, policy, self._request, self._verify, self.keeping, *told)

    # --- what is heard

    def _hear(self, found: Sequence[Heard]) -> None:
        """Take heartbeats, and print the news."""
        now = trio.current_time()
        for one in found:
            policy = self._policies.setdefault(one.system, Policy())
            news = policy.heard(one.armed, now)
            if news in ("here", "back"):
                news += f", {'armed' if one.armed else 'disarmed'}"
            if news:
                self._tell_of(one.system, f"is {news}", now)
            if one.restarted:
                policy.restarted(now)
                self._tell_of(one.system, "restarted", now)
            if one.refused:
                was_free = policy.may_transfer(now)
                policy.refused(now)
                if was_free:
                    told = "refused to be armed: nothing is transferred for a minute"
                    self._tell_of(one.system, told, now)
        for system, policy in self._policies.items():
            if policy.newly_lost(now):
                self._tell_of(system, "is lost", now)

    def _break_silence(self) -> None:
        """Print from time to time that the watch is alive, and the vehicles that are here."""
        if trio.current_time() - self._said_at >= SILENCE:
            here = [f"vehicle {system} is {policy.state}" for system, policy in self._policies.items()]
            self._say(f"nothing new for an hour; {', '.join(here) or 'no vehicle was heard'}")

    def _tell_of(self, system: int, news: str, now: float) -> None:
        transfers = self._sync is not None and self._sync.system == system and bool(self._progress.name)
        stopped = transfers and not self._policies[system].may_transfer(now)
        self._say(f"vehicle {system} {news}{'; the transfer waits' if stopped else ''}")


class Complaints:
    """Tells people each trouble once, until the trouble ends or another one follows."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._told: dict[str, str] = {}

    def tell(self, about: str, line: str) -> None:
        """Print a line, unless it is empty or equals the last one about the same thing."""
        if line and self._told.get(about) != line:
            self._told[about] = line
            self._say(line)

    def over(self, about: str) -> None:
        """Forget the last line about something."""
        self._told.pop(about, None)


class Keeping:
    """The local directory of a watch: its manifest, and the command that is run for each log.

    Raises:
        UsageError: the directory cannot be used.
    """

    def __init__(self, local: Path, say: Callable[[str], None], hand_on: HandOn | None) -> None:
        self.local = local
        self._say = say
        self._hand_on = hand_on
        self._to_hand_on, self._handed_over = trio.open_memory_channel[Downloaded](inf)
        with local_disk(local):
            local.mkdir(parents=True, exist_ok=True)
            self.manifest = Manifest(local)
            self.manifest.begin()
        for log in self.manifest.logs():  # the command failed, or an earlier run ended first
            if log.proven and not log.handed_on:
                self._to_hand_on.send_nowait(log)

    def require_there(self) -> None:
        """Check that the directory is there.

        Raises:
            LocalTrouble: it is missing.
        """
        if not self.manifest.is_there():
            there = self.local.is_dir()
            problem = f"has no {NAME}, so it is not the same disk" if there else "does not exist"
            raise LocalTrouble(f"{self.local} {problem}")

    def look(self) -> None:
        """Read the manifest again, because another disk may be mounted there now.

        Raises:
            UsageError: the manifest cannot be read.
        """
        with local_disk(self.local):
            self.manifest = Manifest(self.local)

    def note(self, log: Downloaded) -> None:
        """Note a downloaded log, and have the command run for it, if there is one and the log is verified.

        Raises:
            OSError: the local disk refuses it.
        """
        log = replace(log, handed_on=self._hand_on is None or not log.proven)
        self.manifest.note(log)
        if not log.handed_on:
            self._to_hand_on.send_nowait(log)

    async def hand_on_all(self) -> None:
        """Run the command for the downloaded logs, one after the other; return when none is left."""
        if self._hand_on is None:
            return
        async for log in self._handed_over:
            if (self.local / log.file).is_file():  # a user may have moved it away
                await self._hand_on_one(log, self._hand_on)

    async def _hand_on_one(self, log: Downloaded, hand_on: HandOn) -> None:
        problem = await hand_on(self.local / log.file)
        if problem:
            self._say(f"{log.file}: {problem}; the watch tries again at its next start")
        elif self.manifest.of(log.vehicle, log.path) == log:  # the log did not grow meanwhile
            try:
                with local_disk(self.local):
                    self.manifest.note(replace(log, handed_on=True))
            except MavftpfsError as exc:
                self._say(f"{log.file} was handed on, which could not be noted: {exc}")


@dataclass(slots=True)
class VehicleSync(Reports):
    """One sync of the logs of a vehicle. over: the sync came to its end; broken: the error that ended the
    contact during the sync."""

    system: int
    policy: Policy
    request: SyncRequest
    verify: Verify
    keeping: Keeping
    complaints: Complaints
    say: Callable[[str], None]
    progress: Progress
    over: bool = False
    broken: LinkError | None = None
    _vehicle: str = ""

    async def run(self, contact: Contact) -> None:
        """Sync, and report the result to the policy; if the contact breaks, the sync stays due."""
        self.policy.begin()
        try:
            self.keeping.require_there()
            self.keeping.look()
            async with contact.session() as session:
                await self._sync(session, await contact.identity() or f"system-{self.system}")
        except LinkClosed as exc:
            self.broken = exc
        except LocalTrouble as exc:
            self.complaints.tell("local", f"{exc}; waiting for the disk")
            self.policy.local_trouble(trio.current_time())
        except NotFound as exc:  # before the first flight there is no directory of logs
            self._complain("logs", str(exc))
        except MavftpfsError as exc:
            self._complain("logs", str(exc))
            self.policy.failed(trio.current_time())
        else:
            self.complaints.over(f"{self.system} logs")
        if self.broken is None:
            self.policy.synced()
        self.over = True

    async def _sync(self, session: Session, vehicle: str) -> None:
        self._vehicle, local = vehicle, self.keeping.local / vehicle
        self._complain("name", f"is {vehicle}; its logs go into {local}", between=" ")
        outcome = Outcome()
        downloads = Downloads(Fetcher(session, self.progress, self.verify), outcome, self)
        try:
            await sync(downloads, replace(self.request, local=local), self)
        finally:
            self.progress.end(0)
            self.progress.plan(0, 0)
        now = trio.current_time()
        for log in outcome.wanted:
            error = outcome.failed.get(log.remote)
            if not isinstance(error, StillGrowing):
                continue
            self.policy.grew(log.remote, now)
            if log.growing:
                came = f"its first {readable_size(error.came)} are here as {log.part.name}"
                self._tell(f"{log.name} still grows after the flight; {came}")
        if any(not isinstance(error, StillGrowing | NotFound) for error in outcome.failed.values()):
            self.policy.failed(now)

    # --- which logs (Record)

    async def missing(self, session: Session, logs: Sequence[Wanted]) -> list[Wanted]:
        """See Record: the logs that the policy chooses."""
        new = [log for log in logs if not is_no_log(log) and not await self._is_known(session, log)]
        chosen = self.policy.choose([Log(log.remote, log.size) for log in new], trio.current_time())
        return [replace(log, growing=chosen[log.remote]) for log in new if log.remote in chosen]

    async def _is_known(self, session: Session, log: Wanted) -> bool:
        """Return whether a log was downloaded before. If the vehicle reports no times, compare its first
        bytes, once until the vehicle was away."""
        path = path_of(session, log)
        known = self.keeping.manifest.of(self._vehicle, path)
        if known is None or known.size != log.size or not known.proven:
            return False
        if log.mtime is not None and known.mtime is not None:
            return log.mtime == known.mtime
        if known.head is None or path in self.policy.unchanged:
            return True
        async with reading(session.files, log.remote) as file:
            same = crc32(await file.read(0, min(HEAD, log.size))) == known.head
        if same:
            self.policy.unchanged.add(path)
        return same

    def note(self, session: Session, fetched: Fetched) -> None:
        """See Record."""
        log, path = fetched.wanted, path_of(session, fetched.wanted)
        with log.local.open("rb") as file:
            head = crc32(file.read(HEAD))
        place = str(log.local.relative_to(self.keeping.local))
        self.keeping.note(
            Downloaded(path, place, fetched.size, log.mtime, self._vehicle, head, fetched.proven)
        )

    # --- what is told (Reports)

    def begins(self, wanted: Wanted) -> None:
        """See Reports; check the local directory first."""
        self.keeping.require_there()
        if not wanted.here:
            begun = f", from {readable_size(wanted.begun)} on" if wanted.begun else ""
            self._complain("begins", f"{wanted.name} begins, {readable_size(wanted.size)}{begun}")

    def arrived(self, fetched: Fetched) -> None:
        """See Reports."""
        name, verified = fetched.wanted.name, fetched.verified
        for about in (f"{self.system} {name}", f"{self.system} begins", "local"):
            self.complaints.over(about)
        if fetched.proven:
            self.policy.arrived()
            self._tell(f"{name} is here, verified by {verified.how}{fetched.kept_words}")
        else:
            self.policy.failed(trio.current_time())
            self._tell(f"{name} is here, not verified: {verified.lacking}")

    def failed(self, name: str, error: MavftpfsError) -> None:
        """See Reports."""
        if not isinstance(error, StillGrowing | NotFound):
            self._complain(name, f"{named(name, error)}; the watch tries again")

    def says(self, line: str) -> None:
        """See Reports."""
        self._complain("selection", line)

    def _complain(self, about: str, line: str, between: str = ": ") -> None:
        self.complaints.tell(f"{self.system} {about}", f"vehicle {self.system}{between}{line}")

    def _tell(self, line: str) -> None:
        self.say(f"vehicle {self.system}: {line}")
