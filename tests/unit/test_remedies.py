"""Who has the session after a refusal: the table of `session/remedies.py`."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.remedies import MOST_CLOSES, Holder, Tried, holder
from mavftpfs.shared.errors import FtpNak


def refused(code: int, *, retransmitted: bool = False) -> FtpNak:
    return FtpNak(Opcode.OPEN_FILE_RO, code, retransmitted=retransmitted)


@pytest.mark.parametrize("code", [NakCode.INVALID_SESSION, NakCode.NO_SESSIONS_AVAILABLE])
def test_a_session_is_ours_before_it_is_another_clients_or_a_gone_ones(code: int) -> None:
    nak, tried = refused(code), Tried(0.0, opens=True)
    assert holder(nak, tried, ours=True, another=True) is Holder.OURS
    assert holder(nak, tried, ours=False, another=True) is Holder.ANOTHER
    assert holder(nak, tried, ours=False, another=False) is Holder.GONE


def test_a_sticky_errno_hides_the_holder_of_an_open_once() -> None:
    nak, tried = refused(NakCode.FILE_EXISTS), Tried(0.0, opens=True)
    assert holder(nak, Tried(0.0, opens=False), ours=True, another=True) is Holder.NOBODY
    assert holder(nak, tried, ours=True, another=True) is Holder.HIDDEN
    tried.remedies[Holder.HIDDEN] += 1
    assert holder(nak, tried, ours=True, another=True) is Holder.OURS


def test_a_plain_failure_is_no_question_of_the_session_unless_the_file_is_ours() -> None:
    tried = Tried(0.0, opens=True)
    assert holder(refused(NakCode.FAIL), tried, ours=True, another=True) is Holder.OURS
    assert holder(refused(NakCode.FAIL), tried, ours=False, another=True) is Holder.NOBODY
    assert holder(refused(NakCode.FILE_NOT_FOUND), tried, ours=True, another=True) is Holder.NOBODY


def test_a_close_that_does_not_help_is_not_repeated_for_ever() -> None:
    tried = Tried(0.0, opens=True)
    tried.remedies[Holder.OURS] = MOST_CLOSES
    assert holder(refused(NakCode.FAIL), tried, ours=True, another=True) is Holder.NOBODY
    assert holder(refused(NakCode.NO_SESSIONS_AVAILABLE), tried, ours=True, another=False) is Holder.GONE
