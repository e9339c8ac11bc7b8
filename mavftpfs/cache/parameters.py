"""`@PARAM` as texts: what is read, and how a saved text changes the vehicle. Layer: cache.

All texts show one download of `param.pck`, which holds for a second. `parameters.saving` says which values a
saved text sets. They go out in one upload. Only a new download tells what became of them: servers skip names
that they do not know, cut numbers to fit, and ACK what they refuse (docs/servers.md 17).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mavftpfs.cache.attributes import SECOND
from mavftpfs.cache.card import Card
from mavftpfs.cache.texts import (
    Refused,
    Save,
    Saved,
    Shown,
    Texts,
    cause_of,
    problems_refused,
)
from mavftpfs.cache.virtual import PARAM_FILE, VirtualTrees
from mavftpfs.parameters.own import is_own
from mavftpfs.parameters.packed import Download, pack_upload, unpack
from mavftpfs.parameters.saving import Base, Values, Verdict, judge, make_plan, pick_base, unchanged
from mavftpfs.parameters.text import (
    Line,
    Problem,
    parse,
    render_all,
    render_changed,
    render_qgc,
)
from mavftpfs.parameters.values import Number, Parameter
from mavftpfs.shared.errors import (
    FtpNak,
    MavftpfsError,
    NotFound,
    NotTaken,
    RemoteProtocolError,
)
from mavftpfs.shared.model import split

ALL, CHANGED, QGC = b"params.parm", b"changed.parm", b"params.params"
DEFAULTS_FILE = PARAM_FILE + b"?withdefaults=1"
AT_ONCE = 1000
"""Values in one upload: its length is a number of 16 bits."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """All parameters as one download had them."""

    raw: bytes
    parameters: Sequence[Parameter]
    values: Values
    since_ns: int


class Parameters(Texts[Base]):
    """The texts of `@PARAM`."""

    directory = split(PARAM_FILE)[0]
    names = (ALL, CHANGED, QGC)

    def __init__(self, card: Card, virtual: VirtualTrees) -> None:
        super().__init__(card, virtual)
        self._snapshot: Snapshot | None = None
        self._rendered: dict[bytes, Shown[Base]] = {}
        self._defaults: dict[str, Number] | None = None
        self._tells_defaults: bool | None = None

    def forget(self) -> None:
        """The vehicle may be another one, or have another firmware."""
        self._snapshot = None
        self._rendered.clear()
        self._defaults = None
        self._tells_defaults = None

    # --- reading

    async def show(self, name: bytes, *, reread: bool) -> Shown[Base]:
        """See Texts."""
        snapshot = await self._read(reread=reread)
        differing = await self._differing(snapshot) if name == CHANGED else None
        shown = self._rendered.get(name)
        if shown is None:
            shown = self._rendered[name] = self._render(name, snapshot, differing)
        return shown

    def _render(self, name: bytes, snapshot: Snapshot, differing: Sequence[Parameter] | None) -> Shown[Base]:
        if name == CHANGED:
            if differing is None:
                raise NotFound(f"the vehicle tells no defaults, so {name.decode()} has nothing to show")
            values = {one.name: one for one in differing}
            return Shown(render_changed(differing).encode(), values, snapshot.since_ns)
        text = render_all(snapshot.parameters)
        if name == QGC:
            text = render_qgc(snapshot.parameters, *self._store.address())
        return Shown(text.encode(), snapshot.values, snapshot.since_ns)

    async def _read(self, *, reread: bool) -> Snapshot:
        """Return the vehicle's parameters. reread: read them now; else what was read last will do, if
        anything was.

        Raises:
            NotFound, RemoteProtocolError; else as RemoteStore.read_whole.
        """
        raw = await self._virtual.content(PARAM_FILE, reread=reread)
        if self._snapshot is None or self._snapshot.raw is not raw:
            self._take(*await self.parsed(PARAM_FILE, raw, lambda raw: _complete(unpack(raw))))
        assert self._snapshot is not None
        return self._snapshot

    def _take(self, raw: bytes, download: Download) -> None:
        """Take a new download. If its values are those of the last one, the texts stay as they are.

        Values that the vehicle sets by itself do not change the texts' time: else an editor would warn at
        each save.
        """
        before, values = self._snapshot, {one.name: one for one in download.parameters}
        if before is not None and before.values == values:
            self._snapshot = replace(before, raw=raw)
            return
        since = int(self._wall() * SECOND)
        if before is not None and _without_own(before.values) == _without_own(values):
            since = before.since_ns
        self._snapshot = Snapshot(raw, download.parameters, values, since)
        self._rendered.clear()

    async def _differing(self, snapshot: Snapshot) -> list[Parameter] | None:
        """Return what differs from its default; None where the vehicle tells no defaults."""
        if self._tells_defaults is False:
            return None
        if self._defaults is None or not snapshot.values.keys() <= self._defaults.keys():
            await self._read_defaults()
        defaults = self._defaults
        if defaults is None:
            return None
        with_defaults = (replace(one, default=defaults.get(one.name)) for one in snapshot.parameters)
        return [one for one in with_defaults if one.changed]

    async def _read_defaults(self) -> None:
        """Ask for defaults; they hold until the vehicle restarts.

        In such a download a parameter without a default has its default value.
        """
        try:
            download = unpack(await self._virtual.content(DEFAULTS_FILE, reread=True))
        except (FtpNak, NotFound, RemoteProtocolError):
            download = None
        self._tells_defaults = download is not None and download.with_defaults
        if download is not None and self._tells_defaults:
            self._defaults = {
                one.name: one.value if one.default is None else one.default for one in download.parameters
            }

    # --- saving

    async def carry_out(self, save: Save[Base]) -> Saved[Base]:
        """See Texts."""
        lines, notes = self._parse(save)
        base = pick_base(lines, save.bases, rereads=save.rereads)
        changed = [line for line in lines if base is None or not unchanged(line, base)]
        if not changed:
            return Saved(None if base is None else [base], notes=notes)
        before = (await self._read(reread=True)).values
        plan = make_plan(changed, base, before, meant=save.appended)
        if plan.problems:
            raise problems_refused(save.name, plan.problems)
        if plan.conflicts:
            raise Refused(NotTaken(plan.conflicts[0]), [*plan.conflicts, "nothing was set"])
        # From now on each line that the program changed itself counts, also if it is changed back.
        counting = dict.fromkeys(line.name for line in changed)
        if plan.wanted:
            known = [{**read, **counting} for read in save.bases]
            notes += (await self._set(save.name, plan.wanted, known)).notes
        known = [] if base is None else [{**base, **counting}]
        return Saved(known or None, bool(plan.wanted), notes + plan.notes)

    def _parse(self, save: Save[Base]) -> tuple[list[Line], list[str]]:
        """Return a text's lines, and notes.

        Raises:
            Refused: some cannot be.
        """
        system, component = self._store.address()
        try:
            text = save.text.decode()
        except UnicodeDecodeError as error:
            number = save.text.count(b"\n", 0, error.start) + 1
            raise problems_refused(save.name, [Problem(number, "this is no text")]) from None
        lines, problems = parse(text, component)
        if problems:
            raise problems_refused(save.name, problems)
        others = sorted({line.system for line in lines if line.system not in (None, system)} - {None})
        return lines, [f"the lines are of system {other}, this is system {system}" for other in others]

    async def _set(self, name: bytes, wanted: Sequence[Parameter], known: Sequence[Base]) -> Verdict:
        """Set values, and read back whether they hold. known: for Refused.

        Raises:
            Refused: some do not.
        """
        uploads = [pack_upload(wanted[at : at + AT_ONCE]) for at in range(0, len(wanted), AT_ONCE)]
        failure = await self.send(name, PARAM_FILE, uploads)
        try:
            after = (await self._read(reread=True)).values
        except MavftpfsError as error:
            said = f"{failure or error}; of {_several(wanted)} it is not known which were set"
            raise Refused(failure or error, [said], known) from error
        verdict = judge(wanted, after)
        if verdict.missed:
            more = "" if len(verdict.missed) == 1 else f" (and {len(verdict.missed) - 1} more)"
            why = cause_of(failure, verdict.missed[0] + more)
            raise Refused(why, _said(verdict, failure), known)
        return verdict


def _without_own(values: Values) -> dict[str, Parameter]:
    return {name: one for name, one in values.items() if not is_own(name)}


def _complete(download: Download) -> Download:
    """Return a download.

    Raises:
        RemoteProtocolError: it has not all parameters.
    """
    if len(download.parameters) != download.total:
        raise RemoteProtocolError(
            f"the parameter file has {len(download.parameters)} of {download.total} parameters"
        )
    return download


def _several(wanted: Sequence[Parameter]) -> str:
    return wanted[0].name if len(wanted) == 1 else f"{len(wanted)} parameters"


def _said(verdict: Verdict, failure: MavftpfsError | None) -> list[str]:
    """Return the lines for people about a save that was not wholly carried out."""
    taken = ", ".join(verdict.taken) if verdict.taken else "nothing"
    why = [] if failure is None else [str(failure)]
    return [*why, *verdict.missed, *verdict.notes, f"set: {taken}"]
