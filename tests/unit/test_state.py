"""The figures on what a reader has to keep in mind."""

from __future__ import annotations

from tests.support.state import Figures, figures_of

MODULE = '''"""Doc."""

LIMIT = 3
BOTH = 1.5, "text"
NAMES = {"a": 1}
ON = True


class Counter:
    """Doc."""

    def __init__(self) -> None:
        self.fixed, self.count, self.table = 1, 0, {}  # a comment

    def step(self) -> None:
        self.count += 1
        self.table["a"] = self.count
        try:
            self.count = 0
        except BaseException:
            raise
'''


def test_what_counts() -> None:
    figures = figures_of(MODULE)
    assert figures == Figures(modules=1, lines=21, code=14, classes=1, changing=2, numbers=2, cancelling=1)
    assert figures.plus(figures).code == 28
