"""`cache_dir=`: what one mount read, the next one of the same vehicle does not read again.

What is kept and believed: tests/unit/test_kept.py.
"""

from __future__ import annotations

import os
import time

from tests.mount.conftest import Field
from tests.support.requests import Counting
from tests.support.trees import content

FILES = {"00000001.BIN": 300_000, "00000002.BIN": 65_536, "LASTLOG.TXT": 3}


def test_a_copy_an_unmount_a_mount_and_a_copy_cost_one_copy_and_the_checksums(field: Field) -> None:
    card, cache = field.local("card"), field.local("cache")
    yesterday = time.time() - 86_400
    for name, size in FILES.items():
        (card / name).write_bytes(content(name, size))
        os.utime(card / name, (yesterday, yesterday))
    vehicle = field.counted_sim(card, "px4")
    for read_already in (False, True):
        mount = field.mount(vehicle.source, f"cache_dir={cache}")
        Counting(vehicle, mount).settle()  # it looks once whether there are parameters
        mark = vehicle.asked()
        for name in FILES:
            mount.run("cmp", card / name, mount.path / name)
        counts = vehicle.cost_since(mark).counts
        assert bool(counts["read"]) is not read_already, counts
        assert mount.unmount() == 0
    assert counts["crc"] >= len(FILES)
