"""The MAVSDK library's FTP client moving one file; run by the Python of the peers' own environment.

    peer_mavsdk.py PORT read|write REMOTE LOCAL

REMOTE and LOCAL must have the same last part: the library names the copy after the original. Nothing of the
project is imported.
"""

from __future__ import annotations

import argparse
import os
import posixpath
import sys
import threading
from typing import Any

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.ftp import Ftp, FtpResult


def main() -> int:
    """Say `ready` when connected, wait for a line, work, say `done` or `failed`, wait for a line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("port", type=int)
    parser.add_argument("direction", choices=["read", "write"])
    parser.add_argument("remote")
    parser.add_argument("local")
    args = parser.parse_args()
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    with Mavsdk(configuration) as mavsdk:
        mavsdk.add_any_connection(f"udpin://127.0.0.1:{args.port}")
        system = mavsdk.first_autopilot(20.0)
        if system is None:
            print("failed no autopilot found", flush=True)
            return 1
        ftp = Ftp(system)
        print("ready", flush=True)
        sys.stdin.readline()
        print(move(ftp, args), flush=True)
        sys.stdin.readline()
    return 0


def move(ftp: Ftp, args: argparse.Namespace) -> str:
    """Move the file and return what to say."""
    ended = threading.Event()
    results: list[FtpResult] = []

    def on_progress(result: FtpResult, _progress: Any, _data: Any) -> None:
        if result != FtpResult.NEXT:
            results.append(result)
            ended.set()

    if args.direction == "read":
        ftp.download_async(args.remote, os.path.dirname(args.local), True, on_progress)
    else:
        ftp.upload_async(args.local, posixpath.dirname(args.remote), on_progress)
    ended.wait()
    return "done" if results[0] == FtpResult.SUCCESS else f"failed {FtpResult(results[0]).name}"


if __name__ == "__main__":
    sys.exit(main())
