"""Bytes of a file that a late copy of another file's WriteFile may have overwritten. Layer: cache.

Where they are known here they are compared and sent again. Where only the vehicle had them nobody knows what
they were: closing the file fails until they are written again, or the file is.
"""

from __future__ import annotations

from mavftpfs.cache.base import read_base
from mavftpfs.cache.context import Context
from mavftpfs.cache.draft import Draft, Where
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.plan import Plan
from mavftpfs.cache.remote import Upload


async def fetch_endangered(context: Context, node: Node, plan: Plan) -> None:
    """Hold the few bytes of the base that copies of what was just tried out would hit in place.

    Raises:
        NoSpace; else as base.read_base.
    """
    draft = node.draft
    assert draft is not None
    if plan is not Plan.IN_PLACE:
        return
    with node.looking():
        for start, stop in context.writer.endangered(node.path):
            for where, a, b in draft.segments(start, stop):
                if where is Where.BASE:
                    draft.fill(a, await read_base(context, node, a, b, sure=True))


def overwritten(upload: Upload, draft: Draft) -> list[tuple[int, int]]:
    """Return the known bytes that are to be compared; the unknown ones are lost for the draft.

    Raises:
        DataUnproven: there are unknown ones.
    """
    whole = draft.sending is None or draft.sending.whole
    found: list[tuple[int, int]] = []
    for hit in upload.overwrites:
        stop = min(hit.stop, draft.size)
        if whole:
            found.append((min(hit.start, stop), stop))
            continue
        if hit.stop > draft.size:  # there is nothing to compare behind the end but the size
            draft.stretched = max(draft.stretched, hit.stop)
            found.append((draft.size, draft.size))
        if hit.same:
            found += draft.changed.intersection(hit.start, stop)
        else:
            found += draft.doubt(hit.start, stop)
    draft.require_sound()
    return found
