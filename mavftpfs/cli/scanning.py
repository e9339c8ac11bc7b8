"""`mavftpfs scan`: prints the components on a link. Layer: cli."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from functools import partial

from mavftpfs.cli.verbs import run
from mavftpfs.client.scan import Entry
from mavftpfs.client.scan import scan as find
from mavftpfs.shared.errors import ExitCode
from mavftpfs.shared.readable import printable

HEADER = "SYSTEM/COMPONENT", "WHAT", "FIRMWARE", "UNIQUE ID", "FTP"


def scan(args: argparse.Namespace) -> int:
    """Print the components that answer on a link, each as soon as it is known."""
    if args.json:
        print(json.dumps(run(args, partial(find, show=lambda entry: None)), indent=2, default=str))
        return ExitCode.OK
    tabs = not sys.stdout.isatty()
    waits_for_first = True

    def show(entry: Entry) -> None:
        nonlocal waits_for_first
        if waits_for_first:
            print("\t".join(HEADER) if tabs else f"{HEADER[0]}  {', '.join(HEADER[1:])}")
            waits_for_first = False
        for line in lines_of(entry, tabs=tabs):
            print(line, flush=True)

    run(args, partial(find, show=show))
    return ExitCode.OK


def lines_of(entry: Entry, *, tabs: bool) -> Iterator[str]:
    """Yield the lines of a component; in a pipe tabs separate its parts, with `-` for an unknown one."""
    address = f"{entry['system']}/{entry['component']}"
    ftp = ", ".join([entry["ftp"], *entry["seen"]])
    facts = (address, entry["what"], entry["firmware"], entry["uid"], ftp)
    if tabs:
        yield "\t".join("-" if fact is None else printable(fact) for fact in facts)
        return
    about = [printable(entry["what"])]
    about += [f"firmware {entry['firmware']}"] if entry["firmware"] else []
    about += [f"id {entry['uid']}"] if entry["uid"] else []
    width = len(HEADER[0])
    yield f"{address:<{width}}  {', '.join(about)}"
    yield f"{'':<{width}}  FTP: {printable(ftp)}"
