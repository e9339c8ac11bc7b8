"""How a draft gets to the vehicle. Layer: cache; pure.

The choice rests on what the server was seen to do, never on its name. A file that is there is changed in
place only where that does what a local disk does; else a complete new one takes its place.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mavftpfs.cache.draft import Draft
from mavftpfs.shared.errors import FileChanged, FileTooLarge, NotSupported
from mavftpfs.shared.traits import WriteTraits


class Plan(Enum):
    """One way of delivering.

    NOTHING: the vehicle has it. CREATE_EMPTY: CreateFile on the real name, no data. NEW: CreateFile on the
    real name, which is free. REPLACE: a temporary name, verified, renamed. FILL: fetch what only the
    vehicle has, then plan again. IN_PLACE: OpenFileWO, and only what changed. PROBE: find out whether
    OpenFileWO empties files, then plan again. TRUNCATE: TruncateFile, then plan again if more is to be
    changed. REWRITE: CreateFile on the real name, over what is there (`inplace`).
    """

    NOTHING = "nothing"
    CREATE_EMPTY = "create empty"
    NEW = "new"
    REPLACE = "replace"
    FILL = "fill"
    IN_PLACE = "in place"
    PROBE = "probe"
    TRUNCATE = "truncate"
    REWRITE = "rewrite"


SENDING = frozenset({Plan.NEW, Plan.REPLACE, Plan.IN_PLACE, Plan.REWRITE})
"""Plans that send bytes."""


@dataclass(frozen=True, slots=True)
class Rules:
    """What the user allows. rmw_max: the largest file in bytes that is sent whole for a partial change."""

    rmw_max: int
    inplace: bool = False


def choose(draft: Draft, traits: WriteTraits, rules: Rules) -> Plan:
    """Return the next step for a draft.

    Raises:
        NotSupported: the file cannot be replaced, and `inplace` was not given.
        FileChanged: the vehicle's file lost what was to stay of it, and only the vehicle had that.
        DataUnproven: of bytes that are to stay nobody knows what they were.
        FileTooLarge: the change would need more of the file to be sent than rmw_max.
    """
    if draft.clean:
        return Plan.NOTHING
    if draft.size == 0:
        return Plan.CREATE_EMPTY
    remote_size = draft.remote_end
    if remote_size is None:
        return Plan.NEW
    if draft.fresh:
        return _replacement(traits, rules)
    if draft.ruined:
        if not draft.whole:
            raise FileChanged("the file lost what was to stay of it on the vehicle while it was changed here")
        return Plan.REWRITE if traits.rename_works is False else Plan.REPLACE  # nothing is left to be kept
    return _partial(draft, remote_size, traits, rules)


def _partial(draft: Draft, remote_size: int, traits: WriteTraits, rules: Rules) -> Plan:
    """Part of the file on the vehicle is to stay."""
    draft.require_sound()
    if draft.size < remote_size:
        if traits.truncate_works is False:
            return _rewriting(draft, traits, rules)
        if draft.changed.empty:
            return Plan.TRUNCATE
        if draft.whole and draft.size <= rules.rmw_max:  # replaced at one blow, and nothing has to be fetched
            return _rewriting(draft, traits, rules)
        if traits.wo_truncates is False:
            return Plan.TRUNCATE  # what it changed follows in place
    if traits.wo_truncates is None:
        return Plan.PROBE
    return _rewriting(draft, traits, rules) if traits.wo_truncates else Plan.IN_PLACE


def _rewriting(draft: Draft, traits: WriteTraits, rules: Rules) -> Plan:
    """Send the whole file although part of it is there."""
    if draft.size > rules.rmw_max:
        raise FileTooLarge(f"changing a part of {draft.size} bytes means sending them all; see rmw_max")
    replacement = _replacement(traits, rules)
    return replacement if draft.whole else Plan.FILL


def _replacement(traits: WriteTraits, rules: Rules) -> Plan:
    if traits.rename_works is not False:
        return Plan.REPLACE
    if rules.inplace:
        return Plan.REWRITE
    raise NotSupported("this server cannot rename, so a file cannot be replaced safely; see inplace")
