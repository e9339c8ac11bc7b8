"""Draws README's pictures: scripts/pictures [FOLDER] makes demo.svg and status.svg there (docs/pictures).

The commands run for real, in a pseudo-terminal of 100 columns. What they print goes through a small model of
a terminal and becomes an SVG.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.text import Text

from tests.mount.conftest import Field
from tests.support.terminal import Terminal

COLUMNS, ROWS = 100, 50
FOLDER = Path(__file__).parents[2] / "docs" / "pictures"
PATIENCE = 90.0
"""Seconds for each command."""

_CONTROL = re.compile(r"\x1b\[([0-9;?]*)([A-Za-z])|\r|\n")
_MAVFTPFS = [sys.executable, "-m", "mavftpfs"]


def in_terminal(command: Sequence[str]) -> str:
    """Return everything a command writes to a terminal, which it must end well with."""
    terminal = Terminal(command, COLUMNS, ROWS)
    code = terminal.finish(PATIENCE)
    if code:
        raise RuntimeError(f"{' '.join(command)} ended with {code}: {terminal.raw[-500:]}")
    return terminal.raw


def screen(output: str) -> list[str]:
    """Return the lines that stand on a terminal in the end, with their colours.

    Knows what rich's live displays do: they go up some lines, erase these, and print them again from their
    beginning.
    """
    lines, row, done = [""], 0, 0
    for match in _CONTROL.finditer(output):
        lines[row] += output[done : match.start()]
        done = match.end()
        if match[0] == "\n":
            row += 1
            if row == len(lines):
                lines.append("")
        elif match[2] == "A":
            row = max(row - int(match[1] or 1), 0)
        elif match[2] == "K":
            lines[row] = ""
        elif match[2] == "m":
            lines[row] += match[0]
    lines[row] += output[done:]
    return lines


def draw(lines: Sequence[str], title: str, path: Path) -> None:
    """Write lines of a terminal as an SVG."""
    with open(os.devnull, "w") as nowhere:
        console = Console(record=True, width=COLUMNS, file=nowhere, force_terminal=True)
        console.print(Text.from_ansi("\n".join(lines).strip("\n"), no_wrap=True))
        path.write_text(console.export_svg(title=title, unique_id=path.stem))


def draw_demo(path: Path) -> None:
    """Draw the tour from mounting to the edited file."""
    lines = screen(in_terminal([*_MAVFTPFS, "demo"]))
    plain = [Text.from_ansi(line).plain for line in lines]
    first = next(number for number, line in enumerate(plain) if line.startswith("$ mavftpfs"))
    last = max(number for number, line in enumerate(plain) if "byte for byte" in line)
    draw(lines[first : last + 1], "scripts/demo", path)


def draw_status(path: Path) -> None:
    """Draw `mavftpfs status` while a log is copied over a radio."""
    link = ("--rate", "40000", "--delay", "0.03", "--jitter", "0.01", "--loss", "0.02")
    with tempfile.TemporaryDirectory(prefix="mavftpfs-pictures-") as name:
        field = Field(Path(name))
        try:
            card = field.local("card")
            log = Path("fs/microsd/log/2026-11-20/10_32_15.ulg")
            (card / log.parent).mkdir(parents=True)
            (card / log).write_bytes(os.urandom(400_000))
            mount = field.mount(field.sim(card, "px4", link).source)
            with mount.started("cp", mount.path / log, "/dev/null"):
                time.sleep(5)
                shown = in_terminal([*_MAVFTPFS, "status", str(mount.path)])
        finally:
            field.close()
    shown = shown.replace(str(mount.path), "/home/me/drone")
    draw(["$ mavftpfs status ~/drone", *shown.split("\r\n")], "mavftpfs status", path)


def main(argv: Sequence[str]) -> int:
    """Draw both."""
    folder = Path(argv[0]) if argv else FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in (("demo.svg", draw_demo), ("status.svg", draw_status)):
        make(folder / name)
        print(folder / name)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
