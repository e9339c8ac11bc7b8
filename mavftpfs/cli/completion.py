"""Completions of the command line for bash, zsh and fish. Layer: cli.

shtab writes them from the parsers. What it does not know stands in data/completion.*: that SOURCE MOUNTPOINT
needs no command, that bash cuts a SOURCE at its colons, and the list behind `-o`.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Mapping
from importlib.resources import files

import shtab

from mavftpfs.client.options import Choice
from mavftpfs.mount.options import LOCAL_PATHS, VALUES, option_help

SHELLS = ("bash", "zsh", "fish")

_FILE = {**shtab.FILE, "bash": "_mavftpfs_files"}
_DIRECTORY = {**shtab.DIRECTORY, "bash": "_mavftpfs_directories"}
"""shtab's own for bash lose names with blanks."""
_LIST = {"bash": "_mavftpfs_options", "zsh": "_mavftpfs_options", "fish": "(_mavftpfs_options)"}

_PLACES = {
    "source": _FILE,
    "mountpoint": _DIRECTORY,
    "locals": _FILE,
    "local": _DIRECTORY,
    "to": _FILE,
    **dict.fromkeys(("load", "save", "diff"), _FILE),
    "directory": _DIRECTORY,
    "options": _LIST,
}
"""How arguments are completed by name, if they are not paths on the vehicle."""

_ZSH_BEGINS = "typeset -A opt_args"
"""What follows this in shtab's script is no definition any more."""


def completion(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return the completion script for `mavftpfs` in one of SHELLS."""
    for each in (parser, *commands_of(parser).values()):
        for action in each._actions:
            if action.dest in _PLACES:
                action.complete = _PLACES[action.dest]  # type: ignore[attr-defined]  # shtab's way
    script: str = shtab.complete(parser, shell)
    ours = files("mavftpfs").joinpath("data", f"completion.{shell}").read_text()
    for mark, text in _filling(shell, commands_of(parser)).items():
        ours = ours.replace(mark, text)
    if shell != "zsh":
        return script + ours
    definitions, begins, rest = script.partition(_ZSH_BEGINS)
    rest = rest.replace("compdef _shtab_mavftpfs ", "compdef _mavftpfs_command ")
    return definitions + ours + begins + rest.replace('_shtab_mavftpfs "$@"', '_mavftpfs_command "$@"')


def commands_of(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
    """Return the parsers of the commands by their names."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found: Mapping[str, argparse.ArgumentParser] = action.choices
            return found
    return {}


def _filling(shell: str, commands: Mapping[str, argparse.ArgumentParser]) -> Mapping[str, str]:
    """Return what stands in place of the marks in our part of a script."""
    if shell == "zsh":
        return {"@COMMANDS@": " ".join(commands), "@VALUES@": " \\\n".join(map(_indented, _zsh_specs()))}
    values = [f"{name}={word}" for name, words in _choices().items() for word in words]
    if shell == "bash":
        paths = "|".join(f"{name}=*" for name in LOCAL_PATHS)
        return {"@WORDS@": " ".join(option_help()), "@VALUES@": " ".join(values), "@FILES@": paths}
    described = (shlex.quote(f"{word}\t{text}") for word, text in option_help().items())
    paths = " ".join(f"{name}=" for name in LOCAL_PATHS)
    return {"@WORDS@": " ".join(described), "@VALUES@": " ".join(values), "@FILES@": paths}


def _choices() -> dict[str, tuple[str, ...]]:
    """Return the options that take one of a few words, and these."""
    return {name: value.parse.words for name, value in VALUES.items() if isinstance(value.parse, Choice)}


def _zsh_specs() -> Iterator[str]:
    """Yield the words of each option for zsh's _values."""
    choices = _choices()
    for word, text in option_help().items():
        name, value, _ = word.partition("=")
        said = "".join(f"\\{letter}" if letter in "[]:" else letter for letter in text)
        wanted = (
            f"({' '.join(choices[name])})" if name in choices else "_files" * (name in LOCAL_PATHS) or " "
        )
        yield shlex.quote(f"{name}[{said}]:{name}:{wanted}" if value else f"{name}[{said}]")


def _indented(text: str) -> str:
    return f"    {text}"
