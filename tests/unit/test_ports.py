"""The names of ports, and which users share one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from mavftpfs.link.ports import call, connect, is_ours, names_in_use, port_name, take_name
from mavftpfs.link.uri import parse_source
from mavftpfs.shared.errors import LinkClosed
from tests.support.vehicles import HOST, free_udp_port

NOBODY = 65534
as_root = pytest.mark.needs("root")
"""Only root can be another user."""


def test_what_excludes_each_other_has_one_name(tmp_path: Path) -> None:
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyACM0")
    groups = [
        ["udpin:0.0.0.0:14550", "udpin:127.0.0.1:14550", "udp::14550"],
        ["tcpin:0.0.0.0:14550", "tcpin::14550"],
        ["udpout:10.0.0.1:14550"],
        ["tcp:10.0.0.1:14550"],
        ["udpin:0.0.0.0:14551"],
        [f"{tmp_path}/ttyACM0", f"{tmp_path}/by-id,115200"],
    ]
    names = [{port_name(parse_source(source)) for source in group} for group in groups]
    assert [len(same) for same in names] == [1] * len(groups)
    assert len(set.union(*names)) == len(groups)


def test_a_name_ends_with_its_socket() -> None:
    spec = parse_source(f"udpin:{HOST}:{free_udp_port()}")
    name = port_name(spec)
    taken = take_name(name)
    assert taken is not None
    with taken:
        assert take_name(name) is None
        assert name in names_in_use()
        sock = call(name, spec)
        assert sock is not None
        sock.close()
    assert name not in names_in_use()
    assert call(name, spec) is None


@contextmanager
def as_nobody() -> Iterator[None]:
    user, group, groups = os.geteuid(), os.getegid(), os.getgroups()
    os.setgroups([])
    os.setegid(NOBODY)
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(user)
        os.setegid(group)
        os.setgroups(groups)


@as_root
@pytest.mark.holds("promise 10")
def test_another_user_s_claim_to_a_port_is_refused() -> None:
    spec = parse_source(f"udpin:{HOST}:{free_udp_port()}")
    with as_nobody():
        name = take_name(port_name(spec))
    assert name is not None
    with name, pytest.raises(LinkClosed, match=f"process {os.getpid()} of another user"):
        call(port_name(spec), spec)


@as_root
@pytest.mark.holds("promise 10")
def test_another_user_does_not_share_a_port_and_root_does() -> None:
    spec = parse_source(f"udpin:{HOST}:{free_udp_port()}")
    taken = take_name(port_name(spec))
    assert taken is not None
    with taken:
        with as_nobody():
            theirs = connect(port_name(spec))
        with theirs, taken.accept()[0] as caller:
            assert not is_ours(caller)
        with connect(port_name(spec)), taken.accept()[0] as caller:
            assert is_ours(caller)
