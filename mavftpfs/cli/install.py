"""`mavftpfs install`: installs man pages, completions, the systemd unit and the udev rule. Layer: cli.

The command installs for one user, or as root for all users, and touches nothing else: `--print` shows the
files, and `--remove` removes the same ones. The man page and the completions are made from the command line's
own parsers.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from pathlib import Path

import mavftpfs
from mavftpfs.cli.completion import SHELLS, commands_of, completion
from mavftpfs.mount.options import option_help
from mavftpfs.shared.errors import EXIT_CODES, ExitCode, UsageError

HELPER = "mount.mavftpfs"
"""The program that mount(8) runs for `-t mavftpfs`."""
MAN_WIDTH = 72
"""Columns of preformatted text in a man page."""


def man_page(parser: argparse.ArgumentParser) -> str:
    """Return mavftpfs(1) in man's own language; the commands as their `--help` shows them."""
    commands = [
        f".SS mavftpfs {name}\n.nf\n{_escaped(_help(command))}\n.fi"
        for name, command in commands_of(parser).items()
    ]
    options = [f".TP\n.B {name}\n{_escaped(text)}" for name, text in option_help().items()]
    exits = [f".TP\n.B {code:d}\n{_escaped(words)}" for code, words in EXIT_CODES.items()]
    page = _data("mavftpfs.1").replace("@VERSION@", mavftpfs.__version__)
    for mark, parts in (("@COMMANDS@", commands), ("@OPTIONS@", options), ("@EXITS@", exits)):
        page = page.replace(mark, "\n".join(parts))
    return page


def _help(command: argparse.ArgumentParser) -> str:
    command.formatter_class = partial(argparse.HelpFormatter, width=MAN_WIDTH)
    return command.format_help()


def _escaped(text: str) -> str:
    """Return lines that man prints as they are."""
    plain = text.strip().replace("\\", r"\e").replace("-", r"\-")
    return re.sub(r"^([.'])", r"\\&\1", plain, flags=re.MULTILINE)


UNITS = ("mavftpfs@.service", "mavftpfs-sync@.service")

SYSTEMD_RUNS = Path("/run/systemd/system")


FOR_ALL = "sudo PIPX_HOME=/opt/pipx PIPX_BIN_DIR=/usr/local/bin pipx install ."
"""Makes a copy of the program that belongs to root, and that all users can run."""

MARK = "# Made by mavftpfs install."
"""A line in installed programs, which distinguishes them from other programs of the same name."""


