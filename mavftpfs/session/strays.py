"""Answers that nobody waits for any more: the network doubled the request. Layer: session.

An open that comes to the server once more is carried out once more (servers.md 2). What is open there then
is another file than we think: MAVSDK closes ours and opens that one under the same id, CreateFile empties
it first, other servers keep a session that nobody closes. The answer tells, because its seq is an old one.
A ReadFile without an open file closes all that is open on MAVSDK, and a Terminate does on most.
"""

from __future__ import annotations

from collections.abc import Callable

from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.session.holder import SessionHolder

_OPENING = frozenset((Opcode.OPEN_FILE_RO, Opcode.OPEN_FILE_WO, Opcode.CREATE_FILE))
_DISTURBING = _OPENING | {
    Opcode.READ_FILE,
    Opcode.BURST_READ_FILE,
    Opcode.TERMINATE_SESSION,
    Opcode.RESET_SESSIONS,
}


class Strays:
    """Tells what a late second request did to the session.

    Args:
        is_shared: whether ids that the server chose may be another client's by now.
        on_taken: the session was opened on another file: nothing that came by it lately is to be believed.
        on_emptied: the file that is being written may have been emptied.
        on_disturbed: a request came again that closes a session of some servers.
        on_written: a WriteFile was ACKed, whose bytes went to what was open, or a CreateFile, which may have
            emptied a file after it was closed.
    """

    def __init__(
        self,
        holder: SessionHolder,
        is_shared: Callable[[], bool],
        on_taken: Callable[[str], None],
        on_emptied: Callable[[], None],
        on_disturbed: Callable[[], None],
        on_written: Callable[[Payload], None],
    ) -> None:
        self._holder = holder
        self._is_shared = is_shared
        self._on_taken = on_taken
        self._on_emptied = on_emptied
        self._on_disturbed = on_disturbed
        self._on_written = on_written

    def on_unknown(self, reply: Payload) -> None:
        """Take an answer that fits nothing outstanding."""
        if reply.req_opcode in _DISTURBING:
            self._on_disturbed()
        if reply.opcode == Opcode.ACK and reply.req_opcode == Opcode.WRITE_FILE:
            self._on_written(reply)
        if reply.opcode != Opcode.ACK or reply.req_opcode not in _OPENING:
            return
        path = self._holder.opener.opened_by(reply.seq)
        session = self._holder.session
        if reply.req_opcode == Opcode.CREATE_FILE and (session is None or session.seq != reply.seq):
            self._on_written(reply)
        changes = reply.req_opcode != Opcode.OPEN_FILE_RO
        if path is None:
            self._holder.opener.note_early(reply.seq, reply.session)
            # While a file is open it is none under way, but one of which nothing is known any more.
            if session is not None and session.id == reply.session and (changes or not session.writing):
                self._on_taken("a file was opened by a late request that had been forgotten")
            return
        if session is not None and session.writing and session.path == path and changes:
            self._on_emptied()
        if session is None or session.id != reply.session:
            if not self._is_shared():
                self._holder.opener.leave_open(reply.session, path)
                self._holder.wake()
        elif session.seq != reply.seq and (changes or not session.writing):
            self._on_taken(f"{path!r} was opened once more by a late request")
