"""pymavlink as a ground station, in a process of its own: it downloads the parameters.

    python -m tests.support.station PORT --record FILE [--key HEX]

Listens on the loopback, and prints them as a line of JSON; --record: each frame that came in or went
out, as `tests.support.flown` writes it.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from pathlib import Path

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavftpfs.link.frames import Splitter

VEHICLE = (1, 1)
PATIENCE = 60.0


class RecordedStation(mavutil.mavudp):  # type: ignore[misc]
    """Writes down what it gets and sends."""

    def __init__(self, port: int, record: Path) -> None:
        super().__init__(f"127.0.0.1:{port}", input=True, source_system=255, source_component=190)
        self.record = record.open("w", encoding="ascii")
        self.lock = threading.RLock()
        self.splitter = Splitter(stream=False)

    def recv(self, n: int | None = None) -> bytes:
        data: bytes = super().recv(n)
        if data:
            self.note("<", data)
        return data

    def write(self, buf: bytes) -> None:
        with self.lock:  # two threads send: a frame is noted and sent before the next one is
            self.note(">", bytes(buf))
            super().write(buf)

    def note(self, mark: str, data: bytes) -> None:
        with self.lock:
            for frame in Splitter(stream=False).feed(data):
                print(mark, frame.data.hex(), file=self.record, flush=True)


def beat(station: RecordedStation, stop: threading.Event) -> None:
    """Send heartbeats until told to stop."""
    own = dialect.MAVLink(None, 255, 191)  # a component of its own: pymavlink's counter is not thread-safe
    while not stop.wait(0.5):
        station.write(own.heartbeat_encode(6, 8, 0, 0, 0).pack(own))


def parameters(station: RecordedStation) -> dict[str, float]:
    """Download all parameters, and ask again for what is missing, as ground stations do."""
    station.mav.param_request_list_send(*VEHICLE)
    found: dict[int, tuple[str, float]] = {}
    count, deadline = 1, time.monotonic() + PATIENCE
    while len(found) < count and time.monotonic() < deadline:
        message = station.recv_match(type="PARAM_VALUE", blocking=True, timeout=2)
        if message is None:
            for number in [number for number in range(count) if number not in found][:10]:
                station.mav.param_request_read_send(*VEHICLE, b"", number)
            continue
        count = message.param_count
        found[message.param_index] = (message.param_id, message.param_value)
    return dict(found.values())


def main() -> int:
    """Work as the arguments say."""
    parser = argparse.ArgumentParser()
    parser.add_argument("port", type=int)
    parser.add_argument("--record", type=Path, required=True)
    parser.add_argument("--key", type=bytes.fromhex)
    args = parser.parse_args()
    station = RecordedStation(args.port, args.record)
    if args.key is not None:
        station.setup_signing(args.key, sign_outgoing=True)
    print("ready", flush=True)
    assert station.wait_heartbeat(timeout=PATIENCE) is not None
    stop = threading.Event()
    beating = threading.Thread(target=beat, args=(station, stop))
    if args.key is None:
        beating.start()
    found = parameters(station)
    stop.set()
    if args.key is None:
        beating.join()
    print(json.dumps(found), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
