"""The commands that start, query and end mounts; `cli` parses their words. Layer: cli."""

from __future__ import annotations

import argparse
import logging
import os
import select
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from mavftpfs.cli import report
from mavftpfs.cli.drawing import changing_line
from mavftpfs.client import control, mountpoint
from mavftpfs.client.mountpoint import DeadMount, canonical, is_ours, vehicles_below
from mavftpfs.client.mounts import PATIENCE, Status, all_statuses, mounts_on, socket_of, statuses_at
from mavftpfs.client.options import at_source, split_words
from mavftpfs.link.uri import LinkSpec, parse_source
from mavftpfs.mount import daemon, places
from mavftpfs.mount.members import Member
from mavftpfs.mount.options import parse_options
from mavftpfs.shared.errors import ExitCode, MountFailed, UsageError
from mavftpfs.shared.options import TABLE, Options
from mavftpfs.shared.private import log_file
from mavftpfs.shared.readable import count_files, readable, readable_time

DELIVERY_PATIENCE = 3600.0
"""Seconds for `umount`: mavftpfs has to upload pending changes first, perhaps over a radio."""
END_PATIENCE = 5.0
"""Seconds for a mount's process to end after its last reply."""
SAY_AGAIN = 10.0
"""Seconds between two lines about uploads, if the lines go to a file."""


# -- mount ----------------------------------------------------------------------------------------


def mount(args: argparse.Namespace) -> int:
    """Mount a vehicle; in the background unless the user asks for the foreground."""
    place = canonical(args.mountpoint)
    options, spec = connection_of(args)
    options = absolute_paths(options)
    mountpoint.check_fuse()
    try:
        mountpoint.check_mountpoint(place)
    except DeadMount as exc:
        if not args.member:  # a member's mount removes the dead one when it is ready itself
            raise DeadMount(_with_what_is_left(str(exc))) from exc
    inside = mountpoint.enclosing_mount(os.path.dirname(place))
    if inside is not None:
        raise MountFailed(f"{place} lies in the mount on {inside[0]}; mount on a directory of this computer")
    work = partial(_serve, args, options, spec, place)
    if args.member:
        return work(_report_failure)
    mounts_on(spec)  # raises if a mount of 0.2 has the link
    if args.foreground or args.debug:
        return work(_report_in_foreground)
    for line in options.gone:  # printed, because in the background only the log would show them
        say(line)
    return daemon.in_background(work)


def connection_of(args: argparse.Namespace) -> tuple[Options, LinkSpec]:
    """Return the parsed options and SOURCE.

    Raises:
        UsageError: one of them is wrong.
    """
    options = parse_options(args.options)
    if os.path.isdir(args.source) and ":" in getattr(args, "mountpoint", ""):
        raise UsageError(f"SOURCE comes first, then the directory: {args.mountpoint} {args.source}")
    spec, options = at_source(parse_source(args.source), options)
    return options, spec


def absolute_paths(options: Options) -> Options:
    """Return the options with absolute local paths, because the background process works in `/`."""
    found = {name: getattr(options, name) for name in TABLE.local_files}
    return replace(options, **{name: os.path.abspath(path) for name, path in found.items() if path})


def _serve(
    args: argparse.Namespace, options: Options, spec: LinkSpec, place: str, report: daemon.Report
) -> int:
    from mavftpfs.client.connect import open_sinks

    try:
        from mavftpfs.mount.life import MountRequest
        from mavftpfs.mount.single import run_mount
    except ImportError as exc:  # libfuse3 was removed or replaced since pyfuse3 was built
        raise MountFailed(f"{exc}; install libfuse3 and mavftpfs anew (pipx reinstall mavftpfs)") from exc

    foreground = args.foreground or args.debug
    _start_logging(options, foreground=foreground, debug=args.debug)
    with open_sinks(options, debug=args.debug, tell=say) as sinks:
        request = MountRequest(args.source, spec, place, options, control=_control_path(place), sinks=sinks)
        if options.all:
            from mavftpfs.mount.supervisor import run_all

            places.check(place)
            return run_all(request, _member_command(args, place), report)
        if not args.member and os.listdir(place):
            say(f"{place} is not empty: its files are hidden until the vehicle is unmounted")
        return run_mount(request, report)


