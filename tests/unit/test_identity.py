"""Identity: whether the vehicle that answers is the one that was there at first."""

from __future__ import annotations

import pytest

from mavftpfs.link.messages import Address, AutopilotVersion
from mavftpfs.session.vehicle import ABSENCE, Identity, Standing, is_another

pytestmark = pytest.mark.holds("fault another vehicle")

VEHICLE = Address(1, 1)
PATIENCE = 30.0


def version(uid: int = 0, uid2: int = 0) -> AutopilotVersion:
    return AutopilotVersion(VEHICLE, 0, 0, uid, uid2.to_bytes(18))


def standing(identity: Identity) -> Standing:
    """Without what a type checker remembers of it."""
    return identity.standing


class Watched(Identity):
    """An identity that counts what it tells. doubts: questions wanted; trusted: what on_trusted was told."""

    def __init__(self) -> None:
        self.doubts = 0
        self.trusted: list[bool] = []
        super().__init__(self._count, self.trusted.append, PATIENCE)

    def _count(self) -> None:
        self.doubts += 1


@pytest.mark.parametrize(
    ("known", "told", "another"),
    [
        (version(1), version(1), False),
        (version(1), version(2), True),
        (version(1, 7), version(1, 8), True),
        (version(0, 7), version(0, 8), True),
        (version(1, 7), version(1), False),
        (version(1), version(1, 7), False),
        (version(1), version(0, 7), False),
        (version(1, 7), version(), False),
    ],
)
def test_what_tells_two_boards_apart(known: AutopilotVersion, told: AutopilotVersion, another: bool) -> None:
    assert is_another(known, told) is another


def test_it_may_have_restarted_while_it_was_away() -> None:
    identity = Watched()
    identity.heard(10.0)
    assert identity.may_be_asked(1000.0), "it never told its id"
    identity.told(version(1))
    assert identity.may_be_asked(10.0 + ABSENCE)
    assert not identity.may_be_asked(10.1 + ABSENCE), "not into a silence"
    assert not identity.away_since(10.0, 10.0 + ABSENCE)
    assert identity.away_since(10.0, 10.1 + ABSENCE)
    identity.heard(20.0)
    assert identity.doubts == 1
    assert identity.away_since(10.0, 20.0)
    assert not identity.away_since(20.0, 20.0)
    identity.reopened(20.5)
    assert identity.doubts == 2
    assert identity.away_since(20.0, 20.5)


def test_another_id_is_a_stranger_s_until_ours_is_told() -> None:
    identity = Watched()
    identity.told(version(1))
    assert not identity.told(version(2))
    assert identity.doubts == 1
    assert standing(identity) is Standing.STRANGER
    identity.doubt()  # it went: the next one may be ours
    assert standing(identity) is not Standing.STRANGER
    assert standing(identity) is not Standing.TRUSTED
    assert identity.told(version(1))
    assert standing(identity) is Standing.TRUSTED
    assert identity.trusted == [True]


@pytest.mark.parametrize("silences", [False, True])
def test_a_vehicle_that_told_its_id_and_does_not_tell_it_again_is_a_stranger_in_the_end(
    silences: bool,
) -> None:
    """Silences between the questions do not make the time begin again; before it is heard no time runs."""
    identity = Watched()
    identity.heard(0.0)
    identity.told(version(1))
    identity.doubt()
    assert not identity.expire(1000.0)
    for beat in range(1000, 1000 + int(PATIENCE), 3 if silences else 1):
        identity.heard(float(beat))
        assert not identity.expire(float(beat))
        assert standing(identity) is Standing.DOUBTED
    assert identity.expire(1000.1 + PATIENCE)
    assert standing(identity) is Standing.STRANGER
    assert not identity.expire(1001.0 + PATIENCE), "that is told once"
    assert identity.told(version(1))
    assert identity.trusted == [True]


def test_one_that_never_told_an_id_need_not_tell_one() -> None:
    identity = Watched()
    identity.heard(0.0)
    identity.reopened(10.0)
    identity.heard(10.0)
    assert not identity.expire(10.0 + 2 * PATIENCE)
    assert standing(identity) is Standing.TRUSTED
