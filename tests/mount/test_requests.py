"""The exact cost of each command in requests: on a radio each is a round trip that somebody waits for.

Counted by the vehicle, on a link without loss, Terminate and verification included. A number that grows is a
regression; one that shrinks is a reason to look whether a check is missing.
"""

from __future__ import annotations

import re
from collections import Counter

import pytest

from tests.mount.conftest import Field
from tests.support.request_costs import CASES, FIRST, MOUNT, PROFILES, Case, expected
from tests.support.requests import OPTIONS, Cost, Counting, prepare


class Counted:
    """One mount, and what it and the first change cost."""

    def __init__(self, field: Field, profile: str) -> None:
        self.profile = profile
        root = field.local("card")
        prepare(root, profile, CASES)
        vehicle = field.counted_sim(root, profile)
        self.counting = Counting(vehicle, field.prepare(vehicle.source, *OPTIONS))
        self.costs: dict[str, Cost] = {MOUNT: self.counting.start(), FIRST.name: self.counting.run(FIRST)}

    def cost(self, case: Case) -> Cost:
        """Return what a case costs; each runs once."""
        if case.name not in self.costs:
            self.costs[case.name] = self.counting.run(case)
        return self.costs[case.name]


IN_SOAK = ("px4-nuttx", "ardupilot", "ardupilot5", "mavsdk")


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=pytest.mark.soak if name in IN_SOAK else ()) for name in PROFILES],
)
def counted(request: pytest.FixtureRequest, module_field: Field) -> Counted:
    """Each server, mounted once."""
    return Counted(module_field, request.param)


def check(counted: Counted, name: str, cost: Cost) -> None:
    """Compare with the table; a keep-alive per second is bearable while a file is open, more are not."""
    fits = [text for text in expected(counted.profile, name) if is_cost(cost, text)]
    assert fits, cost.text()
    assert cost.keep_alives <= 2 + cost.seconds


def is_cost(cost: Cost, text: str) -> bool:
    """Return whether the requests are these, and repetitions of them, and listings where it was late."""
    if not cost.repeats and not cost.late:
        return cost.text() == text
    extra = Counter(cost.counts)
    extra.subtract(parsed(text))
    more = extra.total()
    return min(extra.values(), default=0) >= 0 and (
        more == cost.repeats or (cost.late and more - extra["list"] <= cost.repeats)
    )


def parsed(text: str) -> dict[str, int]:
    """Return the counts in a line of the table."""
    return {name: int(count) for name, count in re.findall(r"([a-z-]+) (\d+)", text)}


def test_mounting(counted: Counted) -> None:
    check(counted, MOUNT, counted.costs[MOUNT])


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name.replace(" ", "-"))
def test_each_command(counted: Counted, case: Case) -> None:
    check(counted, case.name, counted.cost(case))
