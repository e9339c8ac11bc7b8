"""The one-shot verbs: call the client with the parsed words, and print the result. Layer: cli."""

from __future__ import annotations

import argparse
import json
import logging
import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import trio

from mavftpfs.cli import listing, watching
from mavftpfs.cli.commands import left_by_killed_mounts_line, say
from mavftpfs.cli.drawing import shown
from mavftpfs.client import download, logs, names, upload
from mavftpfs.client.connect import open_sinks
from mavftpfs.client.fetch import Fetched, Fetcher
from mavftpfs.client.files import Session, Target
from mavftpfs.client.progress import Progress, followed, waits_told
from mavftpfs.client.recover import Left, put_back
from mavftpfs.client.selection import Selection, parse_date
from mavftpfs.client.several import ON_COMMAND_LINE
from mavftpfs.client.source import files_in_mount, target_of
from mavftpfs.client.undelivered import (
    Recovered,
    chosen,
    recovered_below,
    recovered_directory,
    recovery_directory,
)
from mavftpfs.link.base import plain_nursery
from mavftpfs.mount import daemon
from mavftpfs.mount.options import parse_options
from mavftpfs.shared.errors import (
    ExitCode,
    LinkClosed,
    LinkError,
    MavftpfsError,
    NotDelivered,
    RequestTimeout,
    UsageError,
    exit_code_for,
)
from mavftpfs.shared.private import make_private_directory
from mavftpfs.shared.readable import count_files, printable, readable_size

ResultT = TypeVar("ResultT")
Args = argparse.Namespace


def _target(args: Args, component: int | None) -> Target:
    if component is not None:
        args.options.append(f"target_component={component}")
    return target_of(args.source, parse_options(args.options))


def _paths_of(args: Args, default: Sequence[str] = ()) -> tuple[list[bytes], int | None]:
    """Return the paths to read, and the component that they name. SOURCE itself may be the first file.

    Raises:
        UsageError: there is no path, or one is malformed.
    """
    inside = files_in_mount(args.source, args.paths, lists=bool(default))
    if inside is not None:
        args.source, args.paths = inside
    if not args.paths and not default:
        raise UsageError("PATH is missing: name a file of the vehicle behind SOURCE; see --help")
    return names.parse_paths(args.paths or default)


def run(
    args: Args,
    function: Callable[[Target], Coroutine[Any, Any, ResultT]],
    component: int | None = None,
) -> ResultT:
    """Run a verb; Ctrl-C cancels it, so that the vehicle's session is still closed."""
    target = _target(args, component)
    daemon.log_to_stderr(logging.DEBUG if args.debug else logging.WARNING)
    daemon.warn_of_gone(target.options)
    if not args.debug:  # because the caches' warnings are raised as errors, too, in one line
        logging.getLogger("mavftpfs.cache").setLevel(logging.ERROR)
    with open_sinks(target.options, debug=args.debug, tell=say) as sinks:
        return trio.run(until_interrupted, partial(function, replace(target, sinks=sinks)))


def with_session(
    args: Args,
    function: Callable[[Session], Coroutine[Any, Any, ResultT]],
    component: int | None = None,
    *,
    writing: bool = False,
) -> ResultT:
    """Run a verb on the vehicle's files; `writing` if it changes them."""

    async def work(target: Target) -> ResultT:
        async with one_vehicle(target, writing=writing) as session:
            return await function(session)

    return run(args, work, component)


@asynccontextmanager
async def one_vehicle(target: Target, *, writing: bool) -> AsyncIterator[Session]:
    """Give the vehicle's files to a command; print a note if the user may have meant another vehicle, and the
    reason if it waits.

    Raises:
        UsageError: with `writing`, if the user may have. Also as Target.session.
    """
    async with target.session(writing=writing) as session, waits_told(session, say):
        if writing:
            await session.require_changeable(ON_COMMAND_LINE)
            yield session
            return
        async with session.noting_others(say, ON_COMMAND_LINE):
            yield session


async def until_interrupted(function: Callable[[], Coroutine[Any, Any, ResultT]]) -> ResultT:
    """Return the function's result.

    Raises:
        KeyboardInterrupt: SIGINT or SIGTERM arrived first; the function was cancelled and has cleaned up.
        MavftpfsError, OSError: the function's own.
    """
    results: list[ResultT] = []
    with trio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
        async with plain_nursery() as nursery:

            async def watch() -> None:
                async for _ in signals:
                    nursery.cancel_scope.cancel()

            nursery.start_soon(watch)
            results.append(await function())
    if not results:
        raise KeyboardInterrupt
    return results[0]


STDIN = STDOUT = "-"


