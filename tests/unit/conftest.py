"""What tests of the writing tree share. Tier: unit."""

from __future__ import annotations

import pytest

from mavftpfs.cache.tree import Tree
from tests.support.fake_writer import FakeWriter, make_writable


@pytest.fixture
def tree(store: FakeWriter) -> Tree:
    """A tree that writes to the module's own `store` (see fake_writer.card)."""
    return make_writable(store)
