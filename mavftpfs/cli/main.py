"""The command line: arguments, exit codes, one-line errors. Layer: cli.

Modules that only one command needs are imported when it runs: a mount in the background should not have rich
or the simulator in memory.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import os
import signal
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

import mavftpfs
from mavftpfs.cli import commands
from mavftpfs.mount.options import option_help
from mavftpfs.shared.errors import SIGNALLED, ExitCode, MavftpfsError, UsageError, exit_code_for
from mavftpfs.shared.readable import readable

_DESCRIPTION = "Mount a drone's files (MAVLink FTP: PX4, ArduPilot, MAVSDK) as a directory."
_FIRST_STEPS = """\
mavftpfs shows the files of a drone (MAVLink FTP) as a directory:

  mavftpfs scan udpin:0.0.0.0:14550             list vehicles on a link
  mavftpfs /dev/ttyACM0 ~/drone                 mount; ls, cp, rsync, vim work
  mavftpfs status ~/drone                       show vehicle, link, transfers
  mavftpfs umount ~/drone                       unmount, upload pending changes
  mavftpfs sync /dev/ttyACM0 ~/logs             download the new logs
  mavftpfs ls -lh /dev/ttyACM0 /APM/LOGS        list, without a mount
  mavftpfs get ~/drone /APM/LOGS/7.BIN          download files, and verify them
  mavftpfs put ~/drone hover.lua /APM/scripts/  upload files, and verify them
  mavftpfs param ~/drone 'BATT*'                print, set, save parameters
  mavftpfs demo                                 take a tour without a drone

All commands and options: mavftpfs --help; of one command: mavftpfs sync --help.
Man page: man mavftpfs (after mavftpfs install). Everything: docs/guide.md.
"""
_SOURCES = """SOURCE: udpin:0.0.0.0:14550, udpout:host:port, tcp:host:port,
tcpin:host:port, /dev/ttyACM0, /dev/ttyUSB0,57600, or the same as a URL;
`#/remote/dir` behind it names a subtree."""


_WIDTH = 79
"""Columns of the list of options."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors are UsageErrors, which `main` prints in one line."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}; try: {self.prog} --help")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return the exit code, and print errors as one line."""
    _open_closed_streams()
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "-d" in words or "--debug" in words
    try:
        code = _run(words)
        print(end="", flush=True)
        return code
    except MavftpfsError as exc:
        return _complain(str(exc), exit_code_for(exc))
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    except BrokenPipeError:
        # `mavftpfs ls ... | head`: the reader is gone, and the interpreter must not try to flush again.
        # The exit code reports a failure, because the command, perhaps a `put`, stopped early.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return SIGNALLED + signal.SIGPIPE
    except Exception as exc:
        if debug:
            raise
        return _complain(f"internal error: {exc!r}; please report it with the output of -d", ExitCode.BUG)


def _open_closed_streams() -> None:
    """Open standard streams that the caller closed (`>&-`). Otherwise sockets would get their numbers."""
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)
            os.dup2(null, number)
            if null != number:
                os.close(null)
            setattr(sys, name, os.fdopen(number, mode))


def _complain(message: str, code: int) -> int:
    print(f"mavftpfs: {readable(message)}", file=sys.stderr)
    return code


def mount_helper() -> int:
    """Run mount.mavftpfs, which mount(8) starts for `-t mavftpfs`; return the exit code."""
    parser = Parser("mount.mavftpfs", description="Mount a vehicle for mount(8); see mavftpfs --help.")
    parser.add_argument("source")
    parser.add_argument("mountpoint")
    _add_options(parser)
    for letter, meaning in (("f", "only check"), ("n", "ignored"), ("s", "ignored"), ("v", "ignored")):
        parser.add_argument(f"-{letter}", action="store_true", help=meaning)
    parser.add_argument("-t", metavar="TYPE", help="ignored")
    try:
        args = parser.parse_args()
        words = [args.source, args.mountpoint, *(f"-o{text}" for text in args.options)]
        options, _ = commands.connection_of(args)
        if options.all:
            raise UsageError(
                "option all cannot be used in /etc/fstab, because the directory is not a mount itself; start "
                "it by a systemd service, or have a line with target_system= for each vehicle"
            )
        if args.f:
            return ExitCode.OK
    except MavftpfsError as exc:
        return _complain(str(exc), exit_code_for(exc))
    return main(["mount", *words])