@dataclass(frozen=True, slots=True)
class Piece:
    """One file to install. text: its content; link: the target of a symbolic link. program: the file is a
    program, and another one's program of that name stays."""

    path: Path
    text: str = ""
    link: Path | None = None
    program: bool = False

    def shown(self) -> str:
        """Return path and content for `--print`."""
        if self.link is not None:
            return f"# {self.path} -> {self.link}\n"
        return f"# {self.path}\n{self.text}"

    def put(self) -> None:
        """Write the file, replacing an older one."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.link is None:
            self.path.write_text(self.text)
            if self.program:
                self.path.chmod(0o755)
        else:
            self.path.unlink(missing_ok=True)
            self.path.symlink_to(self.link)

    def is_there(self) -> bool:
        """Return whether the path exists; a dangling symbolic link counts."""
        return os.path.lexists(self.path)

    def is_others(self) -> bool:
        """Return whether somebody else, such as pipx or a package, put a file at the path."""
        if self.link is not None:
            return self.is_there() and not self.path.is_symlink()
        return self.program and self.is_there() and (self.path.is_symlink() or MARK not in _text(self.path))


def _text(path: Path) -> str:
    return path.read_bytes().decode(errors="replace")


def run(args: argparse.Namespace, parser: argparse.ArgumentParser) -> int:
    """Install, show or remove the files, for this user; as root, for everybody.

    Raises:
        UsageError: a file cannot be written or removed, or users other than root could change the program
            that all run, or could not run it.
    """
    program = own_program()
    everybody = os.geteuid() == 0
    pieces = list(for_everybody(parser, program) if everybody else for_user(parser, program, os.environ))
    if args.print:
        print("\n".join(piece.shown() for piece in pieces), end="")
        return ExitCode.OK
    if everybody and not args.remove:
        check_program(program)
    for piece in pieces:
        if piece.is_others() or (args.remove and not piece.is_there()):
            continue
        try:
            (piece.path.unlink if args.remove else piece.put)()
        except OSError as exc:
            raise UsageError(f"{piece.path}: {exc.strerror}") from exc
        print(f"{'removed' if args.remove else 'wrote'} {piece.path}")
    _tell_systemd(everybody)
    if not args.remove:
        print("\n".join(_hints(everybody)))
    return ExitCode.OK


def own_program() -> Path:
    """Return this program itself, not a link to it, because `--remove` may delete the link."""
    name = sys.argv[0]
    found = name if os.sep in name else shutil.which(name)
    if found is None or not os.access(found, os.X_OK):
        found = shutil.which("mavftpfs") or name
    return Path(os.path.realpath(found))


def check_program(program: Path) -> None:
    """Check that all users can run the program, and that only root can change it.

    Raises:
        UsageError: they cannot, another user can, or the program has no mount.mavftpfs beside it.
    """
    if not program.with_name(HELPER).exists():
        raise UsageError(f"there is no {HELPER} beside {program}; run the mavftpfs of an installation")
    for place in (program, Path(mavftpfs.__file__), Path(os.path.realpath(sys.executable))):
        for path in (place, *place.parents):
            facts = path.stat()
            open_to_all = facts.st_mode & stat.S_IWOTH and not facts.st_mode & stat.S_ISVTX
            if facts.st_uid != 0 or open_to_all:
                raise UsageError(
                    f"{path} can be changed by others than root, but root would run it; install a copy "
                    f"of its own: {FOR_ALL}"
                )
            if not facts.st_mode & (stat.S_IXOTH if path.is_dir() else stat.S_IROTH):
                raise UsageError(
                    f"{path} is closed to other users (mode {stat.S_IMODE(facts.st_mode):04o}), so they "
                    f"could not run {program}; install a copy for all users: {FOR_ALL}"
                )


def for_user(
    parser: argparse.ArgumentParser, program: Path, environment: Mapping[str, str]
) -> Iterator[Piece]:
    """Yield the files for one user."""
    home = Path(environment.get("HOME") or os.path.expanduser("~"))
    data = Path(environment.get("XDG_DATA_HOME") or home / ".local/share")
    config = Path(environment.get("XDG_CONFIG_HOME") or home / ".config")
    yield Piece(data / "man/man1/mavftpfs.1", man_page(parser))
    yield from _completions(parser, data, config / "fish/completions")
    for unit in UNITS:
        yield Piece(config / "systemd/user" / unit, _unit(program, unit))


def for_everybody(parser: argparse.ArgumentParser, program: Path) -> Iterator[Piece]:
    """Yield the files that root installs."""
    data = Path("/usr/local/share")
    yield Piece(data / "man/man1/mavftpfs.1", man_page(parser))
    yield Piece(data / "man/man8/mount.mavftpfs.8", _data("mount.mavftpfs.8"))
    yield from _completions(parser, data, data / "fish/vendor_completions.d")
    for unit in UNITS:
        yield Piece(Path("/usr/local/lib/systemd/user", unit), _unit(program, unit))
    yield Piece(Path("/etc/udev/rules.d/70-mavftpfs.rules"), _data("70-mavftpfs.rules"))
    yield Piece(Path("/sbin", HELPER), link=program.with_name(HELPER))
    caller = f'#!/bin/sh\n{MARK}\nexec {shlex.quote(str(program))} "$@"\n'  # for mount -t fuse.mavftpfs
    yield Piece(Path("/usr/local/bin/mavftpfs"), caller, program=True)


def _completions(parser: argparse.ArgumentParser, data: Path, fish: Path) -> Iterator[Piece]:
    places = {
        "bash": data / "bash-completion/completions/mavftpfs",
        "zsh": data / "zsh/site-functions/_mavftpfs",
        "fish": fish / "mavftpfs.fish",
    }
    for shell in SHELLS:
        yield Piece(places[shell], completion(parser, shell))


def _data(name: str) -> str:
    return files("mavftpfs").joinpath("data", name).read_text()


def _unit(program: Path, name: str) -> str:
    """Return a unit's text; systemd reads % as a specifier, and needs quotes around blanks."""
    command = str(program).replace("%", "%%")
    return _data(name).replace("@MAVFTPFS@", f'"{command}"' if " " in command else command)


def _tell_systemd(everybody: bool) -> None:
    """Make systemd and udev read the changed files, if these programs are installed."""
    if not SYSTEMD_RUNS.is_dir():
        return
    manager = () if everybody else ("--user",)
    commands = [("systemctl", *manager, "daemon-reload")]
    if everybody:
        commands.append(("udevadm", "control", "--reload"))
    for command in commands:
        if shutil.which(command[0]):
            subprocess.run(command, check=False, capture_output=True, timeout=30)


def _hints(everybody: bool) -> Iterator[str]:
    yield "systemctl --user start mavftpfs@ttyACM0 mounts /dev/ttyACM0 on ~/drone-ttyACM0"
    yield "systemctl --user start mavftpfs-sync@udpin:0.0.0.0:14550 downloads logs into ~/drone-logs"
    yield "at boot, without a login: `enable` in place of `start`, and sudo loginctl enable-linger $USER"
    yield "bash completes commands in new shells, if the package bash-completion is installed"
    if everybody:
        yield "udev mounts an autopilot that is plugged in there"
    else:
        yield "zsh looks for completions in $fpath: add ~/.local/share/zsh/site-functions"
        yield "as root: a udev rule that mounts what is plugged in, and mount -t mavftpfs"
