"""A vehicle's parameters for commands: read, compared, set. Layer: client.

The commands use the texts in `@PARAM`, of a mount that is up or of a connection, so that parameters are set
and read back in one place only (`cache.parameters`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path

from mavftpfs.client.files import Session, Target, reading, written
from mavftpfs.client.progress import Progress
from mavftpfs.parameters.own import is_own
from mavftpfs.parameters.packed import pack_upload, unpack
from mavftpfs.parameters.saving import make_plan
from mavftpfs.parameters.text import Line, Problem, parse
from mavftpfs.parameters.values import BadValue, Kind, Number, Parameter, fit, parse_number, same, text_of
from mavftpfs.shared.errors import (
    InvalidText,
    MavftpfsError,
    NotDelivered,
    NotFound,
    UsageError,
)
from mavftpfs.shared.model import ROOT

DIRECTORY = b"/@PARAM/"
PACKED, ALL, CHANGED, QGC = b"param.pck", b"params.parm", b"changed.parm", b"params.params"
LAST_ERROR = b"last_error.txt"
MOST = 4 << 20
"""The largest file for --load, in bytes."""

_DEFAULT = re.compile(r"^([^,#\n]+),\S+ # default (\S+)$", re.MULTILINE)


def at_root(target: Target) -> Target:
    """Return a target whose `/` is the vehicle's, where `@PARAM` is; or that of a mount that shows less."""
    mount = None if target.mount is None else (target.mount[0], ROOT)
    return replace(target, options=replace(target.options, root=ROOT), mount=mount)


async def read_text(session: Session, name: bytes) -> str:
    """Return one of the texts.

    Raises:
        NotFound: this vehicle has none. Otherwise as Files.open.
    """
    return (await _read(session, name)).decode()


async def read_parameters(session: Session) -> list[Parameter]:
    """Return all parameters, in the vehicle's order.

    Raises:
        As read_text; RemoteProtocolError: the vehicle's file is damaged.
    """
    return unpack(await _read(session, PACKED)).parameters


async def read_with_defaults(session: Session) -> list[Parameter]:
    """Return all parameters with their defaults, if the vehicle reports these.

    Raises:
        As read_parameters.
    """
    found = await read_parameters(session)
    try:
        told = dict(_DEFAULT.findall(await read_text(session, CHANGED)))
    except NotFound:
        return found
    return [replace(one, default=_default(one, told)) for one in found]


def _default(one: Parameter, told: Mapping[str, str]) -> Number:
    return fit(one.kind, parse_number(told[one.name])) if one.name in told else one.value


async def _read(session: Session, name: bytes) -> bytes:
    try:
        async with reading(session.files, DIRECTORY + name) as file:
            return bytes(await file.read(0, file.size))
    except NotFound as exc:
        if name == CHANGED:
            raise NotFound("this vehicle does not report the defaults of its parameters") from exc
        part = (
            "" if session.root == ROOT else f"; the mount shows {session.root.decode(errors='replace')} only"
        )
        raise NotFound(
            f"this vehicle has no parameters in MAVLink FTP{part}; ArduPilot has them since 2020, "
            "PX4 since September 2026: update its firmware, or use a ground station"
        ) from exc


async def split_by_component(
    session: Session, lines: Sequence[Line]
) -> tuple[Sequence[Line], Sequence[Line]]:
    """Return the lines of this vehicle's component, and those of others, because QGroundControl saves all of
    them in one file, and names may be the same.

    Raises:
        As read_text.
    """
    if all(line.component is None for line in lines):
        return lines, []
    told = next(iter(parse(await read_text(session, QGC))[0]), None)
    component = None if told is None else told.component
    others = [line for line in lines if line.component not in (None, component)]
    return [line for line in lines if line.component in (None, component)], others


def matching(parameters: Sequence[Parameter], patterns: Sequence[str]) -> list[Parameter]:
    """Return the parameters whose names match a pattern, ignoring case; all if there is no pattern.

    Raises:
        UsageError: a pattern matches none.
    """
    for pattern in patterns:
        if not any(_matches(one, pattern) for one in parameters):
            raise UsageError(f"no parameter is called {pattern}")
    return [one for one in parameters if not patterns or any(_matches(one, pattern) for pattern in patterns)]


def _matches(one: Parameter, pattern: str) -> bool:
    return fnmatchcase(one.name.upper(), pattern.upper())


# -- setting --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Change:
    """A value to set; before: the vehicle's present value."""

    before: Parameter
    after: Parameter

    def __str__(self) -> str:
        return f"{self.after.name} {value_text(self.before)} -> {value_text(self.after)}"


@dataclass(frozen=True, slots=True)
class ChangePlan:
    """The changes to make. unknown: lines of names that the vehicle lacks (yet). notes: for people."""

    changes: list[Change] = field(default_factory=list)
    unknown: list[Line] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def value_text(one: Parameter) -> str:
    """Return a parameter's value as text."""
    return text_of(one.kind, one.value)


def assignments(words: Sequence[str]) -> list[Line]:
    """Parse NAME=VALUE words.

    Raises:
        UsageError: a word has no name, a value is not a number, or a name has two values.
    """
    lines: list[Line] = []
    for number, word in enumerate(words, 1):
        name, _, value = word.partition("=")
        if not name.strip():
            raise UsageError(f"{word}: write NAME=VALUE, without spaces")
        try:
            line = Line(number, name.strip(), parse_number(value.strip()))
        except BadValue as exc:
            raise UsageError(f"{word}: {exc}") from None
        if any(
            other.name.upper() == line.name.upper() and not same(other.value, line.value) for other in lines
        ):
            raise UsageError(f"{line.name} has two values; leave one out")
        lines.append(line)
    return lines


