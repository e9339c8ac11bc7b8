"""Each promise, fault and rule is held by a test that says so (tests.support.testmap)."""

from __future__ import annotations

from tests.support.testmap import CATALOGUE, NOT_TESTED, PROMISES, RULES, held, keys_held


def test_each_promise_fault_and_rule_is_held_by_a_test() -> None:
    assert set(CATALOGUE) - NOT_TESTED == set(keys_held())


def test_there_are_ten_promises_and_all_rules_for_clients() -> None:
    assert (len(PROMISES), len(RULES)) == (10, 39)


def test_marks_of_tests_and_files_are_seen() -> None:
    source = """
pytestmark = [pytest.mark.soak, pytest.mark.holds("promise 1")]
@pytest.mark.holds("rule 14.3", "fault lost")
async def test_it(): ...
@pytest.mark.soak
def test_other(): ...
"""
    assert list(held(source)) == [("", "promise 1"), ("test_it", "rule 14.3"), ("test_it", "fault lost")]