def _member_command(args: argparse.Namespace, place: str) -> Callable[[Member], list[str]]:
    """Return a function that returns the command for mounting one of several vehicles.

    The hub has the endpoints already. Each vehicle's mount writes a raw log of its own.
    """
    own: list[tuple[str, bool]] = []
    for word in split_words(args.options):
        option, equals, value = word.partition("=")
        if equals and option in TABLE.local_files:
            word = f"{option}={os.path.abspath(value)}"  # now, because a background process works in `/`
        if option not in ("all", "forward"):
            escaped = word.replace("\\", "\\\\").replace(",", "\\,")
            own.append((f"-o{escaped}", option == "tlog"))
    shown = ["-d"] if args.debug else ["-f"] if args.foreground else []

    def command(member: Member) -> list[str]:
        mount = [sys.executable, "-m", "mavftpfs", "mount", args.source, os.path.join(place, member.name)]
        target = f"-otarget_system={member.system}"
        words = [f"{word}.{member.name}" if each else word for word, each in own]
        return [*mount, "--member", target, *shown, *words]

    return command


def say(line: str) -> None:
    """Print a line for the person at the terminal."""
    print(f"mavftpfs: {readable(line)}", file=sys.stderr, flush=True)


def _report_failure(code: int, message: str) -> None:
    if code != 0 and message:
        say(message)


def _report_in_foreground(code: int, message: str) -> None:
    if code == 0:
        logging.getLogger("mavftpfs").info("mounted; Ctrl-C unmounts")  # the log has the line, too
    _report_failure(code, message)


def _start_logging(options: Options, *, foreground: bool, debug: bool) -> None:
    level = logging.DEBUG if debug else logging.INFO
    try:
        if foreground:
            daemon.log_to_stderr(level)
        else:
            daemon.log_in_background(log_file(), level)
    except OSError as exc:
        raise UsageError(f"cannot write the log {exc.filename}: {exc.strerror}") from exc
    daemon.warn_of_gone(options)


def _control_path(place: str) -> Path | None:
    try:
        directory = control.usable_directory()
    except control.ControlError as exc:
        logging.getLogger("mavftpfs").warning("%s", exc)
        return None
    return directory / control.socket_name(place)


# -- umount ---------------------------------------------------------------------------------------


def umount(args: argparse.Namespace) -> int:
    """Make a mount's process upload pending changes and unmount. If the process is gone, remove the dead
    mount."""
    return _umount(canonical(args.mountpoint), lazy=args.lazy)


def _umount(place: str, *, lazy: bool) -> int:
    try:
        socket = socket_of(place)
        request = {"command": "umount", "lazy": lazy}
        with changing_line(say, SAY_AGAIN) as show:
            progress = _Delivery(socket, show)
            reply = control.ask(socket, request, timeout=DELIVERY_PATIENCE, meanwhile=progress.look)
    except control.NobodyThere as exc:
        vehicles = vehicles_below(place)
        if not vehicles and not is_ours(place):
            raise MountFailed(_with_what_is_left(f"no vehicle is mounted on {place}")) from exc
        return _umount_all(place, vehicles, lazy=lazy) if vehicles else _umount_unasked(place, lazy=lazy)
    except KeyboardInterrupt:
        say("the mount keeps uploading pending changes, and then ends; see: mavftpfs status")
        return ExitCode.INTERRUPTED
    _wait_for_end(int(reply["pid"]))
    if reply.get("message"):
        say(reply["message"])
    return int(reply["exit_code"])


def _umount_all(place: str, vehicles: list[str], *, lazy: bool) -> int:
    """Unmount all vehicles below a directory where the process that started their mounts was killed."""
    code = max(_umount(path, lazy=lazy) for path in vehicles)
    places.remove(place)
    return code


