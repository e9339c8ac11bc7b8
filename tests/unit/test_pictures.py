"""What a terminal shows in the end, as the pictures of README need it."""

from __future__ import annotations

import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.support.pictures import draw, in_terminal, screen


def test_lines_follow_each_other() -> None:
    assert screen("one\r\ntwo\r\n") == ["one", "two", ""]


def test_a_live_display_is_shown_as_it_was_last() -> None:
    drawn = "bar 10 %\r\nbar 20 %" + "\r\x1b[2K\x1b[1A\x1b[2K" + "bar 90 %\r\nbar 95 %" + "\r\n$ "
    assert screen(drawn) == ["bar 90 %", "bar 95 %", "$ "]


def test_colours_stay() -> None:
    assert screen("\x1b[32mgood\x1b[0m\r\n\x1b[?25h") == ["\x1b[32mgood\x1b[0m", ""]


def test_a_picture_holds_the_words(tmp_path: Path) -> None:
    path = tmp_path / "one.svg"
    draw(["\x1b[1m$ ls\x1b[0m", "a.txt  b.txt"], "ls", path)
    words = "".join(ElementTree.parse(path).getroot().itertext()).replace("\xa0", " ")
    assert "$ ls" in words
    assert "a.txt  b.txt" in words


def test_a_command_runs_in_a_terminal_and_must_end_well() -> None:
    asked = "import sys; print(sys.stdout.isatty())"
    assert in_terminal([sys.executable, "-c", asked]) == "True\r\n"
    with pytest.raises(RuntimeError, match="ended with 3"):
        in_terminal([sys.executable, "-c", "raise SystemExit(3)"])
