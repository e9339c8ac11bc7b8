"""The names of ports, and which users may share one."""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from mavftpfs.link.ports import call, may_share, names_in_use, port_name, take_name
from mavftpfs.link.uri import LinkSpec, parse_source
from mavftpfs.shared.errors import LinkClosed
from tests.support.vehicles import HOST, free_udp_port

NOBODY = 65534
as_root = pytest.mark.needs("root")
"""Only root can be another user."""


def serial(path: Path) -> LinkSpec:
    return parse_source(f"serial://{path}:57600")


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


def is_believed(spec: LinkSpec) -> bool:
    """Return whether another user who has the name of a port counts as having the port."""
    with as_nobody():
        name = take_name(port_name(spec))
    assert name is not None
    with name:
        try:
            sock = call(port_name(spec), spec)
        except LinkClosed:
            return False
        assert sock is not None
        sock.close()
        return True


@as_root
def test_another_user_has_a_port_only_where_that_user_may_open_it(tmp_path: Path) -> None:
    device = tmp_path / "tty"
    device.touch()
    device.chmod(0o660)
    assert is_believed(parse_source(f"udpin:{HOST}:{free_udp_port()}"))
    assert not is_believed(parse_source(f"tcp:{HOST}:{free_udp_port()}"))
    assert not is_believed(serial(device))
    device.chmod(0o666)
    assert is_believed(serial(device))


def access_list(user: int) -> bytes:
    """Return an ACL by which this user may read and write, and the file's group and others may not."""
    nobody = 0xFFFFFFFF
    entries = [(1, 6, nobody), (2, 6, user), (4, 0, nobody), (16, 6, nobody), (32, 0, nobody)]
    return struct.pack("<I", 2) + b"".join(struct.pack("<HHI", *entry) for entry in entries)


@as_root
@pytest.mark.parametrize("right", ["owner", "group", "access list", "none"])
def test_a_device_is_shared_with_those_who_may_open_it(tmp_path: Path, right: str) -> None:
    device = tmp_path / "tty"
    device.touch()
    device.chmod(0o660)
    os.chown(device, *(NOBODY if right == one else 0 for one in ("owner", "group")))
    if right == "access list":
        os.setxattr(device, "system.posix_acl_access", access_list(NOBODY))
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as name:
        name.bind("")  # the kernel chooses a name
        name.listen()
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
            with as_nobody():
                sock.connect(name.getsockname())
            theirs, _ = name.accept()
            with theirs:
                assert may_share(theirs, serial(device)) is (right != "none")
