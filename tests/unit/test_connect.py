"""client.connect: every option of the table reaches its user; what a hub calls a program."""

from __future__ import annotations

import os
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from mavftpfs.client.connect import cache_options, connect_options, process_name
from mavftpfs.client.options import Options
from mavftpfs.link.uri import parse_source
from mavftpfs.mount.kernel import presentation
from mavftpfs.mount.options import fuse_words

OTHER: dict[str, Any] = {
    "read_only": True,
    "allow_other": True,
    "uid": 12345,
    "gid": 54321,
    "umask": 0o777,
    "fmask": 0o777,
    "dmask": 0o777,
    "root": b"/fs",
    "read_mode": "burst",
    "when_armed": "ok",
    "local": (),
    "inplace": True,
    "kernel_words": ("noexec",),
}
"""Values that are no default; numbers are made below."""

ELSEWHERE = {"baud", "connect_timeout", "tlog", "forward", "gone", "all"}
"""What is taken from the options themselves; the mount tier has a test of each but the baud rate, which is
in `test_cli`."""


def told(options: Options) -> tuple[Any, ...]:
    """Return what kernel, session and caches are told."""
    return (
        connect_options(options),
        cache_options(options, parse_source("udpin:0.0.0.0:14550")),
        fuse_words(options, "SOURCE"),
        presentation(options),
    )


@pytest.mark.parametrize("name", sorted({field.name for field in fields(Options)} - ELSEWHERE))
def test_every_option_is_passed_on(name: str, tmp_path: Path) -> None:
    value = OTHER.get(name, 77)
    if name == "signing_key":
        value = str(tmp_path / "key")
        (tmp_path / "key").write_bytes(bytes(32))
        (tmp_path / "key").chmod(0o600)
    elif name == "cache_size":
        value = 77 << 20
    assert told(replace(Options(), **{name: value})) != told(Options())


@pytest.mark.parametrize(
    ("argv", "name"),
    [
        (["/usr/bin/mavftpfs", "udpin:0.0.0.0:14550", "drone", "-o", "ro"], "udpin:0.0.0.0:14550 drone"),
        (["/lib/mavftpfs/__main__.py", "ls", "-l", "drone"], "ls drone"),
        (["/home/me/survey.py", "--token", "secret"], "survey.py"),
        (["/home/me/survey/__main__.py"], "survey"),
        (["-c"], "python"),
        ([""], "python"),
        ([], "python"),
    ],
)
def test_what_a_hub_calls_a_program(monkeypatch: pytest.MonkeyPatch, argv: list[str], name: str) -> None:
    monkeypatch.setattr(sys, "argv", argv)
    assert process_name() == f"{name} (process {os.getpid()})"


@pytest.mark.parametrize("words", [("udpin:0.0.0.0:14550",), ("mount", "/dev/ttyACM0")])
def test_a_hub_is_told_where_a_mount_is(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: tuple[str, ...]
) -> None:
    (tmp_path / "drone").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["/usr/bin/mavftpfs", *words, "drone"])
    assert process_name().startswith(f"{' '.join(words)} {tmp_path}/drone (process ")
