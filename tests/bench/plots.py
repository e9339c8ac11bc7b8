"""Draws what docs/benchmarks.md shows: scripts/bench plots [--json FILE] [--page FILE].

The pictures (SVG) go beside the JSON file, and are the same for the same file. Their colours can be read on
white and on black; the ground is transparent. `--page` puts the tables of `tables` between the marks there.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from tests.bench import record, tables
from tests.bench.figures import BARE, US, Outcome, Row, row_from_json

RESULTS = Path(__file__).parent / "results" / "results.json"

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
MARKERS = "osD^vPX"

Results = list[dict[str, Any]]
"""What `goodput` found: case, share, target and more of each run."""


def draw(path: Path, size: tuple[float, float], paint: Callable[[Figure], None]) -> None:
    """Write one picture."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasSVG(figure)
        paint(figure)
        figure.savefig(path, format="svg", transparent=True, metadata={"Date": None, "Creator": None})


# -- goodput ----------------------------------------------------------------------------------------


def plot_goodput(results: Results, path: Path) -> None:
    """Draw share of the limit against loss, reading and writing, at the middle rate and round trip."""
    rates, rtts = ({run["case"][key] for run in results} for key in ("rate", "rtt"))
    rate, rtt = (sorted(values)[len(values) // 2] for values in (rates, rtts))
    chosen = [run for run in results if (run["case"]["rate"], run["case"]["rtt"]) == (rate, rtt)]

    def paint(figure: Figure) -> None:
        for axes, direction in zip(figure.subplots(1, 2, sharey=True), ("read", "write"), strict=True):
            paint_lines(axes, [run for run in chosen if run["case"]["direction"] == direction])
            axes.set_title(f"{direction}, {rate / 1000:g} kB/s, RTT {rtt * 1000:g} ms", fontsize=10)
        figure.axes[0].set_ylim(0, max(1.05, figure.axes[0].get_ylim()[1]))
        figure.axes[0].set_ylabel("share of the limit")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=7, fontsize=9)

    draw(path, (8.6, 3.6), paint)


def paint_lines(axes: Axes, results: Results) -> None:
    """Draw one line for each profile, and what is to be reached."""
    lines: dict[str, dict[float, float]] = {}
    for run in results:
        loss = run["case"]["loss"] * 100
        lines.setdefault(run["case"]["profile"], {})[loss] = run["share"]
    targets = {run["case"]["loss"] * 100: run["target"] for run in results if run["target"] is not None}
    for (profile, points), colour, marker in zip(lines.items(), COLOURS, MARKERS, strict=False):
        xs = sorted(points)
        ys = [points[x] for x in xs]
        axes.plot(xs, ys, color=colour, marker=marker, markersize=5, label=profile)
    xs = sorted(targets)
    ys = [targets[x] for x in xs]
    axes.plot(xs, ys, color="#808890", linestyle="dashed", linewidth=1, label="target")
    axes.set_xlabel("loss each way, %")


# -- the peers --------------------------------------------------------------------------------------


def plot_peers(rows: Sequence[Row], path: Path) -> None:
    """Draw what part of the link's limit (loopback: of the bare loop) each client reached."""
    names = [name for name in dict.fromkeys(row.client for row in rows) if name != BARE]
    names.sort(key=lambda name: name != US)

    def paint(figure: Figure) -> None:
        for axes, direction in zip(figure.subplots(1, 2, sharey=True), ("read", "write"), strict=True):
            chosen = [row for row in rows if row.direction == direction]
            paint_bars(axes, chosen, names)
            axes.set_title(direction, fontsize=10)
        figure.axes[0].invert_yaxis()
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)

    conditions = len({(row.server, row.link) for row in rows})
    draw(path, (8.6, 1.4 + 0.75 * conditions), paint)


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
    axes.set_xlim(0, max([1.0, *(share_of(row) for row in rows)]) + 0.15)
    axes.set_xlabel("share of the limit (loopback: of the bare loop)")
    axes.grid(visible=False, axis="y")


def share_of(row: Row) -> float:
    """Return the length of a bar: none for a client that failed or was cut off."""
    return (reached(row) or 0.0) if row.outcome is Outcome.OK else 0.0


def reached(row: Row) -> float | None:
    """Return the share of the limit, on the loopback of the bare loop. If cut off, it is an upper bound."""
    return row.of_bare if row.of_limit is None else row.of_limit


def note_of(row: Row) -> str:
    """Return what stands beside a bar."""
    share = reached(row)
    if row.outcome not in (Outcome.OK, Outcome.TIMEOUT):
        return tables.failure(row.outcome)
    if share is None:
        return "no bare loop to compare with"
    return f"{'< ' if row.at_most else ''}{share:.2f}"


# -- the command ------------------------------------------------------------------------------------


def plot_all(sections: dict[str, dict[str, Any]], folder: Path) -> list[Path]:
    """Draw whatever there are results for, and return what was written."""
    written: list[Path] = []
    if "goodput" in sections:
        results: Results = sections["goodput"]["results"]
        written.append(folder / "goodput-loss.svg")
        plot_goodput(results, written[-1])
    if "mount" in sections:
        written.append(folder / "peers.svg")
        plot_peers([row_from_json(row) for row in sections["mount"]["results"]["rows"]], written[-1])
    return written


def main(argv: Sequence[str]) -> int:
    """Draw, and fill in the page's tables if asked to."""
    parser = argparse.ArgumentParser(
        prog="scripts/bench plots", description="draw what docs/benchmarks.md shows"
    )
    parser.add_argument("--json", type=Path, default=RESULTS, metavar="FILE", help="what --json wrote before")
    parser.add_argument(
        "--page", type=Path, metavar="FILE", help="put the tables between the marks in this file"
    )
    args = parser.parse_args(argv)
    sections = record.sections(args.json)
    if not sections:
        print(f"nothing is recorded in {args.json}", file=sys.stderr)
        return 1
    for path in plot_all(sections, args.json.parent):
        print(path)
    if args.page is not None:
        args.page.write_text(tables.filled_in(args.page.read_text(), sections))
    return 0
