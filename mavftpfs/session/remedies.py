"""Who has the session when the server refuses a request, and what helps then. Layer: session; pure.

| who has the session (`Holder`) | NAK | remedy |
|---|---|---|
| HIDDEN: PX4's sticky errno hides every other code | 8 | list a directory to its end, once; that clears it |
| OURS: this connection, whose `maybe_open` is not empty | 4, 5, 8, 1 | close that, three times at most |
| ANOTHER: a client that was heard | 4, 5, 8 | the caller waits for that client |
| GONE: a client that is not heard | 4, 5, 8 | be silent for 3.5 s, then 10.5 s; for an open, then reset |
| NOBODY: the refusal has another reason | any other | none: an error |

The first row that fits counts. The reset is left out if another client was heard lately, because it might end
that client's session. `ServerSession._remedy` carries the remedies out. Asking sooner than after a silence
keeps a stale session alive (docs/servers.md 1).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import Enum

from mavftpfs.protocol.payload import NakCode
from mavftpfs.shared.errors import FtpNak

SILENCE_ARDUPILOT = 3.5
"""Seconds. ArduPilot lets a session be taken over after 3 s without any reply."""

SILENCE_PX4 = 10.5
"""Seconds. PX4 closes a session 10 s after the last request of anybody on the link."""

MOST_CLOSES = 3
"""How often `maybe_open` is closed because of one request; then its refusal has another reason."""

TAKEN = frozenset((NakCode.INVALID_SESSION, NakCode.NO_SESSIONS_AVAILABLE))
MAYBE_TAKEN = TAKEN | {NakCode.FILE_EXISTS}
"""NAK 8 may hide any other code on PX4 (sticky EEXIST), and makes no sense as an answer to an open or a
Terminate."""
IF_OPEN = MAYBE_TAKEN | {NakCode.FAIL}
"""Refusals of an open that servers send while a file is open."""


class Holder(Enum):
    """Who has the session, as far as a refusal shows that; see the table above."""

    HIDDEN = "hidden"
    OURS = "ours"
    ANOTHER = "another client"
    GONE = "a client that is gone"
    NOBODY = "nobody"


@dataclass
class Tried:
    """The remedies tried since `began`, because the server refused one request.

    opens: the request opens a file, in a turn of the session; others need no turn. resent: one of the tries
    was sent more than once. remedies: how often a remedy was tried against each holder.
    """

    began: float
    opens: bool
    resent: bool = False
    remedies: Counter[Holder] = field(default_factory=Counter)


def holder(nak: FtpNak, tried: Tried, *, ours: bool, another: bool) -> Holder:
    """Return who has the session. ours: this connection may have a file open, and may close it. another:
    another client may have a file open."""
    if nak.code not in (IF_OPEN if tried.opens else TAKEN):
        return Holder.NOBODY
    if nak.code == NakCode.FILE_EXISTS and not tried.remedies[Holder.HIDDEN]:
        return Holder.HIDDEN
    if ours and tried.remedies[Holder.OURS] < MOST_CLOSES:
        return Holder.OURS
    if nak.code == NakCode.FAIL:
        return Holder.NOBODY
    return Holder.ANOTHER if another else Holder.GONE
