"""Recordings of real servers, from tests/data."""

from __future__ import annotations

import gzip
import json
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

from mavftpfs.protocol.payload import Payload
from mavftpfs.sim.parameters import HEADER, Parameter

DATA = Path(__file__).parent.parent / "data"


@dataclass
class Step:
    """One attempt of the client: its requests as (time, wire), and the replies that came."""

    name: str
    requests: list[tuple[float, bytes]] = field(default_factory=list)
    replies: list[tuple[float, Payload]] = field(default_factory=list)


def load_recording(name: str) -> list[Step]:
    """Read a recording."""
    with gzip.open(DATA / f"{name}.jsonl.gz", "rt", encoding="utf-8") as lines:
        rows = [json.loads(line) for line in lines]
    steps = []
    for step, group in groupby(rows, key=lambda row: row["step"]):
        steps.append(Step(str(step)))
        for row in group:
            payload = _payload(row)
            if row["dir"] == "request":
                steps[-1].requests.append((row["t"], payload.encode()))
            else:
                steps[-1].replies.append((row["t"], payload))
    return steps


def _payload(row: dict[str, Any]) -> Payload:
    numbers = {key: int(row[key]) for key in Payload._fields if key != "data"}
    return Payload(**numbers, data=bytes.fromhex(row["data"]))


def data_of(step: Step) -> bytes:
    """Return what the ACKs of a step carry."""
    return b"".join(reply.data for _, reply in step.replies if reply.opcode == 128)


def unpacked(packed: bytes) -> list[Parameter]:
    """Parse param.pck: each name lies over the one before it; pad bytes are skipped."""
    params: list[Parameter] = []
    at, last = HEADER.size, b""
    while at < len(packed):
        if packed[at] == 0:
            at += 1
            continue
        kind, flags, lengths = packed[at] & 15, packed[at] >> 4, packed[at + 1]
        start, width = at + 3 + (lengths >> 4), {1: 1, 2: 2, 3: 4, 4: 4}[kind]
        last = last[: lengths & 15] + packed[at + 2 : start]
        at = start + width
        default = packed[at : at + width] if flags else None
        value = packed[start:at]
        params.append(Parameter(last, kind, value, default, misfit=default == value))
        at += width if flags else 0
    return params
