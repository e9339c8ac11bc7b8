"""What mount, umount and status do; `cli` parses the words. Layer: top."""

from __future__ import annotations

import argparse
import logging
import os
import select
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from mavftpfs import control, daemon
from mavftpfs import mountpoint as mounting
from mavftpfs.exits import ExitCode, MountFailed
from mavftpfs.fuse.options import MountOptions, parse_options, split_words, with_root
from mavftpfs.link.uri import LinkSpec, parse_source
from mavftpfs.mountpoint import canonical, check_fuse, check_mountpoint, is_ours, unmount
from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.readable import readable

STATUS_PATIENCE = 10.0
DELIVERY_PATIENCE = 3600.0
"""Seconds for `umount`: what is held has to travel first, perhaps over a radio."""
END_PATIENCE = 5.0
"""Seconds for a mount's process to end after its last word."""

_PATH_OPTIONS = ("cache_dir", "signing_key", "log_file", "trace", "tlog")


# -- mount ----------------------------------------------------------------------------------------


def mount(args: argparse.Namespace) -> int:
    """Mount; in the background unless told otherwise."""
    words = list(split_words(args.options))
    if "remount" in words:
        return remount(canonical(args.mountpoint), words)
    options, spec = connection_of(args)
    options = absolute_paths(options)
    mountpoint = canonical(args.mountpoint)
    check_fuse()
    check_mountpoint(mountpoint)
    work = partial(_serve, args, options, spec, mountpoint)
    if args.foreground or args.debug:
        return work(_report_in_foreground)
    return daemon.in_background(work)


def remount(mountpoint: str, words: list[str]) -> int:
    """Do what `mount -o remount` asks for: make a mount read-only, or writable again.

    mount(8) adds the options that the mount has, and those of fstab; only ro and rw can change.

    Raises:
        MountFailed: no vehicle is mounted there, it was mounted with ro, or the kernel refuses.
    """
    if not is_ours(mountpoint):
        raise MountFailed(f"no vehicle is mounted on {mountpoint}")
    wanted = [word for word in words if word in ("ro", "rw")]
    if not wanted:
        raise UsageError("remount changes only ro and rw; for other options unmount and mount anew")
    read_only = wanted[-1] == "ro"
    if not read_only and _status_of(mountpoint).get("read_only"):
        raise MountFailed(f"{mountpoint} was mounted with ro: unmount it, and mount it without")
    mounting.remount(mountpoint, read_only=read_only)
    return ExitCode.OK


def connection_of(args: argparse.Namespace) -> tuple[MountOptions, LinkSpec]:
    """Return the parsed options and SOURCE.

    Raises:
        UsageError: one of them is wrong.
    """
    options = parse_options(args.options)
    spec = parse_source(args.source)
    options = with_root(options, spec.subtree)
    return options, spec if options.baud is None else replace(spec, baud=options.baud)


def absolute_paths(options: MountOptions) -> MountOptions:
    """Return the options with local paths absolute: the background process works in `/`."""
    found = {name: getattr(options, name) for name in _PATH_OPTIONS}
    return replace(options, **{name: os.path.abspath(path) for name, path in found.items() if path})


def _serve(
    args: argparse.Namespace, options: MountOptions, spec: LinkSpec, mountpoint: str, report: daemon.Report
) -> int:
    from mavftpfs.compose import open_sinks
    from mavftpfs.mount import MountRequest, run_mount

    foreground = args.foreground or args.debug
    _start_logging(options, foreground=foreground, debug=args.debug)
    with open_sinks(options, debug=args.debug) as sinks:
        request = MountRequest(
            args.source, spec, mountpoint, options, control=_control_path(mountpoint), sinks=sinks
        )
        return run_mount(request, report)


def _report_in_foreground(code: int, message: str) -> None:
    if code == 0:
        logging.getLogger("mavftpfs").info("mounted; Ctrl-C unmounts")
    elif message:
        print(f"mavftpfs: {readable(message)}", file=sys.stderr)


