"""The man page and the shells' completions, made of the command line's own parsers. Layer: top."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Mapping

import shtab

import mavftpfs
from mavftpfs.exits import EXIT_CODES
from mavftpfs.fuse.options import HELP, option_names

SHELLS = ("bash", "zsh", "fish")

_PLACES = {
    "source": shtab.FILE,
    "mountpoint": shtab.DIRECTORY,
    "locals": shtab.FILE,
    "local": shtab.DIRECTORY,
    "to": shtab.FILE,
    "directory": shtab.DIRECTORY,
}
"""What an argument of that name is completed with, where it stands for a local file."""


def completion(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return the completion script for `mavftpfs` in one of SHELLS."""
    for each in (parser, *_commands(parser).values()):
        for action in each._actions:
            if action.dest in _PLACES:
                action.complete = _PLACES[action.dest]  # type: ignore[attr-defined]  # shtab's way
    script: str = shtab.complete(parser, shell)
    return script


def man_page(parser: argparse.ArgumentParser) -> str:
    """Return mavftpfs(1) in man's own language."""
    return "\n".join([*_head(), *_command_sections(parser), *_tail()]) + "\n"


def _head() -> Iterator[str]:
    yield f'.TH MAVFTPFS 1 "" "mavftpfs {mavftpfs.__version__}" "User Commands"'
    yield ".SH NAME"
    yield r"mavftpfs \- mount a drone's files (MAVLink FTP: PX4, ArduPilot, MAVSDK) as a local directory"
    yield ".SH SYNOPSIS"
    yield r".B mavftpfs"
    yield r"\fISOURCE MOUNTPOINT\fR [\fB\-o\fR \fIOPTION\fR,...] [\fB\-f\fR] [\fB\-d\fR]"
    yield ".br"
    yield r".B mavftpfs"
    yield r"\fICOMMAND\fR ..."
    yield ".SH DESCRIPTION"
    yield "Makes the memory card of a drone a directory, so that every program works on its files."
    yield "SOURCE says how the vehicle is reached:"
    for source, words in _SOURCES.items():
        yield ".TP"
        yield f".B {_escaped(source)}"
        yield _escaped(words)
    yield ".PP"
    yield r"The same as URLs: udpin://0.0.0.0:14550, serial:///dev/ttyUSB0:57600."
    yield r"\fISOURCE\fB#/remote/dir\fR mounts one directory of the vehicle."


_SOURCES = {
    "udpin:0.0.0.0:14550": "UDP; the vehicle sends to this port of ours",
    "udpout:192.168.4.1:14550": "UDP; we speak first",
    "tcp:192.168.1.10:5760": "TCP; we connect",
    "tcpin:0.0.0.0:5760": "TCP; the vehicle connects",
    "/dev/ttyACM0": "USB cable",
    "/dev/ttyUSB0,57600": "serial port or telemetry radio, with its baud rate",
}


def _command_sections(parser: argparse.ArgumentParser) -> Iterator[str]:
    yield ".SH COMMANDS"
    for name, command in _commands(parser).items():
        yield f".SS mavftpfs {name}"
        yield _escaped(_sentence(command.description or ""))
        yield ".PP"
        yield _escaped(" ".join(command.format_usage().split()).removeprefix("usage: "))
        for action in command._actions:
            if not isinstance(action, argparse._HelpAction) and action.help != argparse.SUPPRESS:
                yield ".TP"
                yield rf"\fB{_escaped(_term(action))}\fR"
                yield _escaped(action.help or "")


def _tail() -> Iterator[str]:
    yield ".SH MOUNT OPTIONS"
    yield r"Behind \fB\-o\fR, with commas between them, also for the commands without a mount."
    for name in option_names():
        yield ".TP"
        yield f".B {_escaped(name)}"
        yield _escaped(HELP[name])
    yield ".SH EXIT STATUS"
    for code, words in EXIT_CODES.items():
        yield ".TP"
        yield f".B {int(code)}"
        yield _escaped(words)
    yield ".SH FILES"
    yield ".TP"
    yield r".I ~/.local/state/mavftpfs/recovered/"
    yield "What could not be delivered to a vehicle."
    yield ".SH SEE ALSO"
    yield ".BR mount.mavftpfs (8),"
    yield ".BR fusermount3 (1),"
    yield ".BR fstab (5)"


def _commands(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found: Mapping[str, argparse.ArgumentParser] = action.choices
            return found
    return {}


def _term(action: argparse.Action) -> str:
    """Return how an argument is written."""
    value = action.metavar if isinstance(action.metavar, str) else ""
    if action.choices is not None and not value:
        value = "{" + ",".join(map(str, action.choices)) + "}"
    if not action.option_strings:
        return value or action.dest
    takes = action.nargs != 0
    return ", ".join(action.option_strings) + (f" {value or action.dest.upper()}" if takes else "")


def _sentence(text: str) -> str:
    return " ".join(text.split())


def _escaped(text: str) -> str:
    """Return a line that man prints as it is."""
    line = " ".join(text.replace("%%", "%").split()).replace("\\", r"\e").replace("-", r"\-")
    return re.sub(r"^([.'])", r"\\&\1", line)
