"""Parameters as lines of text, in three spellings. Layer: parameters; pure.

- `NAME,VALUE`, with blanks or tabs in place of the comma too: Mission Planner, MAVProxy, pymavlink (.parm);
- the same with the default in a comment;
- system, component, name, value and type between tabs: QGroundControl (.params).

The parser recognises the spelling of each line, so a text may mix them. `#` begins a comment.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from mavftpfs.parameters.values import BadValue, Number, Parameter, parse_number, same, text_of

CHANGED_HEADER = "# Parameters that differ from their defaults. Deleting a line here changes nothing.\n"
_QGC_HEADER = """\
# Onboard parameters for Vehicle {system}
#
# Written by mavftpfs
#
# Vehicle-Id Component-Id Name Value Type
"""
_BETWEEN = re.compile(r"\s*[,\s]\s*")
_QGC_FIELDS = 5


@dataclass(frozen=True, slots=True)
class Line:
    """A line that sets a parameter. number: counts lines from 1. system, component: of a QGroundControl line,
    otherwise None.
    """

    number: int
    name: str
    value: Number
    system: int | None = None
    component: int | None = None


@dataclass(frozen=True, slots=True)
class Problem:
    """The reason why a line is invalid. number: counts lines from 1; 0 if the whole text is the reason."""

    number: int
    reason: str


def render_all(parameters: Iterable[Parameter]) -> str:
    """Return `NAME,VALUE` lines."""
    return "".join(f"{one.name},{text_of(one.kind, one.value)}\n" for one in parameters)


def render_changed(parameters: Iterable[Parameter]) -> str:
    """Return the parameters that differ from their defaults, each with its default."""
    lines = [
        f"{one.name},{text_of(one.kind, one.value)} # default {text_of(one.kind, one.default)}\n"
        for one in parameters
        if one.default is not None and one.changed
    ]
    return CHANGED_HEADER + "".join(lines)


def render_qgc(parameters: Iterable[Parameter], system: int, component: int) -> str:
    """Return QGroundControl's lines."""
    lines = [
        f"{system}\t{component}\t{one.name}\t{text_of(one.kind, one.value)}\t{one.kind.mavlink}\n"
        for one in parameters
    ]
    return _QGC_HEADER.format(system=system) + "".join(lines)


def parse(text: str, component: int | None = None) -> tuple[list[Line], list[Problem]]:
    """Read lines of any spelling. component: lines of QGroundControl for other components are problems."""
    lines: list[Line] = []
    problems: list[Problem] = []
    for number, raw in enumerate(text.split("\n"), 1):
        content = raw.partition("#")[0].strip()
        if not content:
            continue
        try:
            lines.append(_parse_line(number, content, component))
        except BadValue as error:
            problems.append(Problem(number, str(error)))
    return lines, problems + _contradictions(lines)


def _parse_line(number: int, content: str, component: int | None) -> Line:
    fields = content.split()
    if len(fields) == _QGC_FIELDS and fields[0].isdecimal() and fields[1].isdecimal():
        system, of, name, value, kind = fields
        if component is not None and int(of) != component:
            raise BadValue(f"{name} is a parameter of component {of}, and this is component {component}")
        if not kind.isdecimal():
            raise BadValue(f"{kind!r} is not a type")
        return Line(number, name, parse_number(value), int(system), int(of))
    fields = _BETWEEN.split(content)
    if len(fields) != 2:
        raise BadValue(f"{content!r} is not NAME,VALUE")
    return Line(number, fields[0], parse_number(fields[1]))


def _contradictions(lines: Sequence[Line]) -> list[Problem]:
    """Return a problem for each name that has two values."""
    found: dict[str, Line] = {}
    problems = []
    for line in lines:
        first = found.setdefault(line.name, line)
        if not same(first.value, line.value):
            problems.append(Problem(line.number, f"{line.name} has another value on line {first.number}"))
    return problems