Run = Callable[[argparse.Namespace], int]


def _run(words: list[str]) -> int:
    name = words[0] if words else ""
    if name in _COMMANDS:
        make_parser, run = _COMMANDS[name]
        # allows `ls SOURCE -l PATH`: parse_args takes no PATH... after an option behind SOURCE
        return run(make_parser(name).parse_intermixed_args(_without_gone_flags(name, words[1:])))
    parser = _top_parser()
    if not words:
        print(_FIRST_STEPS, end="", file=sys.stderr)
        return ExitCode.USAGE
    try:
        args = parser.parse_args(words)
    except UsageError:
        if name.startswith("-") or ":" in name or "/" in name:
            raise
        raise _no_command(name) from None
    if not any(mark in args.source for mark in ":/") and not os.path.isdir(args.source):
        raise _no_command(args.source)
    return commands.mount(args)


_GONE_FLAGS = {
    ("get", "--no-resume"): "to download a file anew, delete it here first",
}
"""Removed flags that are ignored, so that scripts with them still run. Drop the table after 1.0."""


def _without_gone_flags(command: str, words: list[str]) -> list[str]:
    """Return a command's words without removed flags; print a line for each of these."""
    for word in words:
        if (command, word) in _GONE_FLAGS:
            commands.say(f"{word} is gone, and is ignored: {_GONE_FLAGS[command, word]}")
    return [word for word in words if (command, word) not in _GONE_FLAGS]


def _no_command(word: str) -> UsageError:
    near = difflib.get_close_matches(word, _COMMANDS, 1)
    hint = f"did you mean {near[0]}?" if near else "try: mavftpfs --help"
    return UsageError(f"{word!r} is neither a command nor a SOURCE; {hint}")


# -- parsers --------------------------------------------------------------------------------------


