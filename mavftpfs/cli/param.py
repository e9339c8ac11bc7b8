"""`mavftpfs param`: prints, sets, loads, saves and compares a vehicle's parameters. Layer: cli."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import trio

from mavftpfs.cli import verbs
from mavftpfs.cli.commands import say
from mavftpfs.cli.drawing import shown
from mavftpfs.client import parameters as client
from mavftpfs.client.files import Session, Target, open_mount, vehicles_below
from mavftpfs.client.parameters import Change, ChangePlan, Difference
from mavftpfs.client.progress import Progress, followed
from mavftpfs.parameters.text import Line
from mavftpfs.parameters.values import Kind, Parameter, text_of
from mavftpfs.shared.errors import ExitCode, InvalidText, MavftpfsError, UsageError, VehicleLost
from mavftpfs.shared.model import ROOT

Args = argparse.Namespace

VEHICLES = ""
"""The FILE of `--diff` without one."""


def param(args: Args) -> int:
    """Print parameters, or set, load, save or compare them."""
    try:
        return _param(args)
    except InvalidText as exc:  # one line of text for each invalid line of a file
        *others, last = str(exc).split("\n")
        for line in others:
            say(line)
        raise InvalidText(last) from exc


def _param(args: Args) -> int:
    setting = [word for word in args.names if "=" in word]
    _require_one_job(args, setting)
    if args.save is not None:
        return _with_session(args, partial(_save, args))
    if args.diff == VEHICLES:
        return verbs.run(args, partial(_diff_vehicles, args))
    if args.diff is not None:
        return _with_session(args, partial(_diff, args, client.load(_file(args.diff))))
    if args.load is not None:
        return _change(args, lambda: client.load(_file(args.load)), args.load, meant=False)
    if setting:
        return _change(args, lambda: client.assignments(setting), "", meant=True)
    return _with_session(args, partial(_print, args))


def _file(word: str) -> Path:
    return Path("/dev/stdin") if word == "-" else Path(word)


def _require_one_job(args: Args, setting: Sequence[str]) -> None:
    jobs = [f"--{name}" for name in ("load", "save", "diff") if getattr(args, name) is not None]
    if len(jobs) > 1 or (jobs and args.names):
        raise UsageError(f"{jobs[0]} does one thing, with all parameters; leave out the rest")
    blanks = any(word.startswith("=") or word.endswith("=") for word in setting)
    if blanks and len(args.names) > 1:
        raise UsageError(f"write NAME=VALUE without blanks: {''.join(args.names)}")
    if setting and len(setting) < len(args.names):
        raise UsageError("set parameters (NAME=VALUE) or print them (NAME), not both")
    if args.changed and (setting or (jobs and jobs != ["--save"])):
        raise UsageError("--changed goes with printing or with --save; leave it out")
    if args.skip_unknown and args.load is None:
        raise UsageError("--skip-unknown goes with --load; leave it out")


def _with_session(args: Args, function: Any, *, writing: bool = False) -> int:
    async def work(target: Target) -> int:
        async with verbs.one_vehicle(client.at_root(target), writing=writing) as session:
            return int(await function(session))

    return verbs.run(args, work)


# -- printing, saving, comparing ------------------------------------------------------------------


async def _print(args: Args, session: Session) -> int:
    if args.changed or args.json:
        found = await client.read_with_defaults(session)
        if args.changed:
            await client.read_text(session, client.CHANGED)  # raises if the vehicle has no defaults
            found = [one for one in found if one.changed]
    else:
        found = await client.read_parameters(session)
    found = client.matching(found, args.names) if found or not args.changed else []
    if args.json:
        print(json.dumps([_facts(one) for one in found], indent=2))
        return ExitCode.OK
    for one in found:
        default = (
            f" # default {text_of(one.kind, one.default)}" if args.changed and one.default is not None else ""
        )
        print(f"{one.name},{client.value_text(one)}{default}")
    return ExitCode.OK


def _facts(one: Parameter) -> dict[str, Any]:
    return {
        "name": one.name,
        "type": one.kind.name.lower(),
        "value": _number(one),
        "default": None if one.default is None else _number(replace(one, value=one.default)),
    }


def _number(one: Parameter) -> int | float | str:
    """Return a value as a number if JSON has it, otherwise its text; floats as the shortest decimal."""
    text = client.value_text(one)
    if one.kind is not Kind.FLOAT:
        return int(text)
    return float(text) if math.isfinite(one.value) else text


async def _save(args: Args, session: Session) -> int:
    name = client.CHANGED if args.changed else client.QGC if args.save.endswith(".params") else client.ALL
    text = await client.read_text(session, name)
    if args.save == verbs.STDOUT:
        sys.stdout.write(text)
        return ExitCode.OK
    place = Path(args.save)
    new = place.with_name(place.name + ".part")
    try:
        new.write_text(text)
        os.replace(new, place)
    except OSError as exc:
        with suppress(OSError):
            new.unlink()
        raise UsageError(f"{place}: {exc.strerror}") from exc
    count = sum(not line.startswith("#") for line in text.splitlines())
    print(f"{count} parameters saved in {place}", file=sys.stderr)
    return ExitCode.OK


async def _diff(args: Args, lines: Sequence[Line], session: Session) -> int:
    current = await client.read_parameters(session)
    lines, others = await client.split_by_component(session, lines)
    if others:
        say(f"left out: {_of_others(others)}")
    found = client.compare(lines, current)
    if args.json:
        facts = [{"name": one.name, "vehicle": one.vehicle, "file": one.file} for one in found]
        print(json.dumps(facts, indent=2))
    else:
        for line in _difference_lines(found):
            print(line)
    return ExitCode.USAGE if found else ExitCode.OK


def _of_others(lines: Sequence[Line]) -> str:
    components = ", ".join(sorted({str(line.component) for line in lines}))
    return f"{len(lines)} line(s) of component {components}"


def _difference_lines(found: Sequence[Difference]) -> list[str]:
    return _table(("VEHICLE", "FILE"), [client.Row(one.name, (one.vehicle, one.file)) for one in found])


def _table(heads: Sequence[str], found: Sequence[client.Row]) -> list[str]:
    """Return the lines of a table with a column for each vehicle or file, no line if nothing differs."""
    rows = [("", *heads)] if found else []
    rows += [(row.name, *("-" if value is None else value for value in row.values)) for row in found]
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join([f"{row[0]:<{wide[0]}}", *_right(row[1:-1], wide[1:]), row[-1]]) for row in rows]


def _right(cells: Sequence[str], wide: Sequence[int]) -> list[str]:
    return [f"{cell:>{width}}" for cell, width in zip(cells, wide, strict=False)]


async def _diff_vehicles(args: Args, target: Target) -> int:
    """Compare the vehicles of a mount of several. A vehicle that cannot be read is named and left out."""
    if target.mount is None:
        raise UsageError("--diff needs a FILE; without one, SOURCE is the directory of a mount with -o all")
    if target.options.target_system:
        raise UsageError("--diff without a FILE compares all vehicles; leave out target_system=")
    found, code = dict[str, list[Parameter]](), ExitCode.OK
    with shown(Progress(), idle="reading the parameters"):
        for name, place in (await vehicles_below(target.mount[0])).items():
            try:
                if not place:
                    raise VehicleLost("it is not mounted now")
                async with open_mount(place, ROOT, target.options) as session:
                    found[name] = await client.read_parameters(session)
            except MavftpfsError as exc:
                say(f"vehicle {name} is left out: {exc}")
                code = ExitCode.INCOMPLETE
    if len(found) < 2:
        told = f"{len(found)} of the vehicles can be compared, two are needed; see: mavftpfs status"
        if not code:
            raise UsageError(told)
        say(told)
        return code
    rows = client.compare_vehicles(list(found.values()))
    if args.json:
        facts = [{"name": row.name, **dict(zip(found, row.values, strict=True))} for row in rows]
        print(json.dumps(facts, indent=2))
    else:
        for line in _table(list(found), rows):
            print(line)
    return code or (ExitCode.USAGE if rows else ExitCode.OK)


# -- setting --------------------------------------------------------------------------------------


def _change(args: Args, read: Callable[[], Sequence[Line]], name: str, *, meant: bool) -> int:
    done = list[Change]()
    error: MavftpfsError | None = None
    announced = False
    try:
        setting = _Setting(args, read(), name, meant, Progress(), done)
        _with_session(args, setting.run, writing=True)
        announced = setting.announced
    except MavftpfsError as exc:
        error = exc
    if args.json:
        facts = [
            {"name": one.after.name, "from": _number(one.before), "to": _number(one.after)} for one in done
        ]
        print(json.dumps({"set": facts, "error": None if error is None else str(error)}, indent=2))
    elif error is None:
        for change in () if announced else done:
            print(change)
        if announced or not done:
            nothing = "nothing to set: the vehicle already has these values"
            print(f"{len(done)} set" if done else nothing, file=sys.stderr)
    if error is not None:
        raise error
    return ExitCode.OK


@dataclass(slots=True)
class _Setting:
    """One run that sets parameters. name: the file of the lines. meant: see make_plan. done: the parameters
    that were set and read back. announced: the changes were printed before.
    """

    args: Args
    lines: Sequence[Line]
    name: str
    meant: bool
    bar: Progress
    done: list[Change]
    announced: bool = False

    async def run(self, session: Session) -> int:
        """Set the values that differ; in two steps if some parameters may appear only after others are
        set."""
        plan = await self._compare(session)
        first = client.enabling(plan.changes) if plan.unknown else []
        if plan.unknown and not first:
            self._require_known(plan)
        await self._ask(plan)
        if first:
            await self._set(session, first)
            plan = await self._compare(session)
            self._require_known(plan)
        await self._set(session, plan.changes)
        for note in plan.notes:
            say(note)
        return ExitCode.OK

    async def _compare(self, session: Session) -> ChangePlan:
        self.bar.plan(0, 0)
        with shown(self.bar, idle="reading the parameters"):
            current = await client.read_parameters(session)
            lines, others = await client.split_by_component(session, self.lines)
        if not self.name:
            lines = client.spelled(lines, current)
        if others and not self.args.skip_unknown:
            raise InvalidText(f"{_of_others(others)}; --skip-unknown leaves them out")
        if others and not self.done:
            say(f"left out: {_of_others(others)}")
        return client.plan_changes(lines, current, self.name, meant=self.meant)

    def _require_known(self, plan: ChangePlan) -> None:
        """Print the names of parameters that the vehicle does not have.

        Raises:
            InvalidText: there are some, and the user did not allow leaving them out.
        """
        names = ", ".join(line.name for line in plan.unknown)
        if plan.unknown and not self.args.skip_unknown:
            hint = "; --skip-unknown leaves them out" if self.name else ""
            raise InvalidText(f"the vehicle has no {names}{hint}")
        if plan.unknown:
            say(f"left out, because the vehicle does not have them: {names}")

    async def _ask(self, plan: ChangePlan) -> None:
        """Print the changes before more than one parameter is set, and ask on a terminal.

        Raises:
            UsageError: the user said no.
        """
        count = len(plan.changes) + len(plan.unknown)
        if len(plan.changes) < 1 or count < 2 or self.args.yes or self.args.json:
            return
        self.announced = True
        for change in plan.changes:
            print(change, file=sys.stderr)
        if not sys.stdin.isatty():
            return
        print(f"Set {len(plan.changes)} parameters? [y/N] ", end="", file=sys.stderr, flush=True)
        answer = await trio.to_thread.run_sync(sys.stdin.readline, abandon_on_cancel=True)
        if answer.strip().lower() not in ("y", "yes"):
            raise UsageError("nothing was set")

    async def _set(self, session: Session, changes: Sequence[Change]) -> None:
        if not changes:
            return
        try:
            with shown(self.bar):
                async with followed(session, self.bar):
                    await client.set_values(session, changes, self.bar)
        except MavftpfsError as error:
            for line in await client.last_error(session):
                if not line.endswith(str(error)):
                    say(line)
            raise
        self.done += changes
