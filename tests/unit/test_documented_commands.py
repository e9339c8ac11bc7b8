"""The commands that README and the guide show can be parsed, and lead to a link that can be opened."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from mavftpfs.cli import main as cli
from mavftpfs.link.uri import parse_source
from mavftpfs.mount.options import parse_options
from mavftpfs.protocol.url import MftpUrl, parse_url

PROJECT = Path(__file__).parents[2]
PAGES = ("README.md", "docs/guide.md", "docs/benchmarks.md")

BLOCK_LINE = re.compile(r"^    (\S.*)$", re.MULTILINE)
TABLE_ROW = re.compile(r"^\| `(mavftpfs [^`]*)`", re.MULTILINE)
URL = re.compile(r"`(mftp://[^`]+)`")
PLACEHOLDERS = {"SOURCE": "udpin:0.0.0.0:14550", "[PATH...]": "/a", "PATH...": "/a", "LOCAL...": "a"}
"""Placeholders in the guide's table of commands."""


def shown() -> Iterator[str]:
    """Yield every command line of the pages that begins with mavftpfs, without its comment."""
    for page in PAGES:
        text = (PROJECT / page).read_text()
        for line in (*BLOCK_LINE.findall(text), *TABLE_ROW.findall(text)):
            command = line.partition("  #")[0].strip().removeprefix("sudo ").removesuffix(" &&")
            if command.startswith("mavftpfs "):
                yield command


def words_of(command: str) -> list[str]:
    """Return the arguments, with something in the place of each placeholder, and optional ones left out."""
    for mark, value in PLACEHOLDERS.items():
        command = command.replace(mark, value)
    return shlex.split(re.sub(r"\[[^\]]*\]", "", command))[1:]


@pytest.mark.parametrize("command", sorted(set(shown())))
def test_it_can_be_parsed(command: str) -> None:
    words = words_of(command)
    if words == ["--version"]:
        return
    name = words[0] if words[0] in cli._COMMANDS else "mount"
    args = cli._COMMANDS[name][0](name).parse_args(words[words[0] == name :])
    parse_options(getattr(args, "options", []))
    source = getattr(args, "source", "")
    if source and not source.startswith("~/"):
        parse_source(source)


@pytest.mark.parametrize("page", PAGES)
def test_rsync_finds_the_directory_above_its_target(page: str) -> None:
    made = {"~"}
    for line in BLOCK_LINE.findall((PROJECT / page).read_text()):
        command, *words = line.partition("  #")[0].split()
        if command == "mkdir":
            made |= {word.rstrip("/") for word in words}
        if command == "rsync":
            assert words[-1].rstrip("/").rpartition("/")[0] in made


@pytest.mark.parametrize("page", [*PAGES, "docs/library.md", "CHANGELOG.md"])
def test_pip_installs_from_a_clone(page: str) -> None:
    """No registry has the package."""
    installed = re.findall(r"\bpipx? install (?:--\S+ )*('[^']*'|[^\s`]+)", (PROJECT / page).read_text())
    assert all(word.strip("'").startswith(".") for word in installed)


@pytest.mark.parametrize("page", ["docs/guide.md", "mavftpfs/data/mount.mavftpfs.8"])
def test_the_line_for_fstab(page: str) -> None:
    text = (PROJECT / page).read_text().replace("\\-", "-")
    (line,) = re.findall(r"^ *(udpin:\S+ .* 0 0)$", text, re.MULTILINE)
    source, mountpoint, kind, options, _, _ = line.split()
    assert parse_source(source).port == 14550
    assert mountpoint.startswith("/")
    assert kind == "mavftpfs"
    assert parse_options([options]).allow_other


def test_the_urls_that_are_shown_name_a_component() -> None:
    urls = [url for page in PAGES for url in URL.findall((PROJECT / page).read_text())]
    assert len(urls) >= 2
    for url in urls:
        assert parse_url(url) == MftpUrl(100, b"/log")


def test_every_command_has_a_row_in_the_guide() -> None:
    text = (PROJECT / "docs/guide.md").read_text()
    rows = {row.split()[1] for row in TABLE_ROW.findall(text)}
    assert set(cli._COMMANDS) - {"mount"} <= rows