@contextmanager
def _on_interrupt(line: Callable[[], str]) -> Iterator[None]:
    """Print a line about the finished part when Ctrl-C ends the body."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"interrupted: {line()}")
        raise


def _name(path: bytes) -> str:
    return printable(os.fsdecode(path))


# -- sync, get and cat ----------------------------------------------------------------------------


def sync(args: Args) -> int:
    """Download the vehicle's logs into a local directory, or compare those that are there."""
    component, place = None, None
    if args.place is not None:
        (place,), component = names.parse_paths([args.place])
    since = None if args.since is None else parse_date(args.since, datetime.now(), "--since")
    selection = Selection(args.newest, since, tuple(args.include), tuple(args.exclude))
    request = logs.SyncRequest(Path(args.local), place, selection, args.dry_run)
    if args.watch:
        return watching.watch(args, request, lambda work: run(args, work, component))
    if args.command is not None:
        raise UsageError("--exec goes with --watch")
    outcome = download.Outcome()
    error: MavftpfsError | None = None

    async def work(downloads: download.Downloads) -> None:
        await (logs.check if args.check else logs.sync)(downloads, request)

    try:
        _download(args, outcome, work, component)
    except MavftpfsError as exc:
        if not outcome.wanted and not outcome.here:
            raise
        error = exc
    _print_outcome(args, outcome)
    _say_what_is_not_proven(outcome)
    if error is not None:
        say(f"{error}; {_here(outcome)}" if not args.check else str(error))
        return max(exit_code_for(error), ExitCode.INCOMPLETE)
    if outcome.differing:
        return ExitCode.USAGE
    return ExitCode.OK if outcome.complete else ExitCode.INCOMPLETE


def _print_outcome(args: Args, outcome: download.Outcome) -> None:
    if args.check:
        _print_comparison(outcome)
    elif args.dry_run:
        _print_plan(outcome)
    else:
        print(_sync_summary(outcome))


def get(args: Args) -> int:
    """Download files."""
    if args.to == STDOUT:
        raise UsageError("--to - is not a name here; to write files to stdout, use: mavftpfs cat")
    wanted, component = _paths_of(args)
    selection = Selection(include=tuple(args.include), exclude=tuple(args.exclude))
    outcome = download.Outcome()

    async def work(downloads: download.Downloads) -> None:
        into = args.to.endswith("/")
        await downloads.get(wanted, Path(args.to), into=into, recursive=args.recursive, selection=selection)

    _download(args, outcome, work, component)
    _say_what_is_not_proven(outcome)
    return _exit_code(outcome)


def cat(args: Args) -> int:
    """Write files to stdout."""
    wanted, component = _paths_of(args)
    outcome = download.Outcome()

    def write(data: bytes | memoryview) -> None:
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()

    async def take(data: bytes | memoryview) -> None:
        # In a thread, because the reader may be slow, and heartbeats must go on meanwhile.
        await trio.to_thread.run_sync(write, bytes(data), abandon_on_cancel=True)

    async def work(session: Session) -> None:
        fetcher = Fetcher(session, Progress(), args.verify)
        await download.Downloads(fetcher, outcome, _Printed()).cat(wanted, take)

    with_session(args, work, component)
    return _exit_code(outcome)


def _exit_code(outcome: download.Outcome) -> int:
    """Return the exit code for the failures. A missing path has the same code, however many paths were
    given."""
    return max(map(exit_code_for, outcome.failed.values()), default=ExitCode.OK)


class _Printed(download.Reports):
    """Prints a line for each downloaded file, and on stderr the reason why another one is missing."""

    def arrived(self, fetched: Fetched) -> None:
        """See Reports."""
        resumed = f", resumed at {readable_size(fetched.resumed)}" if fetched.resumed else ""
        before = ", here already" if fetched.was_here else resumed
        name = printable(fetched.wanted.name)
        verified = f"verified by {fetched.verified.how}{printable(fetched.kept_words)}"
        print(f"{name}: {readable_size(fetched.size)}{before}, {verified}", flush=True)

    def says(self, line: str) -> None:
        """See Reports."""
        say(line)


def _say_what_is_not_proven(outcome: download.Outcome) -> None:
    for lacking, count in outcome.lacking.items():
        say(f"not verified: {lacking} ({count_files(count)})")


def _download(
    args: Args,
    outcome: download.Outcome,
    function: Callable[[download.Downloads], Coroutine[Any, Any, None]],
    component: int | None,
) -> None:
    """Download files with progress on the screen; Ctrl-C prints how many are here."""
    bar = Progress()

    async def work(session: Session) -> None:
        fetcher = Fetcher(session, bar, args.verify)
        async with followed(session, bar):
            await function(download.Downloads(fetcher, outcome, _Printed()))

    with _on_interrupt(lambda: _here(outcome)), shown(bar):
        with_session(args, work, component)


