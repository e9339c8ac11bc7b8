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
    """An identity that counts what it tells. doubts: questions wanted; trusted: how often it was trusted
    again; strangers: what on_stranger was told."""

    def __init__(self) -> None:
        self.doubts = self.trusted = 0
        self.strangers: list[bool] = []
        super().__init__(self._count, self._count_trusted, self.strangers.append, PATIENCE)

    def _count(self) -> None:
        self.doubts += 1

    def _count_trusted(self) -> None:
        self.trusted += 1


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
    identity.heard(20.0)
    assert (identity.doubts, identity.left_at) == (1, 10.0)
    identity.heard(21.0)
    identity.reopened()
    assert (identity.doubts, identity.left_at) == (2, 21.0)


def test_another_id_is_a_stranger_s_until_ours_is_told() -> None:
    identity = Watched()
    identity.told(version(1))
    assert not identity.told(version(2))
    assert not identity.told(version(2))
    assert (identity.doubts, identity.strangers) == (1, [True]), "that is told once"
    assert standing(identity) is Standing.STRANGER
    identity.doubt()  # it went: the next one may be ours
    assert standing(identity) is Standing.DOUBTED
    assert identity.told(version(1))
    assert standing(identity) is Standing.TRUSTED
    identity.told(version(2))
    assert identity.told(version(1))
    assert identity.trusted == 2


@pytest.mark.parametrize("period", [1.0, 3.0])
def test_a_vehicle_that_told_its_id_and_does_not_tell_it_again_is_a_stranger_in_the_end(
    period: float,
) -> None:
    """Silences between its heartbeats do not make the time begin again, and do not count."""
    identity = Watched()
    identity.heard(0.0)
    identity.told(version(1))
    beats = [1000.0 + period * count for count in range(int(PATIENCE / min(period, ABSENCE)) + 2)]
    for beat in beats[:-4]:
        identity.heard(beat)
        assert standing(identity) is Standing.DOUBTED
    for beat in beats[-4:]:
        if not identity.strangers:
            identity.heard(beat)
    assert standing(identity) is Standing.STRANGER
    assert identity.told(version(1))
    assert (identity.strangers, identity.trusted) == ([False], 1)


def test_one_that_never_told_an_id_need_not_tell_one() -> None:
    identity = Watched()
    identity.heard(0.0)
    identity.reopened()
    for second in range(10, 10 + 2 * int(PATIENCE)):
        identity.heard(float(second))
    assert standing(identity) is Standing.TRUSTED
