"""Another FTP client moving one file; run by the Python of the peers' own environment.

    peer.py mavsdk|pymavlink PORT read|write REMOTE LOCAL TIMEOUT [--chunk 239 --window 32]

REMOTE and LOCAL must have the same last part: MAVSDK names the copy after the original. pymavlink takes the
steps of its own command line (pymavlink/mavftp.py, main), with its defaults unless --chunk and --window say
otherwise. What a worker prints is said by `timed`. Nothing of the project is imported.
"""

from __future__ import annotations

import argparse
import os
import posixpath
import re
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

LONG = 3600
"""Seconds it may take by itself: its caller has the watch."""


def timed(timeout: float, move: Callable[[], object]) -> None:
    """Move the file. The last words printed are seconds, seconds of CPU and peak memory in bytes; SIGALRM
    ends a process that has not moved it after `timeout` seconds."""
    signal.setitimer(signal.ITIMER_REAL, timeout)
    cpu, began = time.process_time(), time.monotonic()
    move()
    seconds, spent = time.monotonic() - began, time.process_time() - cpu
    signal.setitimer(signal.ITIMER_REAL, 0)
    (peak,) = re.findall(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
    print("\n", seconds, spent, int(peak) * 1024, flush=True)


def by_mavsdk(args: argparse.Namespace) -> None:
    """Move the file with the MAVSDK library. Failures end the process with their reason."""
    from mavsdk import ComponentType, Configuration, Mavsdk
    from mavsdk.plugins.ftp import Ftp, FtpResult

    ended = threading.Event()
    results: list[FtpResult] = []

    def on_progress(result: FtpResult, _progress: Any, _data: Any) -> None:
        if result != FtpResult.NEXT:
            results.append(result)
            ended.set()

    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    with Mavsdk(configuration) as mavsdk:
        mavsdk.add_any_connection(f"udpin://127.0.0.1:{args.port}")
        system = mavsdk.first_autopilot(20.0)
        if system is None:
            sys.exit("no autopilot found")
        ftp = Ftp(system)

        def move() -> None:
            if args.direction == "read":
                ftp.download_async(args.remote, os.path.dirname(args.local), True, on_progress)
            else:
                ftp.upload_async(args.local, posixpath.dirname(args.remote), on_progress)
            ended.wait()
            if results[0] != FtpResult.SUCCESS:
                sys.exit(FtpResult(results[0]).name)

        timed(args.timeout, move)


def by_pymavlink(args: argparse.Namespace) -> None:
    """Move the file with pymavlink's client. Failures end the process with their reason."""
    from pymavlink import mavutil
    from pymavlink.mavftp import MAVFTP, FtpError, MAVFTPSettings

    settings = MAVFTPSettings(
        [
            ("debug", int, 0),
            ("pkt_loss_tx", int, 0),
            ("pkt_loss_rx", int, 0),
            ("max_backlog", int, 5),
            ("burst_read_size", int, args.chunk or 80),
            ("write_size", int, args.chunk or 80),
            ("write_qsize", int, args.window or 5),
            ("idle_detection_time", float, 3.7),
            ("read_retry_time", float, 1.0),
            ("retry_time", float, 0.5),
        ]
    )
    master = mavutil.mavlink_connection(f"udpin:127.0.0.1:{args.port}", source_system=250)
    master.wait_heartbeat(timeout=20)
    target = {"target_system": master.target_system, "target_component": master.target_component}
    ftp = MAVFTP(master, **target, settings=settings)

    def move() -> None:
        if args.direction == "read":
            answer = ftp.cmd_get([args.remote, args.local])
        else:
            answer = ftp.cmd_put([args.local, args.remote])
        if answer.error_code == FtpError.Success:
            answer = ftp.process_ftp_reply("get" if args.direction == "read" else "put", timeout=LONG)
        if answer.error_code != FtpError.Success:
            sys.exit(f"error {int(answer.error_code)} from {answer.operation_name}")

    timed(args.timeout, move)


def main() -> int:
    """Connect, and move the file."""
    parser = argparse.ArgumentParser()
    parser.add_argument("client", choices=["mavsdk", "pymavlink"])
    parser.add_argument("port", type=int)
    parser.add_argument("direction", choices=["read", "write"])
    parser.add_argument("remote")
    parser.add_argument("local")
    parser.add_argument("timeout", type=float)
    parser.add_argument("--chunk", type=int)
    parser.add_argument("--window", type=int)
    args = parser.parse_args()
    (by_mavsdk if args.client == "mavsdk" else by_pymavlink)(args)
    return 0


if __name__ == "__main__":
    sys.exit(main())
