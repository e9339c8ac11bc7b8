"""The MAVSDK library's own FTP server as a process: a real server that nobody here wrote.

    python -m tests.support.mavsdk_server DIRECTORY udpout://127.0.0.1:PORT

Prints `ready` once it serves, runs until SIGTERM, exits 0.
"""

from __future__ import annotations

import signal
import sys

from mavsdk import Configuration, Mavsdk
from mavsdk.plugins.ftp_server import FtpServer

SYSTEM_ID = 1
COMPONENT_ID = 1


def main() -> int:
    """Serve the directory named on the command line."""
    directory, url = sys.argv[1:]
    signals = {signal.SIGTERM, signal.SIGINT}
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)  # before the library starts its threads
    configuration = Configuration.create_manual(SYSTEM_ID, COMPONENT_ID, True)
    with Mavsdk(configuration) as mavsdk:
        mavsdk.add_any_connection(url)
        server = FtpServer(mavsdk.server_component_by_id(COMPONENT_ID))
        server.set_root_dir(directory)
        print("ready", flush=True)
        signal.sigwait(signals)
    return 0


if __name__ == "__main__":
    sys.exit(main())
