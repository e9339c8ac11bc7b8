"""Completions of the command line for bash, zsh and fish, which shtab writes from the parsers. Layer: cli."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Mapping

import shtab

from mavftpfs.mount.options import option_help
from mavftpfs.shared.options import TABLE

SHELLS = ("bash", "zsh", "fish")

_LIST = {"bash": "_mavftpfs_options", "zsh": "_mavftpfs_options", "fish": "(_mavftpfs_options)"}
_PLACES = {
    **dict.fromkeys(("source", "locals", "load", "save", "diff"), shtab.FILE),
    **dict.fromkeys(("mountpoint", "local", "to", "directory"), shtab.DIRECTORY),
    "options": _LIST,
}
"""Kinds of completion for arguments that are not paths on the vehicle, by name."""

_OPTIONS = {
    "bash": """_mavftpfs_options() { compgen -P "${1%%"${1##*,}"}" -W '@WORDS@' -- "${1##*,}"; }""",
    "zsh": "_mavftpfs_options() { _values -s , 'mount option' @DESCRIBED@; }",
    "fish": "function _mavftpfs_options; "
    "printf (string replace -r '[^,]*$' '' -- (commandline -ct))'%s\\n' @WORDS@; end",
}
"""The functions that complete the list behind `-o`."""


def completion(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return the completion script for `mavftpfs` in one of SHELLS."""
    for each in (parser, *commands_of(parser).values()):
        for action in each._actions:
            if action.dest in _PLACES:
                action.complete = _PLACES[action.dest]  # type: ignore[attr-defined]  # shtab's way
    function = _OPTIONS[shell].replace("@WORDS@", " ".join(_words()))
    function = function.replace("@DESCRIBED@", " ".join(map(shlex.quote, _described())))
    script: str = shtab.complete(parser, shell, preamble=function)
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


def _words() -> Iterator[str]:
    """Yield the words of the list behind `-o`, with their values if those are few words."""
    yield from TABLE.words
    for name, row in TABLE.values.items():
        values = row.type.words if row.type is not None else ()
        yield from (f"{name}={value}" for value in values or ("",))


def _described() -> Iterator[str]:
    """Yield the options for zsh's _values, with the kind of value that follows each."""
    helps = {name: text for names, text in option_help().items() for name in names.split(", ")}
    for name in TABLE.words:
        yield f"{name}[{_plain(helps[name])}]"
    for name, row in TABLE.values.items():
        values = row.type.words if row.type is not None else ()
        follows = f"({' '.join(values)})" if values else "_files" if name in TABLE.local_files else " "
        yield f"{name}[{_plain(helps[name + '='])}]:{name}:{follows}"


def _plain(text: str) -> str:
    return "".join(f"\\{letter}" if letter in "[]:" else letter for letter in text)
