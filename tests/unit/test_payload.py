"""The 251-byte payload: layout, ranges, refusal of what does not fit."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.payload import (
    Payload,
)
from mavftpfs.shared.errors import LocalProtocolError


@pytest.mark.parametrize(
    "bad", [Payload(65536, 0, 0, 0), Payload(0, -1, 0, 0), Payload(0, 0, 0, 0, data=bytes(240))]
)
def test_what_does_not_fit_is_our_fault(bad: Payload) -> None:
    with pytest.raises(LocalProtocolError):
        bad.encode()
