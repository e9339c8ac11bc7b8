"""Completions of the command line for bash, zsh and fish, which shtab writes from the parsers. Layer: cli."""

from __future__ import annotations

import argparse
from collections.abc import Mapping

import shtab

from mavftpfs.shared.options import TABLE

SHELLS = ("bash", "zsh", "fish")

_PLACES = {
    **dict.fromkeys(("source", "locals", "load", "save", "diff"), shtab.FILE),
    **dict.fromkeys(("mountpoint", "local", "to", "directory"), shtab.DIRECTORY),
}
"""Kinds of completion for arguments that are not paths on the vehicle, by name."""


def completion(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return the completion script for `mavftpfs` in one of SHELLS."""
    for each in (parser, *commands_of(parser).values()):
        for action in each._actions:
            if action.dest in _PLACES:
                action.complete = _PLACES[action.dest]  # type: ignore[attr-defined]  # shtab's way
            if action.dest == "options":  # only here, because a parser that knows choices refuses `ro,uid=7`
                action.choices = [name for row in TABLE.rows for name in row.names]
    script: str = shtab.complete(parser, shell)
    # Where shtab has no answer, files are offered: `SOURCE MOUNTPOINT` needs no command, and bash cuts a
    # SOURCE at its colons, so that shtab loses count.
    match shell:
        case "bash":
            return f"{script}\ncomplete -o bashdefault -o default -F _shtab_mavftpfs mavftpfs\n"
        case "fish":
            return f"{script}\ncomplete -c mavftpfs -n _shtab_mavftpfs_using -F\n"
    return script.replace('_shtab_mavftpfs "$@"', '_shtab_mavftpfs "$@"; (( compstate[nmatches] )) || _files')


def commands_of(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
    """Return the parsers of the commands by their names."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found: Mapping[str, argparse.ArgumentParser] = action.choices
            return found
    return {}