def _here(outcome: download.Outcome) -> str:
    wanted, here = len(outcome.wanted) + len(outcome.here), len(outcome.fetched) + len(outcome.here)
    if not wanted:
        return "nothing was downloaded yet"
    return f"{here} of {wanted} files are here; the next run resumes where this one stopped"


def _sync_summary(outcome: download.Outcome) -> str:
    new, size = len(outcome.fetched), sum(fetched.size - fetched.resumed for fetched in outcome.fetched)
    verified = [outcome.verified[log.remote] for log in outcome.here if log.remote in outcome.verified]
    proven = sum(not one.lacking for one in verified)
    line = f"{new} new ({readable_size(size)}), {len(outcome.here)} here already"
    line += f" ({proven} verified now)" if proven else ""
    line += f", from {_name(outcome.place)}"
    missing = sum(wanted.remote in outcome.failed for wanted in outcome.wanted)
    if missing:
        line += f"; {missing} not here, the next run resumes"
    return line


def _print_plan(outcome: download.Outcome) -> None:
    for log in outcome.wanted:
        on = f", {readable_size(log.begun)} of it here" if log.begun else ""
        print(f"{printable(log.name)}: {readable_size(log.size)}{on}")
    left = sum(log.size - log.begun for log in outcome.wanted)
    print(
        f"would download {len(outcome.wanted)} ({readable_size(left)}), {len(outcome.here)} here already, "
        f"from {_name(outcome.place)}"
    )


def _print_comparison(outcome: download.Outcome) -> None:
    differing = outcome.differing
    for log in outcome.here:
        if log.remote in differing:
            print(f"{printable(log.name)} differs: {differing[log.remote]}")
    unproven = sum(outcome.lacking.values())
    same = len(outcome.verified) - len(differing) - unproven
    parts = [f"{same} the same", f"{len(differing)} differ"]
    parts += [f"{unproven} not verified"] if unproven else []
    print(f"{', '.join(parts)}, {len(outcome.wanted)} not here, from {_name(outcome.place)}")


# -- put and names --------------------------------------------------------------------------------


def put(args: Args) -> int:
    """Upload files to the vehicle."""
    if Path(STDIN) not in args.locals:
        return _put(args, args.locals)
    if len(args.locals) > 1 or args.recursive:
        raise UsageError("stdin (-) is uploaded alone; leave out -r and the other files")
    with _spooled_stdin() as local:
        return _put(args, [local])


@contextmanager
def _spooled_stdin() -> Iterator[Path]:
    """Copy stdin to a file, because its size must be known first, and it may be sent twice.

    If the body fails, no other copy of the bytes exists. So the file stays, and the error's text names it.
    """
    with TemporaryDirectory(prefix="mavftpfs-") as folder:
        local = Path(folder, "stdin")
        with local.open("wb") as file:
            shutil.copyfileobj(sys.stdin.buffer, file)
        try:
            yield local
        except MavftpfsError as exc:
            directory = recovery_directory("stdin")
            make_private_directory(directory)
            exc.args = (f"{exc}; the bytes from stdin are kept in {shutil.copy(local, directory)}",)
            raise


def _put(args: Args, locals_: Sequence[Path]) -> int:
    (path,), component = names.parse_paths([args.path])
    into = args.path.endswith("/")
    batches = [(local, upload.collect(local, recursive=args.recursive)) for local in locals_]
    bar, through_mount = Progress(), False

    async def work(session: Session) -> None:
        nonlocal through_mount
        through_mount = session.mountpoint is not None

        def tell(remote: bytes, size: int, proof: str) -> None:
            verified = f"verified by {proof}" if proof else "verified"
            print(f"{_name(session.on_vehicle(remote))}: {readable_size(size)}, {verified}", flush=True)

        async with followed(session, bar):
            await upload.put_paths(session, batches, path, bar, tell, into=into)

    def stopped() -> str:
        line = f"{bar.files_done} of {bar.files} files are on the vehicle"
        if not bar.name:
            return line
        return f"{line}; {bar.name} was being uploaded: {_left_there(untouched=bar.untouched)}"

    try:
        with _on_interrupt(stopped), shown(bar):
            with_session(args, work, component, writing=True)
    except NotDelivered as exc:
        if not _caused_by(exc, LinkError, RequestTimeout):
            raise  # a refusal explains itself
        gone = through_mount and _caused_by(exc, LinkClosed)
        kept = "; see what the mount kept: mavftpfs recover" if gone else ""
        exc.args = (f"{exc}; {_left_there(untouched=exc.there is False)}{kept}",)
        raise
    return ExitCode.OK


def _caused_by(error: BaseException | None, *kinds: type[MavftpfsError]) -> bool:
    """Return whether an error, or one of its causes, is of these kinds."""
    return error is not None and (isinstance(error, kinds) or _caused_by(error.__cause__, *kinds))


