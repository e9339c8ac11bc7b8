"""Saving a text of parameters: the changes that it asks for, and their result. Layer: parameters; pure.

A program that saves a text of all parameters means only the lines that it changed, because counters,
barometers and learned values have changed on the vehicle since it read them. So a save has a *base*: the text
that the same program read before. Lines that equal the base ask for nothing. Without a base (`cp`, `>`) every
line counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from mavftpfs.parameters.own import is_own
from mavftpfs.parameters.text import Line, Problem
from mavftpfs.parameters.values import BadValue, Number, Parameter, fit, same, text_of

Values = Mapping[str, Parameter]
"""Parameters by name."""


Base = Mapping[str, Parameter | None]
"""The parameters that a program read, by name. None: the program saved another value since, so that its line
always counts."""


def unchanged(line: Line, base: Base) -> bool:
    """Return whether a line says what the base says."""
    known = base.get(line.name)
    if known is None:
        return False
    try:
        return same(fit(known.kind, line.value), known.value)
    except BadValue:
        return False


def pick_base(lines: Sequence[Line], bases: Sequence[Base], *, rereads: bool) -> Base | None:
    """Return the base that a text was made from: the one with which it shares the most lines, of several the
    last.

    bases: the texts that the program read, the oldest first. rereads: the program reads the file again to
    make a backup, as vim does. Otherwise a text that equals an older base is compared with the last one,
    because the program knew the last one and now restores the older values.
    """
    if len(bases) < 2:
        return bases[0] if bases else None
    shared = [
        sum(base.get(line.name, line) is None or unchanged(line, base) for line in lines) for base in bases
    ]
    best = max(range(len(bases)), key=lambda place: (shared[place], place))
    if shared[best] == len(lines) and not rereads:
        best = len(bases) - 1
    return bases[best]


@dataclass(frozen=True, slots=True)
class Plan:
    """The changes that a text asks for.

    wanted: parameters to set, which have other values on the vehicle. problems: invalid lines. conflicts: why
    nothing is set although the lines are valid. With a problem or a conflict the mount sends nothing. notes:
    lines for the user.
    """

    wanted: list[Parameter] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    conflicts: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def make_plan(lines: Sequence[Line], base: Base | None, current: Values, *, meant: bool) -> Plan:
    """Compare a text with the vehicle's parameters.

    meant: the user wrote each line by itself (`>>`), so the plan also sets parameters that the vehicle sets
    by itself.
    """
    plan = Plan()
    left_alone: list[str] = []
    for line in {line.name: line for line in lines}.values():
        if base is not None and unchanged(line, base):
            continue
        now = current.get(line.name)
        if now is None:
            plan.problems.append(Problem(line.number, f"the vehicle has no parameter {line.name}"))
            continue
        try:
            value = fit(now.kind, line.value)
        except BadValue as error:
            plan.problems.append(Problem(line.number, f"{line.name}: {error}"))
            continue
        if same(value, now.value):
            continue
        before = None if base is None else base.get(line.name)
        if before is not None and not same(before.value, now.value) and not is_own(line.name):
            plan.conflicts.append(_conflict(now, value, before.value))
        elif base is None and not meant and is_own(line.name):
            left_alone.append(line.name)
        else:
            plan.wanted.append(Parameter(line.name, now.kind, value))
    if left_alone:
        plan.notes.append(f"not changed, because the vehicle sets them by itself: {', '.join(left_alone)}")
    return plan


def _conflict(now: Parameter, wanted: Number, before: Number) -> str:
    was, has, want = (text_of(now.kind, value) for value in (before, now.value, wanted))
    return f"{now.name}: it was {was}, and the vehicle changed it to {has} meanwhile; wanted {want}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The result of a plan: the parameters that the vehicle accepted, a line for each that it did not, and
    notes."""

    taken: list[str]
    missed: list[str]
    notes: list[str]


def judge(wanted: Sequence[Parameter], after: Values) -> Verdict:
    """Compare the values that were sent with those read back."""
    verdict = Verdict([], [], [])
    for one in wanted:
        now = after.get(one.name)
        want = text_of(one.kind, one.value)
        if now is None:
            verdict.missed.append(f"{one.name}: wanted {want}, but the vehicle has no such parameter now")
        elif same(now.value, one.value):
            verdict.taken.append(one.name)
        elif is_own(one.name):
            got = text_of(now.kind, now.value)
            verdict.notes.append(f"{one.name} is set by the vehicle itself: wanted {want}, got {got}")
        else:
            verdict.missed.append(f"{one.name}: wanted {want}, got {text_of(now.kind, now.value)}")
    return verdict
