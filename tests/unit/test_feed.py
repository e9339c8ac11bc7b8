"""What an upload keeps of what it sent, to know its file by."""

from __future__ import annotations

from mavftpfs.session.upload import Feed
from tests.support.sources import MemorySource

CHUNK = 100


def test_bytes_that_went_out_twice_prove_nothing() -> None:
    """A copy of the older ones may come late, and is found and mended when the file is compared."""
    source = MemorySource(bytes(150))
    feed = Feed(source, CHUNK)

    def send(start: int, stop: int) -> None:
        source.proven.discard(start, stop)
        source.dirty.add(start, stop)
        assert feed.next_chunk(CHUNK) is not None
        feed.on_acked(start, stop - start)
        feed.check_point()

    source.dirty.clear()
    send(0, 50)
    assert feed.proof == (0, bytes(50))
    send(40, 90)  # begins before the end of what was sent
    assert feed.proof is None
    send(50, 90)
    assert feed.proof is None
    send(90, 120)
    assert feed.proof == (90, bytes(30))


def test_no_more_is_kept_than_is_asked_for_at_once() -> None:
    source = MemorySource(bytes(range(250)))
    feed = Feed(source, CHUNK)
    feed.next_chunk(250)
    feed.on_acked(0, 250)
    feed.check_point()
    assert feed.proof == (0, bytes(range(CHUNK)))