def _start_logging(options: MountOptions, *, foreground: bool, debug: bool) -> None:
    level = logging.DEBUG if debug else logging.INFO
    try:
        if options.log_file is not None:
            daemon.log_to_file(options.log_file, level)
        elif foreground:
            daemon.log_to_stderr(level)
        else:
            daemon.log_in_background(control.own_directories()[-1] / "mavftpfs.log", level)
    except OSError as exc:
        raise UsageError(f"cannot write the log {exc.filename}: {exc.strerror}") from exc


def _control_path(mountpoint: str) -> Path | None:
    try:
        directory = control.usable_directory(control.own_directories())
    except control.ControlError as exc:
        logging.getLogger("mavftpfs").warning("%s", exc)
        return None
    return directory / control.socket_name(mountpoint)


# -- umount and status ----------------------------------------------------------------------------


def umount(args: argparse.Namespace) -> int:
    """Have a mount's process deliver and unmount; a mount whose process is gone is just taken away."""
    mountpoint = canonical(args.mountpoint)
    try:
        socket = control.find_socket(mountpoint, control.own_directories())
        request = {"command": "umount", "lazy": args.lazy}
        reply = control.ask(socket, request, timeout=DELIVERY_PATIENCE)
    except control.NobodyThere as exc:
        if not is_ours(mountpoint):
            raise MountFailed(f"no vehicle is mounted on {mountpoint}") from exc
        unmount(mountpoint, lazy=args.lazy)
        return _after_a_killed_mount()
    _wait_for_end(int(reply["pid"]))
    if reply.get("message"):
        print(f"mavftpfs: {reply['message']}", file=sys.stderr)
    return int(reply["exit_code"])


def _after_a_killed_mount() -> int:
    """Nobody delivers what it held: say so."""
    from mavftpfs.farewell import left_by_killed_mounts

    left = left_by_killed_mounts(os.environ)
    if not left:
        return ExitCode.OK
    places = ", ".join(sorted({str(data.parent) for data in left}))
    print(
        f"mavftpfs: {len(left)} file(s) did not reach the vehicle when a mount was killed; they lie "
        f"in {places} until it is mounted again, which moves them to a recovery directory",
        file=sys.stderr,
    )
    return ExitCode.UNDELIVERED


def _wait_for_end(pid: int) -> None:
    """Wait until a process is gone, so that the link is free when `umount` returns."""
    try:
        process = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    try:
        # Readable when it ended, also while nobody has reaped it.
        select.select([process], [], [], END_PATIENCE)
    finally:
        os.close(process)


def status(args: argparse.Namespace) -> int:
    """Show what one mount, or all mounts of this user, are doing."""
    if args.mountpoint is None:
        fetch = all_statuses
    else:
        fetch = partial(_one_status, canonical(args.mountpoint))
    from mavftpfs import report

    if args.json:
        report.print_json(fetch, single=args.mountpoint is not None, watch=args.watch)
    elif args.watch:
        report.watch_status(fetch)
    else:
        report.print_status(fetch())
    return ExitCode.OK


def _one_status(mountpoint: str) -> list[Mapping[str, Any]]:
    return [_status_of(mountpoint)]


def _status_of(mountpoint: str) -> Mapping[str, Any]:
    return _ask_status(control.find_socket(mountpoint, control.own_directories()))


def all_statuses() -> list[Mapping[str, Any]]:
    """Return the status of each living mount; sockets of dead ones are removed."""
    found = []
    for path in control.all_sockets(control.own_directories()):
        try:
            found.append(_ask_status(path))
        except control.NobodyThere:
            path.unlink(missing_ok=True)
    return found


def _ask_status(path: Path) -> Mapping[str, Any]:
    facts: Mapping[str, Any] = control.ask(path, {"command": "status"}, timeout=STATUS_PATIENCE)["status"]
    return facts