def spelled(lines: Sequence[Line], current: Sequence[Parameter]) -> list[Line]:
    """Return lines with the vehicle's own spelling of their names, where only the case differs."""
    names = {one.name.upper(): one.name for one in current}
    return [replace(line, name=names.get(line.name.upper(), line.name)) for line in lines]


def load(path: Path) -> list[Line]:
    """Return the lines of a parameter file in any spelling.

    Raises:
        UsageError: the file cannot be read. InvalidText: it has invalid lines; the text names each.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MOST + 1)
    except OSError as exc:
        raise UsageError(f"{path}: {exc.strerror}") from exc
    try:
        text = data.decode()
    except UnicodeDecodeError:
        raise UsageError(f"{path} is not a text file of parameters") from None
    if len(data) > MOST:
        raise UsageError(f"{path} is too long for a file of parameters")
    lines, problems = parse(text)
    if problems:
        raise invalid(str(path), problems)
    return lines


def invalid(name: str, problems: Sequence[Problem]) -> InvalidText:
    """Return an error that names each invalid line, with its file if there is one."""
    where = [f"{name}:{problem.number}: " if name else "" for problem in problems]
    return InvalidText("\n".join(place + one.reason for place, one in zip(where, problems, strict=True)))


def plan_changes(
    lines: Sequence[Line], current: Sequence[Parameter], name: str, *, meant: bool
) -> ChangePlan:
    """Compare lines with the vehicle's parameters. meant: the user wrote each line by itself (see make_plan).

    Raises:
        InvalidText: values do not fit; `name` is that of the file.
    """
    values = {one.name: one for one in current}
    known = [line for line in lines if line.name in values]
    plan = make_plan(known, None, values, meant=meant)
    if plan.problems:
        raise invalid(name, plan.problems)
    changes = [Change(values[one.name], one) for one in plan.wanted]
    return ChangePlan(changes, [line for line in lines if line.name not in values], plan.notes)


def enabling(changes: Sequence[Change]) -> list[Change]:
    """Return the changes that may make more parameters appear: those of integers that were 0 (docs/servers.md
    17)."""
    return [change for change in changes if change.before.kind is not Kind.FLOAT and not change.before.value]


async def set_values(session: Session, changes: Sequence[Change], progress: Progress) -> None:
    """Set values, and read all of them back. Progress counts the bytes that the vehicle acknowledged.

    Raises:
        ReadOnly, Armed: nothing is set in flight. NotTaken: the vehicle did not accept some; `last_error`
            names them.
    """
    text = "".join(f"{change.after.name},{value_text(change.after)}\n" for change in changes)
    file = await session.files.open(DIRECTORY + ALL, write=True, append=True)
    size = sum(map(len, pack_upload([change.after for change in changes])))
    progress.plan(1, size)
    progress.begin(f"setting {len(changes)} parameter(s)", size)
    progress.sending = session.text_of(DIRECTORY + ALL)
    try:
        async with written(file):
            await file.write(0, text.encode())
    except NotDelivered as exc:
        cause = exc.__cause__
        raise cause if isinstance(cause, MavftpfsError) else exc from None
    progress.end(size)


async def last_error(session: Session) -> list[str]:
    """Return the lines of last_error.txt without its head; [] if it cannot be read."""
    try:
        return (await read_text(session, LAST_ERROR)).splitlines()[1:]
    except MavftpfsError:
        return []


# -- comparing ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Difference:
    """A line of a file that differs from the vehicle's value; None: the vehicle has no such parameter."""

    name: str
    vehicle: str | None
    file: str


def compare(lines: Sequence[Line], current: Sequence[Parameter]) -> list[Difference]:
    """Return the differences between a file and a vehicle, except in parameters that the vehicle sets by
    itself."""
    values = {one.name: one for one in current}
    found = []
    for line in {line.name: line for line in lines}.values():
        now = values.get(line.name)
        if is_own(line.name) or (now is not None and _agrees(line, now)):
            continue
        wanted = str(line.value) if now is None else _wanted_text(line, now)
        found.append(Difference(line.name, None if now is None else value_text(now), wanted))
    return found


@dataclass(frozen=True, slots=True)
class Row:
    """A parameter that differs between vehicles. values: a text for each vehicle, None if it has no such
    parameter."""

    name: str
    values: tuple[str | None, ...]


def compare_vehicles(vehicles: Sequence[Sequence[Parameter]]) -> list[Row]:
    """Return the parameters that differ between vehicles, except those that a vehicle sets by itself."""
    texts = [{one.name: value_text(one) for one in found} for found in vehicles]
    names = dict.fromkeys(name for known in texts for name in known if not is_own(name))
    rows = (Row(name, tuple(known.get(name) for known in texts)) for name in names)
    return [row for row in rows if len(set(row.values)) > 1]


def _agrees(line: Line, now: Parameter) -> bool:
    try:
        return same(fit(now.kind, line.value), now.value)
    except BadValue:
        return False


def _wanted_text(line: Line, now: Parameter) -> str:
    try:
        return text_of(now.kind, fit(now.kind, line.value))
    except BadValue:
        return str(line.value)
