"""The facts that a mount reports about itself. Layer: client; pure.

A mount builds its status from two plain dictionaries, `Connection.status()` and `Tree.status()`; the keys are
those of `status --json`, which docs/json.md describes. client.mounts asks mounts for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from typing import Any

Facts = Mapping[str, Any]

MOST = 100
"""Entries of each list, which keep a status small. `held` counts all files."""
_TOLD = {"transfers", "errors", "broken", "reads"}
"""Keys of the cache's status that are in the snapshot's own lists."""


def snapshot(connection: Facts, cache: Facts, traffic: float | None) -> dict[str, Any]:
    """Return the facts of a status, JSON-able; bytes, seconds, and bytes per second; None = unknown."""
    vehicle, link = connection["vehicle"], connection["link"]
    moving = link["state"] in ("fine", "lossy")
    return {
        **connection,
        "link": {**link, "rate": traffic},
        "transfers": _transfers(cache, moving=moving, writing=moving and not is_read_only(vehicle)),
        "held": {
            "files": cache.get("files_undelivered", 0),
            "bytes": cache.get("bytes_undelivered", 0),
            "bytes_on_disk": cache.get("bytes_held", 0),
            "errors": dict(islice(cache.get("errors", {}).items(), MOST)),
            "broken": dict(islice(cache.get("broken", {}).items(), MOST)),
        },
        "cache": {key: value for key, value in cache.items() if key not in _TOLD},
    }


def is_read_only(vehicle: Facts) -> bool:
    """Return whether a vehicle is read-only because it is armed."""
    return bool(vehicle["armed"]) and vehicle["when_armed"] == "ro"


def _transfers(cache: Facts, *, moving: bool, writing: bool) -> list[dict[str, Any]]:
    """Return the files that are being read or written; those in flight come before those that wait.

    moving: the vehicle is heard; writing: mavftpfs may write to it.
    """
    found = []
    for read in cache.get("reads", []):
        left, rate = read["size"] - read["done"], cache.get("rate") if moving else None
        eta = round(left / rate, 1) if rate else None
        found.append({"direction": "read", "state": "reading", **read, "rate": rate, "eta": eta})
    for write in cache.get("transfers", []):
        sending = write["sending"] and writing
        found.append(
            {
                "direction": "write",
                "state": "sending" if sending else "waiting",
                "path": write["path"],
                "size": write["size"],
                "done": max(0, write["size"] - write["bytes_left"]),
                "rate": cache.get("write_rate") if sending else None,
                "eta": write["eta"] if writing else None,
                "error": cache.get("errors", {}).get(write["path"]),
            }
        )
    return found[:MOST]


def second_vehicle(status: Facts) -> str:
    """Return the words about a second vehicle with the same system id."""
    system, address = status["vehicle"]["system"], status["link"]["second"]
    return said_of_double(system, address)


def said_of_double(system: int, address: str) -> str:
    """Return the words about an address that uses another vehicle's system id."""
    return (
        f"a second vehicle has the system id {system}, or a router sends frames back: ignored at {address}; "
        "give each vehicle its own id"
    )
