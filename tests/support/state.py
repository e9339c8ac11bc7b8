"""Counts what a reader of the code has to keep in mind, package by package: python -m tests.support.state.

The figures are a thermometer and no goal: one object with twenty attributes in place of twenty objects with
one attribute each is no gain.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields
from pathlib import Path

_NO_CODE = frozenset(
    {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
    | {tokenize.ENCODING, tokenize.ENDMARKER}
)


@dataclass(frozen=True, slots=True)
class Figures:
    """The figures of some modules.

    code: lines without blanks, comments and docstrings. changing: attributes of self that are assigned
    outside of __init__. numbers: numeric constants of modules. cancelling: handlers for BaseException or
    Cancelled.
    """

    modules: int = 0
    lines: int = 0
    code: int = 0
    classes: int = 0
    changing: int = 0
    numbers: int = 0
    cancelling: int = 0

    def plus(self, other: Figures) -> Figures:
        """Return the sums."""
        return Figures(*(mine + its for mine, its in zip(astuple(self), astuple(other), strict=True)))


def figures_of(text: str) -> Figures:
    """Return the figures of one module."""
    tree = ast.parse(text)
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    handlers = [node.type for node in ast.walk(tree) if isinstance(node, ast.ExceptHandler) and node.type]
    return Figures(
        modules=1,
        lines=len(text.splitlines()),
        code=len(_code_lines(text, tree)),
        classes=len(classes),
        changing=sum(len(set(_changing(node))) for node in classes),
        numbers=sum(_numbers(node) for node in tree.body),
        cancelling=sum(_is_for_cancellation(ast.unparse(kind)) for kind in handlers),
    )


def _is_for_cancellation(kind: str) -> bool:
    return "BaseException" in kind or "Cancelled" in kind


def _code_lines(text: str, tree: ast.Module) -> set[int]:
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            lines.difference_update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def _changing(owner: ast.ClassDef) -> Iterator[str]:
    """Yield the attributes of self that methods other than __init__ assign, whole or in part."""
    for method in owner.body:
        if isinstance(method, ast.FunctionDef | ast.AsyncFunctionDef) and method.name != "__init__":
            for target in _targets(method):
                for part in ast.walk(target):
                    match part:
                        case ast.Attribute(value=ast.Name(id="self"), attr=name):
                            yield name


def _targets(method: ast.AST) -> Iterator[ast.expr]:
    for node in ast.walk(method):
        match node:
            case ast.Assign(targets=targets):
                yield from targets
            case ast.AugAssign(target=target) | ast.AnnAssign(target=target):
                yield target


def _numbers(node: ast.stmt) -> int:
    """Return how many numeric constants a statement of a module assigns."""
    value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
    if value is None or any(isinstance(part, ast.Call | ast.Dict) for part in ast.walk(value)):
        return 0
    return sum(map(_has_number, value.elts if isinstance(value, ast.Tuple) else [value]))


def _has_number(value: ast.expr) -> bool:
    return any(
        isinstance(part, ast.Constant) and type(part.value) in (int, float) for part in ast.walk(value)
    )


def main(root: Path) -> None:
    """Print one line for each package below `root`, and their sums."""
    columns = [field.name for field in fields(Figures)]
    print(f"{'package':12}" + "".join(f"{name:>12}" for name in columns))
    total = Figures()
    for package in sorted({file.parent for file in root.rglob("*.py")}):
        row = Figures()
        for file in package.glob("*.py"):
            row = row.plus(figures_of(file.read_text()))
        total = total.plus(row)
        print(_row(package.name, row))
    print(_row("all", total))


def _row(name: str, row: Figures) -> str:
    return f"{name:12}" + "".join(f"{figure:12}" for figure in astuple(row))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "mavftpfs"))
