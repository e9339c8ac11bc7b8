"""`@MISSION` as texts: a mission, a fence, rally points. Layer: cache.

Saving replaces all items, and only reading back tells whether the vehicle took them: it ACKs what it refuses
(docs/servers.md 17).
"""

from __future__ import annotations

from collections.abc import Sequence

from mavftpfs.cache.attributes import SECOND
from mavftpfs.cache.card import Card
from mavftpfs.cache.texts import Refused, Save, Saved, Shown, Texts, cause_of, problems_refused
from mavftpfs.cache.virtual import VirtualTrees
from mavftpfs.parameters.missions import (
    FENCE,
    MISSION,
    RALLY,
    Difference,
    Item,
    differences,
    pack_upload,
    parse,
    render,
    unpack,
)
from mavftpfs.parameters.text import Problem
from mavftpfs.shared.errors import MavftpfsError

DIRECTORY = b"/@MISSION"
KINDS = {b"mission.waypoints": MISSION, b"fence.waypoints": FENCE, b"rally.waypoints": RALLY}

Items = Sequence[Item]


class Missions(Texts[Items]):
    """The texts of `@MISSION`."""

    directory = DIRECTORY
    names = tuple(KINDS)

    def __init__(self, card: Card, virtual: VirtualTrees) -> None:
        super().__init__(card, virtual)
        self._shown: dict[bytes, tuple[bytes, Shown[Items]]] = {}

    def forget(self) -> None:
        """See Texts."""
        self._shown.clear()

    async def show(self, name: bytes, *, reread: bool) -> Shown[Items]:
        """See Texts."""
        raw = await self._virtual.content(_file_of(name), reread=reread)
        known = self._shown.get(name)
        if known is not None and known[0] == raw:
            return known[1]
        raw, items = await self.parsed(_file_of(name), raw, lambda raw: unpack(raw, KINDS[name]))
        shown: Shown[Items] = Shown(render(items).encode(), items, int(self._wall() * SECOND))
        self._shown[name] = raw, shown
        return shown

    async def carry_out(self, save: Save[Items]) -> Saved[Items]:
        """See Texts."""
        if save.appended:
            raise problems_refused(
                save.name, [Problem(1, "a mission is written as a whole, not appended to")]
            )
        try:
            wanted, problems = parse(save.text.decode())
        except UnicodeDecodeError:
            wanted, problems = [], [Problem(1, "this is no text")]
        if problems:
            raise problems_refused(save.name, problems)
        kind = KINDS[save.name]
        if not differences(wanted, (await self.show(save.name, reread=True)).base, kind):
            return Saved()
        found = await self._replace(save.name, wanted)
        return Saved(sent=True, notes=[f"{one.text} (the vehicle does not keep it)" for one in found])

    async def _replace(self, name: bytes, wanted: Items) -> list[Difference]:
        """Replace all items, read them back, and return the differences that the vehicle cannot keep.

        Raises:
            Refused: the vehicle has other items afterwards.
        """
        kind = KINDS[name]
        failure = await self.send(name, _file_of(name), [pack_upload(wanted, kind, self._store.address())])
        try:
            found = differences(wanted, (await self.show(name, reread=True)).base, kind)
        except MavftpfsError as error:
            raise Refused(
                failure or error, [f"{failure or error}; it is not known whether it was set"]
            ) from error
        missed = [one.text for one in found if one.kept]
        if not missed:
            return found
        why = cause_of(failure, f"the vehicle has not taken it: {missed[0]}")
        raise Refused(why, [str(why), *missed])


def _file_of(name: bytes) -> bytes:
    return DIRECTORY + b"/" + name.partition(b".")[0] + b".dat"
