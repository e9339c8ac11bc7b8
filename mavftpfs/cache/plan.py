"""The next step that brings a draft to the vehicle. Layer: cache; pure.

Whatever changes a file's content is sent as a whole new file under a reserved name beside it, verified there,
and renamed into place. Only on cards that cannot rename it is sent under its own name. The choice rests on
what the server was seen to do, never on its name.
"""

from __future__ import annotations

from enum import Enum

from mavftpfs.cache.draft import Draft, State
from mavftpfs.shared.errors import FileChanged, NotSupported
from mavftpfs.shared.traits import WriteTraits


class Plan(Enum):
    """One step.

    NOTHING: the vehicle has it. MEND: have an interrupted replacement completed or undone. FETCH: get what
    only the vehicle has of the old content. FIND_OUT: see whether the card can rename. REPLACE: send it under
    a reserved name and rename it. OVERWRITE: send it under its own name.
    """

    NOTHING = "nothing"
    MEND = "mend"
    FETCH = "fetch"
    FIND_OUT = "find out"
    REPLACE = "replace"
    OVERWRITE = "overwrite"


SENDING = frozenset({Plan.REPLACE, Plan.OVERWRITE})
"""Steps that send bytes."""


def choose(draft: Draft, traits: WriteTraits, *, inplace: bool) -> Plan:
    """Return the next step for a draft. inplace: overwrite files where they cannot be replaced.

    Raises:
        FileChanged: the base is another file now.
        NotSupported: the card cannot rename, and `inplace` was not given.
    """
    if draft.state is State.CLEAN:
        return Plan.NOTHING
    if draft.state is State.STALE:
        raise FileChanged("others replaced the file on the vehicle while it was changed here")
    if draft.state is State.TORN:
        return Plan.MEND
    if traits.rename_works is False and draft.base is not None and not inplace and not draft.begun:
        raise NotSupported("this server cannot rename, so a file cannot be replaced safely; see inplace")
    if not draft.whole:
        return Plan.FETCH
    if traits.rename_works is None:
        return Plan.FIND_OUT
    return Plan.REPLACE if traits.rename_works else Plan.OVERWRITE
