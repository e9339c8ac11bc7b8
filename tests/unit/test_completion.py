"""Completions, asked of the shells themselves: bash and zsh on a terminal, fish by its own command."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from mavftpfs.cli import main as cli
from mavftpfs.cli.completion import SHELLS, completion
from tests.support.terminal import Terminal

ARGV = {"bash": ["bash", "--norc", "--noprofile", "-i"], "zsh": ["zsh", "-f", "-i"]}
START = {
    "bash": "bind 'set show-all-if-ambiguous on'; bind 'set page-completions off'; source {}/_mavftpfs",
    "zsh": "bindkey -e; LISTMAX=1000; fpath=({} $fpath); autoload -U compinit; compinit -u -D",
}
SOURCE = "udpin:0.0.0.0:14550"

Ask = Callable[[str], str]


@pytest.fixture(scope="module", params=SHELLS)
def ask(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ask]:
    """A function that returns what a shell offers, or makes of it, after TAB at the end of a line.

    It works in a directory with `logs one`, `mnt` and `note`.
    """
    shell: str = request.param
    scripts, folder = tmp_path_factory.mktemp("scripts"), tmp_path_factory.mktemp("folder")
    (scripts / "_mavftpfs").write_text(completion(cli.whole_parser(), shell))
    for name in ("logs one", "mnt"):
        (folder / name).mkdir()
    (folder / "note").touch()
    if shell == "fish":
        yield partial(by_fish, scripts / "_mavftpfs", folder)
        return
    terminal = Terminal(ARGV[shell], 150, 100)
    terminal.type(f"cd {folder}; {START[shell].format(scripts)}\r")
    yield partial(by_tab, terminal)
    terminal.end()


def by_tab(terminal: Terminal, line: str) -> str:
    """Press TAB behind a line, then have the line as it is now printed, by putting `echo` before it."""
    begun = len(terminal.raw)
    terminal.type(f"{line}\t\x01echo BEGIN \x05 END$((1+1))\r")
    terminal.read_until(lambda seen: "END2" in seen.raw[begun:])
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]|\r", "", terminal.raw[begun:])
    return text.replace("\\ ", " ")


def by_fish(script: Path, folder: Path, line: str) -> str:
    """Ask fish for the candidates."""
    done = subprocess.run(
        ["fish", "--no-config", "-c", f"source {script}; complete -C '{line}'"],
        cwd=folder,
        env={**os.environ, "HOME": str(folder)},
        capture_output=True,
        text=True,
        timeout=90,
        check=True,
    )
    return done.stdout.replace("\\ ", " ")


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("mavftpfs sy", ["sync"]),
        ("mavftpfs no", ["note"]),
        ("mavftpfs mn", ["mnt"]),
        (f"mavftpfs sync {SOURCE} lo", ["logs one"]),
        (f"mavftpfs sync {SOURCE} --verify ", ["auto", "all", "none"]),
        ("mavftpfs -o ", ["ro", "cache_size=", "target_system="]),
        (f"mavftpfs ls {SOURCE} -o conn", ["connect_timeout="]),
        (f"mavftpfs put {SOURCE} no", ["note"]),
        (f"mavftpfs {SOURCE} mn", ["mnt"]),
        ("mavftpfs umount mn", ["mnt"]),
    ],
)
def test_what_tab_offers(ask: Ask, line: str, offered: list[str]) -> None:
    answer = ask(line)
    for text in offered:
        assert text in answer, answer


@pytest.mark.parametrize("shell", SHELLS)
def test_every_command_is_offered(shell: str) -> None:
    text = completion(cli.whole_parser(), shell)
    assert [name for name in cli._COMMANDS if name not in text] == []
