"""client.connect: the options reach kernel, session and caches; what a hub calls a program."""

from __future__ import annotations

import os
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from mavftpfs.client.connect import cache_options, connect_options, process_name
from mavftpfs.link.uri import parse_source
from mavftpfs.mount.kernel import presentation
from mavftpfs.mount.options import fuse_words
from mavftpfs.shared.options import TABLE, Options

VALUES: dict[str, Any] = {"read_only": True, "allow_other": True, "kernel_words": ("noexec",)}
OF_KERNEL = [row.field for row in TABLE.rows if row.of_kernel and row.field != "all"]


@pytest.mark.parametrize("name", ["read_only", *OF_KERNEL, "kernel_words"])
def test_the_kernel_is_told_each_option_that_concerns_it(name: str) -> None:
    told = [
        (fuse_words(options, "SOURCE"), presentation(options))
        for options in (Options(), replace(Options(), **{name: VALUES.get(name, 0o70)}))
    ]
    assert told[0] != told[1]


def test_session_and_caches_get_the_options_as_they_are(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    key.chmod(0o600)
    options = Options(op_deadline=7.0, cache_size=77 << 20, when_armed="ok", signing_key=str(key))
    connected, cached = connect_options(options), cache_options(options, parse_source("/dev/ttyX,57600"))
    for field in fields(Options):
        value = getattr(options, field.name)
        assert getattr(connected, field.name) == getattr(cached, field.name) == value
    assert connected.key == bytes(range(32))
    assert (cached.link_rate, cached.write_armed) == (5760, True)


@pytest.mark.parametrize(
    ("argv", "name"),
    [
        (["/usr/bin/mavftpfs", "udpin:0.0.0.0:14550", "drone", "-o", "ro"], "mavftpfs"),
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
