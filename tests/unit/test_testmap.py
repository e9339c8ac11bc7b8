"""Each promise, fault and rule is held by a test that says so (tests.support.testmap)."""

from __future__ import annotations

from tests.support.testmap import CATALOGUE, NOT_TESTED, keys_held


def test_each_promise_fault_and_rule_is_held_by_a_test() -> None:
    assert set(CATALOGUE) - NOT_TESTED == set(keys_held())
