"""The MAVSDK library as a ground station, in a process of its own: telemetry and parameters.

    python -m tests.support.mavsdk_station PORT

Prints `ready`, then a line of JSON on what it got.
"""

from __future__ import annotations

import json
import sys
import threading
import time

from mavsdk import Configuration, Mavsdk
from mavsdk.component_type import ComponentType
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import Telemetry

PATIENCE = 60.0


def main() -> int:
    """Connect, download the parameters, count attitudes."""
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    with Mavsdk(configuration) as mavsdk:
        mavsdk.add_any_connection(f"udpin://127.0.0.1:{sys.argv[1]}")
        print("ready", flush=True)
        system = mavsdk.first_autopilot(PATIENCE)
        assert system is not None, "no autopilot"
        telemetry = Telemetry(system)
        enough, count = threading.Event(), 0

        def on_attitude(*_: object) -> None:
            nonlocal count
            count += 1
            if count >= 10:
                enough.set()

        telemetry.subscribe_attitude_euler(on_attitude)
        began = time.monotonic()
        found = Param(system).get_all_params()
        seconds = time.monotonic() - began
        enough.wait(PATIENCE)
        values = {one.name: one.value for one in found.float_params}
        print(json.dumps({"parameters": values, "attitudes": count, "seconds": seconds}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