def _umount_unasked(place: str, *, lazy: bool) -> int:
    """Unmount where the mount's process was killed, or has no socket because no directory can contain one."""
    alive = not mountpoint.is_dead(place)
    mountpoint.unmount(place, lazy=lazy)
    if not alive:
        return _after_a_killed_mount()
    say("the mount cannot be asked; it uploads pending changes by itself, and its log says how that ends")
    return ExitCode.UNDELIVERED


class _Delivery:
    """The progress of a mount that ends. show: shows a line in place of the last one."""

    def __init__(self, socket: Path, show: Callable[[str], None]) -> None:
        self._socket = socket
        self._show = show
        self._explained = False

    def look(self) -> None:
        """Ask the mount about its uploads, and show the answer; called about each second."""
        try:
            status = control.ask(self._socket, {"command": "status"}, timeout=PATIENCE)["status"]
        except control.NobodyThere:
            return  # the mount is just ending
        except control.ControlError as exc:
            self._show(f"{exc}; if it is stopped, `fg` continues it; fusermount3 -uz unmounts without it")
            return
        # A mount that is still in use has pending changes, too, but does not end.
        line = report.delivery_line(status) if status["state"] == "unmounting" else ""
        if line and not self._explained:
            self._explain(status)
        if line:
            self._show(line)

    def _explain(self, status: Status) -> None:
        self._explained = True
        from mavftpfs.mount.drain import DRAIN_LIMIT

        say(
            f"uploading pending changes for up to {readable_time(DRAIN_LIMIT)}; files not uploaded by then "
            f"are saved in {report.recovered_in_mount(status)}"
        )
        say(f"Ctrl-C only stops this command; to save the remaining files here now: kill {status['pid']}")


def _after_a_killed_mount() -> int:
    """Print a line if a killed mount left files that did not reach the vehicle."""
    line = left_by_killed_mounts_line()
    if not line:
        return ExitCode.OK
    say(line)
    return ExitCode.UNDELIVERED


def _with_what_is_left(line: str) -> str:
    """Return a line, followed by the files that killed mounts left."""
    return "; ".join(filter(None, (line, left_by_killed_mounts_line())))


def left_by_killed_mounts_line() -> str:
    """Return a line about the files that killed mounts left, or ""."""
    from mavftpfs.client.undelivered import left_by_killed_mounts

    left = left_by_killed_mounts()
    if not left:
        return ""
    places = ", ".join(sorted({str(data.parent) for data in left}))
    return (
        f"{count_files(len(left))} did not reach the vehicle when a mount was killed; mounting the vehicle "
        f"again moves {'it' if len(left) == 1 else 'them'} from {places} to a recovery directory"
    )


def _wait_for_end(pid: int) -> None:
    """Wait until a process is gone, so that the link is free when `umount` returns."""
    try:
        process = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    try:
        # Readable once the process has ended, even before it is reaped.
        select.select([process], [], [], END_PATIENCE)
    finally:
        os.close(process)


# -- status ---------------------------------------------------------------------------------------


def status(args: argparse.Namespace) -> int:
    """Show the state of one mount, or of all mounts that this user may ask."""
    if args.mountpoint is None:
        fetch = all_statuses
    else:
        inside = mountpoint.enclosing_mount(args.mountpoint)
        place = canonical(args.mountpoint) if inside is None else inside[0]

        def fetch() -> list[Status]:
            return statuses_at(place)

    if args.json:
        report.print_json(fetch, single=args.mountpoint is not None, watch=args.watch)
        return ExitCode.OK
    if args.watch:
        report.watch_status(fetch)
    found = fetch()
    print(*report.all_lines(found), sep="\n")
    unanswered = args.mountpoint is not None and found[0].get("problem")
    return ExitCode.MOUNT_FAILED if unanswered else ExitCode.OK
