"""Did a change of names happen? Layer: session; pure.

A change defines the state of each of its names afterwards (`After`). A listing of the directory is evidence
for each name, and the evidence for all names together is the verdict. An incomplete listing shows which names
exist, and proves no absence.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum

from mavftpfs.shared.model import EntryKind, Listing


class Outcome(Enum):
    """The verdict of listings on a requested change."""

    HAPPENED = "happened"
    """The server carried it out."""
    DID_NOT = "did not"
    """The server did not carry it out."""
    CONFLICT = "conflict"
    """The listings fit neither: another kind of entry has a name, or both names of a rename exist, or
    none."""
    UNKNOWN = "unknown"
    """The listings failed, or are incomplete."""


class After(Enum):
    """The state of a name after a change."""

    PRESENT = "present"
    ABSENT = "absent"
    DIRECTORY = "an empty directory"


def judge(listing: Listing, name: bytes, after: After) -> Outcome:
    """Return a listing's evidence about one name of a change."""
    entry = next((entry for entry in listing.entries if entry.name == name), None)
    if entry is None and not listing.complete:
        return Outcome.UNKNOWN
    if (entry is None) != (after is After.ABSENT):
        return Outcome.DID_NOT
    wrong = after is After.DIRECTORY and entry is not None and entry.kind is not EntryKind.DIRECTORY
    return Outcome.CONFLICT if wrong else Outcome.HAPPENED


def together(evidence: Iterable[Outcome]) -> Outcome:
    """Return the verdict on a change from the evidence for each of its names."""
    found = set(evidence)
    if found == {Outcome.HAPPENED}:
        return Outcome.HAPPENED
    if Outcome.CONFLICT in found or found >= {Outcome.HAPPENED, Outcome.DID_NOT}:
        return Outcome.CONFLICT
    return Outcome.DID_NOT if Outcome.DID_NOT in found else Outcome.UNKNOWN
