"""pymavlink's FTP client moving one file; run by the Python of the peers' own environment.

    peer_pymavlink.py PORT read|write REMOTE LOCAL [--chunk 239 --window 32]

The steps are those of its own command line (pymavlink/mavftp.py, main), with its defaults unless --chunk and
--window say otherwise. Nothing of the project is imported.
"""

from __future__ import annotations

import argparse
import sys

from pymavlink import mavutil
from pymavlink.mavftp import MAVFTP, FtpError, MAVFTPSettings

LONG = 3600
"""Seconds it may take by itself: its caller has the watch."""


def settings(chunk: int | None, window: int | None) -> MAVFTPSettings:
    """Return the defaults of its command line, or larger packets and a larger window for writing."""
    return MAVFTPSettings(
        [
            ("debug", int, 0),
            ("pkt_loss_tx", int, 0),
            ("pkt_loss_rx", int, 0),
            ("max_backlog", int, 5),
            ("burst_read_size", int, chunk or 80),
            ("write_size", int, chunk or 80),
            ("write_qsize", int, window or 5),
            ("idle_detection_time", float, 3.7),
            ("read_retry_time", float, 1.0),
            ("retry_time", float, 0.5),
        ]
    )


def main() -> int:
    """Say `ready` when connected, wait for a line, work, say `done` or `failed`, wait for a line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("port", type=int)
    parser.add_argument("direction", choices=["read", "write"])
    parser.add_argument("remote")
    parser.add_argument("local")
    parser.add_argument("--chunk", type=int)
    parser.add_argument("--window", type=int)
    args = parser.parse_args()
    master = mavutil.mavlink_connection(f"udpin:127.0.0.1:{args.port}", source_system=250)
    master.wait_heartbeat(timeout=20)
    ftp = MAVFTP(
        master,
        target_system=master.target_system,
        target_component=master.target_component,
        settings=settings(args.chunk, args.window),
    )
    print("ready", flush=True)
    sys.stdin.readline()
    if args.direction == "read":
        answer = ftp.cmd_get([args.remote, args.local])
    else:
        answer = ftp.cmd_put([args.local, args.remote])
    if answer.error_code == FtpError.Success:
        answer = ftp.process_ftp_reply("get" if args.direction == "read" else "put", timeout=LONG)
    good = answer.error_code == FtpError.Success
    print(
        "done" if good else f"failed error {int(answer.error_code)} from {answer.operation_name}", flush=True
    )
    sys.stdin.readline()
    return 0


if __name__ == "__main__":
    sys.exit(main())
