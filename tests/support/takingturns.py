"""Profiles so like one of the others that long tests leave them to the soak."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

ALIKE = frozenset({"spec", "px4-2026", "mavsdk-old", "ardupilot5", "littlefs"})


def taking_turns(profiles: Iterable[str]) -> list[Any]:
    """Return parameters for every profile; some run in the soak only."""
    return [
        pytest.param(profile, marks=pytest.mark.soak if profile in ALIKE else (), id=profile)
        for profile in profiles
    ]
