"""client.mounts: which vehicle of several is meant, and whether its mount is up."""

from __future__ import annotations

from typing import Any

import pytest

from mavftpfs.client.mounts import has_link, network_namespace, vehicle_below
from mavftpfs.link.uri import parse_source
from mavftpfs.shared.errors import LinkClosed, MavftpfsError, NotFound, UsageError
from mavftpfs.shared.options import Options

ONE = {"name": "1", "state": "mounted", "problem": None}
TWO = {"name": "2", "state": "starting", "problem": None}
THREE = {"name": "3", "state": "failed", "problem": "no MAVLink FTP"}


def below(members: list[dict[str, Any]], subtree: bytes = b"/", **options: Any) -> str:
    return vehicle_below({"mountpoint": "/mnt", "members": members}, subtree, Options(**options))


def test_a_mount_of_all_vehicles_is_none_that_has_the_link() -> None:
    told = {"source": "udpin:0.0.0.0:14550", "network_namespace": network_namespace()}
    spec = parse_source("udpin:127.0.0.1:14550")
    assert has_link({**told, "vehicle": {}}, spec)
    assert not has_link({**told, "members": []}, spec)
    assert not has_link({**told, "vehicle": {}, "network_namespace": "4:7"}, spec)


def test_a_vehicle_is_named_or_the_only_one() -> None:
    assert below([ONE]) == "/mnt/1"
    assert below([ONE, TWO], target_system=1) == "/mnt/1"


@pytest.mark.parametrize(
    ("subtree", "system", "kind", "said"),
    [
        (b"/", 0, UsageError, r"several vehicles \(1, 2, 3\)"),
        (b"/9/log", 0, NotFound, "no vehicle is mounted on /mnt/9"),
        (b"/", 9, LinkClosed, "no vehicle 9 is mounted"),
        (b"/", 2, LinkClosed, "vehicle 2 is not mounted below /mnt: starting"),
        (b"/", 3, LinkClosed, "vehicle 3 is not mounted below /mnt: no MAVLink FTP"),
    ],
)
def test_one_that_is_not_mounted_is_said_to_be_so(
    subtree: bytes, system: int, kind: type[MavftpfsError], said: str
) -> None:
    """A watch waits after LinkClosed."""
    with pytest.raises(kind, match=said):
        below([ONE, TWO, THREE], subtree, target_system=system)
