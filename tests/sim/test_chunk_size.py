"""Which chunk size reads most over a link that damages bytes, on virtual time: chunk=auto begins with 239."""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.payload import MAX_DATA
from mavftpfs.protocol.transfers import ReadTransfer
from mavftpfs.sim.linkmodel import Duplex, LinkSettings
from tests.sim.test_engine_profiles import Rig
from tests.support.virtual import MemorySink

RATE = 5760.0
SIZE = 200_000
SMALLER = (180, 110, 64)


def goodput(chunk: int, byte_loss: float, duplex: Duplex) -> float:
    """Return the share of the rate that is file, from the first request to the last byte."""
    rig = Rig("px4", LinkSettings(rate=RATE, delay=0.05, byte_loss=byte_loss, duplex=duplex, queue=8192))
    data = random.Random(1).randbytes(SIZE)
    rig.tree.add(b"/d/f", data)
    assert rig.open(b"/d/f") == SIZE
    link, sink = rig.link, MemorySink(SIZE)
    transfer = ReadTransfer(rig.session, SIZE, sink, chunk)
    transfer.want(0, SIZE, True)
    began = link.now
    link.engine.start(transfer, began)
    link.run_until(lambda: transfer.done or transfer.idle)
    assert transfer.error is None
    assert sink.data == data
    return SIZE / (link.now - began) / RATE


@pytest.mark.parametrize("duplex", list(Duplex))
@pytest.mark.parametrize("byte_loss", [0.0, 1e-4, 4e-4])
def test_none_are_better_than_full_ones_up_to_a_tenth_of_them_lost(byte_loss: float, duplex: Duplex) -> None:
    full = goodput(MAX_DATA, byte_loss, duplex)
    assert all(full > 0.99 * goodput(chunk, byte_loss, duplex) for chunk in SMALLER)


def test_smaller_ones_win_where_two_of_five_full_ones_are_lost() -> None:
    """So bad is no link that anybody flies with; the model does show what smaller ones are there for."""
    assert goodput(110, 2e-3, Duplex.FULL) > 1.1 * goodput(MAX_DATA, 2e-3, Duplex.FULL)
