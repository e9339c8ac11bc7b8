"""client.mounts: which vehicle of several is meant, and whether its mount is up."""

from __future__ import annotations

from mavftpfs.client.mounts import has_link, network_namespace
from mavftpfs.link.uri import parse_source


def test_a_mount_of_all_vehicles_is_none_that_has_the_link() -> None:
    told = {"source": "udpin:0.0.0.0:14550", "network_namespace": network_namespace(), "version": "1.0.0"}
    spec = parse_source("udpin:127.0.0.1:14550")
    assert has_link({**told, "vehicle": {}}, spec)
    assert not has_link({**told, "members": []}, spec)
    assert not has_link({**told, "vehicle": {}, "network_namespace": "4:7"}, spec)


def test_a_mount_of_0_2_has_its_link_and_one_without_an_answer_has_none() -> None:
    told = {"mountpoint": "/mnt/old", "source": "udpin:0.0.0.0:14550"}
    spec = parse_source("udpin:127.0.0.1:14550")
    assert has_link({**told, "version": "0.2.0"}, spec)
    assert not has_link({**told, "version": "0.2.0", "source": "udpin:0.0.0.0:14551"}, spec)
    assert not has_link({**told, "state": "dead"}, spec)