def _left_there(*, untouched: bool) -> str:
    """Return the words about the path of a file that was not uploaded."""
    return "the vehicle keeps what it had" if untouched else "look at the vehicle's file before you use it"


def rm(args: Args) -> int:
    """Remove files."""
    wanted, component = names.parse_paths(args.paths)
    names.refuse_root(wanted)

    async def remove(session: Session) -> None:
        found = await names.all_matching(session.files, wanted)
        await names.remove_paths(session, found, recursive=args.recursive)

    with_session(args, remove, component, writing=True)
    return ExitCode.OK


def mkdir(args: Args) -> int:
    """Make directories."""
    wanted, component = names.parse_paths(args.paths)
    make = partial(names.make_directories, paths=wanted, parents=args.parents)
    with_session(args, make, component, writing=True)
    return ExitCode.OK


def rmdir(args: Args) -> int:
    """Remove empty directories."""
    wanted, component = names.parse_paths(args.paths)
    with_session(args, partial(names.remove_directories, paths=wanted), component, writing=True)
    return ExitCode.OK


def mv(args: Args) -> int:
    """Rename or move."""
    (*wanted, to), component = names.parse_paths([*args.paths, args.target])
    with_session(
        args,
        partial(names.move_paths, paths=wanted, to=to, into=args.target.endswith("/")),
        component,
        writing=True,
    )
    return ExitCode.OK


# -- what did not arrive --------------------------------------------------------------------------


def recover(args: Args) -> int:
    """List the files that did not reach a vehicle, or upload them to their paths."""
    base = recovered_directory()
    if args.source is None:
        _list_recovered(recovered_below(base))
        return ExitCode.OK
    wanted = recovered_below(base) if args.all else chosen(args.names, base)
    if args.all and not wanted:
        _list_recovered(wanted)
        return ExitCode.OK
    if not wanted:
        raise UsageError("which files? Name them, or give --all; list them with: mavftpfs recover")
    bar = Progress()

    def tell(copy: Recovered, there_already: bool) -> None:
        how = "was there already" if there_already else "is on the vehicle now, verified"
        print(f"{_name(copy.path or b'')} {how}; the copy here is removed", flush=True)

    async def work(session: Session) -> Left:
        async with followed(session, bar):
            return await put_back(session, wanted, bar, tell)

    with shown(bar):
        left = with_session(args, work, writing=True)
    for copy, reason in left.failed:
        say(f"{copy.file}: {reason}")
    for vehicle, count in Counter(copy.vehicle for copy in left.others).items():
        say(
            f"{count_files(count)} of {vehicle} not sent: this is another vehicle; give that one as SOURCE, "
            "or use: mavftpfs put SOURCE FILE PATH"
        )
    if left.failed:
        return ExitCode.UNDELIVERED
    return ExitCode.INCOMPLETE if left.others else ExitCode.OK


def _list_recovered(found: Sequence[Recovered]) -> None:
    """Print the recovered files by directory, and the files that a killed mount left in its own directory."""
    directory = None
    for copy in found:
        if copy.file.parent != directory:
            directory = copy.file.parent
            print(f"{directory}:")
        belongs = "?" if copy.path is None else _name(copy.path)
        belongs += f" on {copy.vehicle}" if copy.vehicle else ""
        at = copy.facts.get("at")
        when = f", {datetime.fromtimestamp(at):%Y-%m-%d %H:%M}" if isinstance(at, int | float) else ""
        reason = copy.hindrance or copy.facts.get("error") or ""
        line = f"  {printable(copy.file.name)} for {belongs}, {readable_size(copy.size)}{when}"
        print(printable(f"{line}: {reason}" if reason else line))
    left = left_by_killed_mounts_line()
    if left:
        print(left)
    elif not found:
        print("no recovered files")


# -- looking --------------------------------------------------------------------------------------


def ls(args: Args) -> int:
    """List directories."""
    wanted, component = _paths_of(args, ["/"])

    async def work(session: Session) -> list[names.Listing]:
        found = await names.all_matching(session.files, wanted)
        return await names.list_paths(session, found, recursive=args.recursive)

    listings = with_session(args, work, component)
    if args.json:
        print(json.dumps([entry for _, entries in listings for entry in entries], indent=2))
        return ExitCode.OK
    listing.show(listings, detailed=args.detailed, units=args.units)
    return ExitCode.OK


def crc(args: Args) -> int:
    """Print checksums that the vehicle computed, in cksum's format: number, two blanks, name."""
    wanted, component = _paths_of(args)

    def tell(path: bytes, number: int) -> None:
        print(f"{number:08x}  {_name(path)}")

    async def work(session: Session) -> None:
        await names.checksum_paths(session, wanted, tell, say)

    with_session(args, work, component)
    return ExitCode.OK
