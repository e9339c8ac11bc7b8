"""What is known of a directory's names without asking."""

from __future__ import annotations

from mavftpfs.session.foresight import Foresight


def take(foresight: Foresight, path: bytes) -> None:
    with foresight.moving_up(path):
        assert foresight.moves(path.rpartition(b"/")[0]) is None


def test_names_that_moved_up_are_noticed_however_many_directories_there_are() -> None:
    foresight = Foresight()
    take(foresight, b"/other/name")
    before = foresight.moves(b"/d")
    take(foresight, b"/d/name")
    for number in range(2000):
        take(foresight, b"/%d/name" % number)
    assert foresight.moves(b"/d") != before
    assert len(foresight._moved) <= 512


def test_names_of_other_directories_do_not_count() -> None:
    foresight = Foresight()
    take(foresight, b"/d/name")
    before = foresight.moves(b"/d")
    take(foresight, b"/other/name")
    assert foresight.moves(b"/d") == before
    take(foresight, b"/d/another")
    assert foresight.moves(b"/d") != before
