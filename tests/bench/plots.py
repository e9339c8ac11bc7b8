"""Draws the picture of README and docs/benchmarks.md: scripts/bench plots [--json FILE] [--page FILE].

The picture (SVG) goes beside the JSON file, and is the same for the same file. Its colours can be read on
white and on black; the ground is transparent. `--page` puts the tables of `tables` between the marks there.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from tests.bench import record, tables
from tests.bench.figures import BARE, US, Outcome, Row, row_from_json

STYLE: Any = {
    "svg.hashsalt": "mavftpfs",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": "#808890",
    "axes.labelcolor": "#808890",
    "axes.edgecolor": "#808890",
    "xtick.color": "#808890",
    "ytick.color": "#808890",
    "axes.grid": True,
    "grid.color": "#80889055",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}
COLOURS = ("#2f81f7", "#e3702d", "#3fa45b", "#a371f7", "#c9388f", "#8a8f98", "#b08800")


def plot_peers(rows: Sequence[Row], path: Path) -> None:
    """Draw what part of the link's limit (loopback: of the bare loop) each client reached."""
    names = [name for name in dict.fromkeys(row.client for row in rows) if name != BARE]
    names.sort(key=lambda name: name != US)
    conditions = len({(row.server, row.link) for row in rows})
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8.6, 1.4 + 0.75 * conditions), layout="constrained")
        FigureCanvasSVG(figure)
        for axes, direction in zip(figure.subplots(1, 2, sharey=True), ("read", "write"), strict=True):
            paint_bars(axes, [row for row in rows if row.direction == direction], names)
            axes.set_title(direction, fontsize=10)
        figure.axes[0].invert_yaxis()
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
        figure.savefig(path, format="svg", transparent=True, metadata={"Date": None, "Creator": None})


def paint_bars(axes: Axes, rows: Sequence[Row], names: Sequence[str]) -> None:
    """Draw a group of bars for each server and link."""
    groups = list(dict.fromkeys((row.server, row.link) for row in rows))
    height = 0.84 / max(1, len(names))
    for number, (name, colour) in enumerate(zip(names, COLOURS, strict=False)):
        offset = (number - (len(names) - 1) / 2) * height
        found = {(row.server, row.link): row for row in rows if row.client == name}
        places = [place for place, group in enumerate(groups) if group in found]
        shares = [share_of(found[group]) for group in groups if group in found]
        at = [place + offset for place in places]
        axes.barh(at, shares, height * 0.92, color=colour, label=name)
        for place, group in zip(at, (group for group in groups if group in found), strict=True):
            row = found[group]
            axes.text(share_of(row) + 0.01, place, note_of(row), va="center", fontsize=7)
    axes.set_yticks(
        range(len(groups)),
        [f"{tables.server_name(server)}\n{tables.link_name(link)}" for server, link in groups],
    )
    axes.set_xlim(0, 1.15)
    axes.set_xlabel("share of the limit (loopback: of the bare loop)")
    axes.grid(visible=False, axis="y")


def share_of(row: Row) -> float:
    """Return the length of a bar: none for a client that failed or was cut off."""
    return (reached(row) or 0.0) if row.outcome is Outcome.OK else 0.0


def reached(row: Row) -> float | None:
    """Return the share of the limit, on the loopback of the bare loop; one above 1 counts as 1. If cut off,
    it is an upper bound."""
    share = row.of_bare if row.of_limit is None else row.of_limit
    return None if share is None else min(share, 1.0)


def note_of(row: Row) -> str:
    """Return what stands beside a bar."""
    share = reached(row)
    if row.outcome not in (Outcome.OK, Outcome.TIMEOUT):
        return tables.failure(row.outcome)
    if share is None:
        return "no bare loop to compare with"
    return f"{'< ' if row.at_most else ''}{share:.2f}"


def main(argv: Sequence[str]) -> int:
    """Draw, and fill in the page's tables if asked to."""
    parser = argparse.ArgumentParser(
        prog="scripts/bench plots", description="draw the picture of docs/benchmarks.md"
    )
    parser.add_argument(
        "--json", type=Path, default=record.RESULTS, metavar="FILE", help="what --json wrote before"
    )
    parser.add_argument(
        "--page", type=Path, metavar="FILE", help="put the tables between the marks in this file"
    )
    args = parser.parse_args(argv)
    sections = record.sections(args.json)
    if "mount" not in sections:
        print(f"nothing of `scripts/bench mount` is recorded in {args.json}", file=sys.stderr)
        return 1
    rows = [row_from_json(row) for row in sections["mount"]["results"]["rows"]]
    plot_peers(rows, args.json.with_name("peers.svg"))
    if args.page is not None:
        args.page.write_text(tables.filled_in(args.page.read_text(), sections))
    return 0
