"""Profiles so like one of the others that long tests leave them to the soak."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest

ALIKE = frozenset({"px4-2026", "ardupilot5", "littlefs"})


def taking_turns(profiles: Iterable[str], soak: Collection[str] = ()) -> list[Any]:
    """Return parameters for every profile; some, and those of `soak`, run in the soak only."""
    long = ALIKE | set(soak)
    return [
        pytest.param(profile, marks=pytest.mark.soak if profile in long else (), id=profile)
        for profile in profiles
    ]