def _top_parser() -> Parser:
    parser = Parser(
        "mavftpfs",
        description=_DESCRIPTION,
        epilog=f"commands, each with --help:\n{_all_commands()}\n\n{_sources_and_options()}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("-V", "--version", action="version", version=f"mavftpfs {mavftpfs.__version__}")
    _add_mount_arguments(parser)
    return parser


def _all_commands() -> str:
    return "\n".join(f"  {name:<9}{make(name).description}" for name, (make, _) in _COMMANDS.items())


def _mount_parser(name: str) -> Parser:
    parser = Parser(
        f"mavftpfs {name}",
        description="Mount a vehicle's files.",
        epilog=_sources_and_options(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_mount_arguments(parser)
    return parser


def _add_mount_arguments(parser: Parser) -> None:
    parser.add_argument("source", metavar="SOURCE", help="link to the vehicle, see below")
    parser.add_argument("mountpoint", metavar="MOUNTPOINT", help="existing directory")
    _add_options(parser)
    parser.add_argument("-f", "--foreground", action="store_true", help="stay in the foreground")
    parser.add_argument("--member", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument(
        "-d", "--debug", action="store_true", help="stay in the foreground, and print every payload, decoded"
    )


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-o", dest="options", metavar="OPT,...", action="append", default=[], help="mount options"
    )


def _sources_and_options() -> str:
    return "\n".join(
        [
            _SOURCES,
            "",
            "mount options, as -o ro,cache_size=1G:",
            *(_row(name, text) for name, text in option_help().items()),
        ]
    )


def _row(name: str, text: str) -> str:
    """Return the lines of an option in the list of all."""
    return textwrap.fill(f"{name:<18}{text}", _WIDTH, initial_indent="  ", subsequent_indent=" " * 20)


def _source_parser(name: str, description: str, *, short_help: bool = True) -> Parser:
    parser = Parser(f"mavftpfs {name}", description=description, epilog=_SOURCES, add_help=False)
    help_words = ("-h", "--help") if short_help else ("--help",)
    parser.add_argument(*help_words, action="help", help="show this help and exit")
    parser.add_argument(
        "source", metavar="SOURCE", help="link to the vehicle, see below, or a directory in a mount"
    )
    _add_options(parser)
    parser.add_argument("-d", "--debug", action="store_true", help="print every payload, decoded")
    return parser


_PATH = "path on the vehicle, or an mftp:// URL"
_PATTERN = "path on the vehicle, a pattern in quotes ('/log/*.ulg'), or an mftp:// URL"


def _paths_parser(
    name: str, description: str, meaning: str = _PATH, *, least: str = "+", short_help: bool = True
) -> Parser:
    parser = _source_parser(name, description, short_help=short_help)
    parser.add_argument("paths", metavar="PATH", nargs=least, default=[], help=meaning)
    return parser


def _scan_parser(name: str) -> Parser:
    parser = _source_parser(name, "Show the components that answer on a link.")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _ls_parser(name: str) -> Parser:
    # -h means the same as in ls.
    parser = _paths_parser(name, "List directories of the vehicle.", _PATTERN, least="*", short_help=False)
    parser.add_argument("-l", dest="detailed", action="store_true", help="show sizes and times (UTC)")
    parser.add_argument("-h", dest="units", action="store_true", help="show sizes as 1.2 MB (with -l)")
    parser.add_argument("-R", dest="recursive", action="store_true", help="list the directories below, too")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _sync_parser(name: str) -> Parser:
    parser = _source_parser(name, "Download the vehicle's new logs, the newest first.")
    parser.add_argument("local", metavar="LOCAL", help="local directory, made if it is missing")
    parser.add_argument(
        "--from", dest="place", metavar="PATH", help="log directory of the vehicle (default: search for it)"
    )
    parser.add_argument(
        "--newest", metavar="N", type=_count, help="download only the N newest logs (default: all)"
    )
    parser.add_argument(
        "--since",
        metavar="DATE",
        help="download only logs since DATE: 2026-05-01, 2026-05-01T14:30, today, yesterday, 2h, 3d "
        "(default: all)",
    )
    _add_patterns(parser, "the log directory")
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "-n", "--dry-run", action="store_true", help="print the logs to download, and download nothing"
    )
    instead.add_argument(
        "--check",
        action="store_true",
        help="compare local logs with the vehicle by CRC32, and download nothing; exit code 1 if one differs",
    )
    instead.add_argument(
        "--watch",
        action="store_true",
        help="keep running, and download the new logs of each vehicle after each flight",
    )
    parser.add_argument(
        "--exec",
        dest="command",
        metavar="COMMAND",
        help="run COMMAND for each downloaded log, with the file as its last argument (with --watch)",
    )
    _add_verify(parser)
    return parser


def _count(text: str) -> int:
    if not text.isascii() or not text.isdigit() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of logs")
    return int(text)


def _add_patterns(parser: Parser, source: str) -> None:
    """Add the patterns that choose files; source: the directory at which their paths begin."""
    parser.add_argument(
        "--include",
        metavar="PATTERN",
        action="append",
        default=[],
        help=f"download only files whose name, or path below {source}, matches; * also matches /; may be "
        "repeated (default: all)",
    )
    parser.add_argument(
        "--exclude",
        metavar="PATTERN",
        action="append",
        default=[],
        help="leave out files that match; may be repeated (default: none)",
    )


def _add_verify(parser: Parser) -> None:
    parser.add_argument(
        "--verify",
        choices=("auto", "all", "none"),
        default="auto",
        help="compare with the vehicle's CRC32: auto: files up to 16 MB and resumed ones; all: all files, in "
        "sync also those that are here already; none: resumed files only (default: auto)",
    )


def _get_parser(name: str) -> Parser:
    parser = _paths_parser(name, "Download files, and verify them.", _PATTERN, least="*")
    parser.epilog = (
        "PATH may be a pattern, as '/log/*/*.ulg': its matches go into LOCAL with their directories from the "
        f"first * on. {_SOURCES}"
    )
    parser.add_argument(
        "--to",
        metavar="LOCAL",
        default=".",
        help="local directory (made if it ends in /, or for several files), or new name of one file "
        "(default: .)",
    )
    parser.add_argument("-r", dest="recursive", action="store_true", help="download directories, too")
    _add_patterns(parser, "PATH")
    _add_verify(parser)
    return parser


def _cat_parser(name: str) -> Parser:
    parser = _paths_parser(name, "Write files of the vehicle to stdout.", _PATTERN, least="*")
    _add_verify(parser)
    return parser


def _put_parser(name: str) -> Parser:
    parser = _source_parser(name, "Upload local files, and verify them by size and CRC32.")
    parser.add_argument(
        "locals", metavar="LOCAL", nargs="+", type=Path, help="local file or directory, or - for stdin"
    )
    parser.add_argument(
        "path",
        metavar="PATH",
        help="directory of the vehicle, or the new name of one LOCAL or of stdin; PATH/ is a directory",
    )
    parser.add_argument("-r", dest="recursive", action="store_true", help="upload directories, too")
    return parser


def _rm_parser(name: str) -> Parser:
    parser = _paths_parser(name, "Remove files of the vehicle.", _PATTERN)
    parser.add_argument(
        "-r", dest="recursive", action="store_true", help="remove directories, too, with all below"
    )
    return parser


def _mkdir_parser(name: str) -> Parser:
    parser = _paths_parser(name, "Make directories on the vehicle.")
    parser.add_argument(
        "-p",
        dest="parents",
        action="store_true",
        help="make the directories above, too; existing ones are fine",
    )
    return parser


def _rmdir_parser(name: str) -> Parser:
    return _paths_parser(name, "Remove empty directories of the vehicle.")


def _mv_parser(name: str) -> Parser:
    parser = _paths_parser(name, "Rename files and directories of the vehicle, or move them.")
    parser.add_argument("target", metavar="NEW", help="directory of the vehicle, or the new name")
    return parser


def _crc_parser(name: str) -> Parser:
    return _paths_parser(name, "Print the CRC32s that the vehicle computes.", _PATTERN, least="*")


def _param_parser(name: str) -> Parser:
    parser = _source_parser(name, "Print, set, load, save or compare the vehicle's parameters.")
    parser.add_argument(
        "names",
        metavar="NAME",
        nargs="*",
        default=[],
        help="name to print, or a pattern, as 'BATT*' (default: all); NAME=VALUE: set it",
    )
    parser.add_argument("--changed", action="store_true", help="print only values that are no defaults")
    parser.add_argument("--load", metavar="FILE", help="set the parameters that differ from FILE")
    parser.add_argument(
        "--skip-unknown",
        action="store_true",
        help="leave out names that the vehicle does not know (with --load)",
    )
    parser.add_argument("--save", metavar="FILE", help="save all, for QGroundControl if FILE ends in .params")
    parser.add_argument(
        "--diff",
        metavar="FILE",
        nargs="?",
        const="",
        help="show differences from FILE, or without FILE between the vehicles of a mount with -o all; exit "
        "code 1 if there are any",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("-y", "--yes", action="store_true", help="set without asking")
    return parser


def _umount_parser(name: str) -> Parser:
    parser = Parser(f"mavftpfs {name}", description="Unmount, upload pending changes, close the session.")
    parser.add_argument("mountpoint", metavar="MOUNTPOINT", help="directory where a vehicle is mounted")
    parser.add_argument("-l", "--lazy", action="store_true", help="unmount even if programs use the mount")
    return parser


def _status_parser(name: str) -> Parser:
    parser = Parser(f"mavftpfs {name}", description="Show the state of mounts.")
    parser.add_argument(
        "mountpoint",
        metavar="MOUNTPOINT",
        nargs="?",
        help="mountpoint, or a path inside (default: all mounts that you may ask)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--watch", action="store_true", help="repeat each second")
    return parser


def _hub_parser(name: str) -> Parser:
    parser = Parser(f"mavftpfs {name}", description="Show shared ports, or stop sharing.", epilog=_SOURCES)
    parser.add_argument("source", metavar="SOURCE", nargs="?", help="port to show (default: all)")
    parser.add_argument("--stop", action="store_true", help="end the hub, unless programs use it")
    parser.add_argument("--force", action="store_true", help="end even a hub in use (with --stop)")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    return parser


def _recover_parser(name: str) -> Parser:
    parser = Parser(
        f"mavftpfs {name}",
        description="List files that did not reach a vehicle, or upload them.",
        epilog=_SOURCES,
    )
    parser.add_argument(
        "source", metavar="SOURCE", nargs="?", help="vehicle to upload the files to (default: list them)"
    )
    parser.add_argument("names", metavar="FILE", nargs="*", help="file or directory of the list")
    parser.add_argument("--all", action="store_true", help="upload all files of the list")
    _add_options(parser)
    parser.add_argument("-d", "--debug", action="store_true", help="print every payload, decoded")
    return parser


def _demo_parser(name: str) -> Parser:
    return Parser(f"mavftpfs {name}", description="Take a short tour with a simulated drone.")


def _install_parser(name: str) -> Parser:
    parser = Parser(
        f"mavftpfs {name}",
        description="Install man pages, completions, units and the udev rule.",
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--print", action="store_true", help="show the files, and write nothing")
    what.add_argument("--remove", action="store_true", help="remove these files")
    return parser


def _sim_parser(name: str) -> Parser:
    from mavftpfs.sim.arguments import add_arguments

    parser = Parser(f"mavftpfs {name}", description="Run a simulated vehicle.")
    add_arguments(parser)
    return parser


def whole_parser() -> argparse.ArgumentParser:
    """Return one parser of all commands, for their documentation."""
    parser = argparse.ArgumentParser("mavftpfs", description=_DESCRIPTION)
    parser.add_argument("-V", "--version", action="store_true", help="print the version")
    _add_options(parser)
    commands_of = parser.add_subparsers(metavar="COMMAND")
    for name, (make_parser, _) in _COMMANDS.items():
        made = make_parser(name)
        commands_of.add_parser(
            name, parents=[made], add_help=False, description=made.description, help=made.description
        )
    return parser


def _install(args: argparse.Namespace) -> int:
    from mavftpfs.cli.install import run

    return run(args, whole_parser())


def _scan(args: argparse.Namespace) -> int:
    commands.say(f"scanning {args.source}, which takes some seconds")  # before the modules are loaded
    return _later("cli.scanning", "scan")(args)


def _later(module: str, name: str) -> Run:
    """Return a command that imports its module when it runs."""

    def run(args: argparse.Namespace) -> int:
        command: Run = getattr(importlib.import_module(f"mavftpfs.{module}"), name)
        return command(args)

    return run


_COMMANDS: dict[str, tuple[Callable[[str], Parser], Run]] = {
    "mount": (_mount_parser, commands.mount),
    "umount": (_umount_parser, commands.umount),
    "status": (_status_parser, commands.status),
    "param": (_param_parser, _later("cli.param", "param")),
    "sync": (_sync_parser, _later("cli.verbs", "sync")),
    "scan": (_scan_parser, _scan),
    "ls": (_ls_parser, _later("cli.verbs", "ls")),
    "get": (_get_parser, _later("cli.verbs", "get")),
    "cat": (_cat_parser, _later("cli.verbs", "cat")),
    "put": (_put_parser, _later("cli.verbs", "put")),
    "rm": (_rm_parser, _later("cli.verbs", "rm")),
    "mkdir": (_mkdir_parser, _later("cli.verbs", "mkdir")),
    "rmdir": (_rmdir_parser, _later("cli.verbs", "rmdir")),
    "mv": (_mv_parser, _later("cli.verbs", "mv")),
    "crc": (_crc_parser, _later("cli.verbs", "crc")),
    "hub": (_hub_parser, _later("cli.ports", "hub")),
    "recover": (_recover_parser, _later("cli.verbs", "recover")),
    "sim": (_sim_parser, _later("sim.endpoints", "run")),
    "demo": (_demo_parser, _later("cli.demo", "demo")),
    "install": (_install_parser, _install),
}
