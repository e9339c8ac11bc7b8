"""What tests of the writing tree share, and the time they run on. Tier: unit."""

from __future__ import annotations

from pathlib import Path

import pytest

from mavftpfs.cache.tree import Tree
from tests.support.clocks import use_virtual_time
from tests.support.fake_writer import FakeWriter, make_writable

REAL_TIME = ("test_control", "test_kernelnews")
"""Modules with threads and sockets, which virtual time would not wait for."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Have all tests of this tier run so."""
    for item in items:
        is_here = item.path.parent == Path(__file__).parent and item.path.stem not in REAL_TIME
        if is_here:
            use_virtual_time(item)


@pytest.fixture
def tree(store: FakeWriter) -> Tree:
    """A tree that writes to the module's own `store` (see fake_writer.card)."""
    return make_writable(store)
