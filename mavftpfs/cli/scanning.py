"""`mavftpfs scan`: prints the components on a link. Layer: cli."""

from __future__ import annotations

import argparse
import json
from functools import partial

from mavftpfs.cli.verbs import run
from mavftpfs.client.scan import Component
from mavftpfs.client.scan import scan as find
from mavftpfs.shared.errors import ExitCode
from mavftpfs.shared.readable import printable

HEADER = "SYSTEM/COMPONENT"


def scan(args: argparse.Namespace) -> int:
    """Print the components that answer on a link, each as soon as it is known."""
    if args.json:
        print(json.dumps(run(args, partial(find, show=lambda entry: None)), indent=2, default=str))
        return ExitCode.OK
    waits_for_first = True

    def show(entry: Component) -> None:
        nonlocal waits_for_first
        if waits_for_first:
            print(f"{HEADER}  WHAT, FIRMWARE, UNIQUE ID, FTP")
            waits_for_first = False
        print(*lines_of(entry), sep="\n", flush=True)

    run(args, partial(find, show=show))
    return ExitCode.OK


def lines_of(entry: Component) -> tuple[str, str]:
    """Return the two lines of a component."""
    address = f"{entry['system']}/{entry['component']}"
    about = [entry["what"]]
    about += [f"firmware {entry['firmware']}"] if entry["firmware"] else []
    about += [f"id {entry['uid']}"] if entry["uid"] else []
    ftp = ", ".join([entry["ftp"], *entry["seen"]])
    width = len(HEADER)
    return printable(f"{address:<{width}}  {', '.join(about)}"), printable(f"{'':<{width}}  FTP: {ftp}")
