"""SOURCE in both spellings, and which of them are one link."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mavftpfs.link.samelink import leads_back, same_link
from mavftpfs.link.uri import LinkKind, LinkSpec, parse_endpoint, parse_source
from mavftpfs.shared.errors import UsageError

K = LinkKind

GOOD = [
    ("udpin:0.0.0.0:14550", LinkSpec(K.UDP_IN, "0.0.0.0", 14550)),
    ("udp:0.0.0.0:14550", LinkSpec(K.UDP_IN, "0.0.0.0", 14550)),
    ("udpin::14551", LinkSpec(K.UDP_IN, "0.0.0.0", 14551)),
    ("udpin://0.0.0.0:14550", LinkSpec(K.UDP_IN, "0.0.0.0", 14550)),
    ("udpin://0.0.0.0:14550/", LinkSpec(K.UDP_IN, "0.0.0.0", 14550)),
    ("UDPIN:127.0.0.1:14550", LinkSpec(K.UDP_IN, "127.0.0.1", 14550)),
    ("udpout:drone.local:14555", LinkSpec(K.UDP_OUT, "drone.local", 14555)),
    ("udpout://10.0.0.1:14555", LinkSpec(K.UDP_OUT, "10.0.0.1", 14555)),
    ("tcp:127.0.0.1:5760", LinkSpec(K.TCP_OUT, "127.0.0.1", 5760)),
    ("tcp://127.0.0.1:5760", LinkSpec(K.TCP_OUT, "127.0.0.1", 5760)),
    ("tcpout://127.0.0.1:5760", LinkSpec(K.TCP_OUT, "127.0.0.1", 5760)),
    ("tcpin:0.0.0.0:5760", LinkSpec(K.TCP_IN, "0.0.0.0", 5760)),
    ("tcpin://[::]:5760", LinkSpec(K.TCP_IN, "::", 5760)),
    ("udpout:[fe80::1]:14550", LinkSpec(K.UDP_OUT, "fe80::1", 14550)),
    ("udpin:[::1]:14550", LinkSpec(K.UDP_IN, "::1", 14550)),
    ("/dev/ttyACM0", LinkSpec(K.SERIAL, device="/dev/ttyACM0", baud=57600)),
    ("/dev/ttyUSB0,921600", LinkSpec(K.SERIAL, device="/dev/ttyUSB0", baud=921600)),
    ("/dev/serial/by-path/pci-0:1.0", LinkSpec(K.SERIAL, device="/dev/serial/by-path/pci-0:1.0")),
    ("serial:///dev/ttyUSB0:57600", LinkSpec(K.SERIAL, device="/dev/ttyUSB0", baud=57600)),
    ("serial:///dev/ttyUSB0", LinkSpec(K.SERIAL, device="/dev/ttyUSB0")),
    ("serial:/dev/ttyUSB0:115200", LinkSpec(K.SERIAL, device="/dev/ttyUSB0", baud=115200)),
    ("serial:///dev/ttyUSB0,115200", LinkSpec(K.SERIAL, device="/dev/ttyUSB0", baud=115200)),
]


@pytest.mark.parametrize(("text", "spec"), GOOD)
def test_spellings(text: str, spec: LinkSpec) -> None:
    assert parse_source(text) == spec


@pytest.mark.parametrize(("text", "spec"), GOOD)
@pytest.mark.parametrize(
    ("tail", "subtree"),
    [
        ("#/fs/microsd", b"/fs/microsd"),
        ("#/a//b/./", b"/a/b"),
        ("#@SYS", b"/@SYS"),
        ("#/caf\udce9", b"/caf\xe9"),
    ],
)
def test_subtree(text: str, spec: LinkSpec, tail: str, subtree: bytes) -> None:
    assert parse_source(text + tail) == replace(spec, subtree=subtree)


@pytest.mark.parametrize("spec", [spec for _, spec in GOOD])
def test_description_parses_to_the_same(spec: LinkSpec) -> None:
    assert parse_source(spec.description) == spec


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "empty"),
        ("#/fs", "empty"),
        ("ttyACM0", "neither a device path nor a link"),
        ("carrier-pigeon:3", "unknown kind of link 'carrier-pigeon'"),
        ("udpout:", "names no host"),
        ("udpout::14550", "names no host"),
        ("udpin:127.0.0.1", "names no port; write for example udpin:127.0.0.1:14550"),
        ("tcp:127.0.0.1", "names no port; write for example tcp:127.0.0.1:5760"),
        ("udpout:[::1]", "names no port; write for example udpout:[::1]:14550"),
        ("udpin:", "names no port; write for example udpin:0.0.0.0:14550"),
        ("udpin:14550", "a host comes before the port"),
        ("tcp:", "names no host"),
        ("udpin:0.0.0.0:port", "'port' is not a port"),
        ("udpin:0.0.0.0:65536", "'65536' is not a port"),
        ("udpin:0.0.0.0:-1", "'-1' is not a port"),
        ("udpin:0.0.0.0:²", "is not a port"),
        ("tcp:127.0.0.1:0", "'0' is not a port"),
        ("udpin:::1:14550", "IPv6 in brackets"),
        ("udpin:[::1:14550", "bracket not closed"),
        ("udpin:[::1]14550", "bracket not closed"),
        ("/dev/ttyUSB0,fast", "'fast' is not a baud rate"),
        ("/dev/ttyUSB0,0", "'0' is not a baud rate"),
        ("/dev/ttyUSB0,", "'' is not a baud rate"),
        ("serial:///dev/ttyUSB0:x", "'x' is not a baud rate"),
        ("serial:ttyUSB0", "neither a device path nor a link"),
        ("udpin:0.0.0.0:14550#fs", "must begin with '/'"),
        ("udpin:0.0.0.0:14550#", "must begin with '/'"),
        ("udpin:0.0.0.0:14550#/a/../b", "may not hold '..'"),
    ],
)
def test_errors_say_what_is_wrong_and_what_is_right(text: str, says: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_source(text)
    message = str(caught.value)
    assert says in message
    assert "\n" not in message
    assert "for example" in message


@pytest.mark.parametrize(
    ("text", "description"),
    [
        ("udpout:127.0.0.1:14550", "udpout:127.0.0.1:14550"),
        ("udpin::14551", "udpin:127.0.0.1:14551"),
        ("tcpin://:5760", "tcpin:127.0.0.1:5760"),
        ("tcpin:0.0.0.0:5760", "tcpin:0.0.0.0:5760"),
        ("serial:///dev/ttyUSB1:57600", "/dev/ttyUSB1,57600"),
    ],
)
def test_an_endpoint_listens_for_this_computer_unless_it_says_otherwise(text: str, description: str) -> None:
    assert parse_endpoint(text).description == description
    assert parse_endpoint(description).description == description


def test_an_endpoint_has_no_directory() -> None:
    with pytest.raises(UsageError, match="cannot name a directory"):
        parse_endpoint("udpout:127.0.0.1:14550#/fs")


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("udpin:0.0.0.0:14550", "udpin://127.0.0.1:14550", True),
        ("udpin:0.0.0.0:14550", "udpin:0.0.0.0:14551", False),
        ("udpin:0.0.0.0:14550#/fs", "udpin:0.0.0.0:14550", True),
        ("udpout:10.0.0.1:14550", "udpout:10.0.0.2:14550", False),
        ("udpin:127.0.0.1:14550", "udpout:127.0.0.1:14550", False),
        ("/dev/null,57600", "/dev/../dev/null,921600", True),
        ("/dev/null", "/dev/zero", False),
    ],
)
def test_the_same_link(one: str, other: str, same: bool) -> None:
    assert same_link(parse_source(one), parse_source(other)) is same


@pytest.mark.parametrize(
    ("endpoint", "source", "back"),
    [
        ("udpout:127.0.0.1:14550", "udpin:0.0.0.0:14550", True),
        ("udpout:localhost:14550", "udpin:127.0.0.1:14550", True),
        ("udpout:[::1]:14550", "udpin:[::]:14550", True),
        ("udpout:127.0.0.1:14551", "udpin:0.0.0.0:14550", False),
        ("udpout:203.0.113.9:14550", "udpin:0.0.0.0:14550", False),
        ("udpout:127.0.0.2:14550", "udpin:127.0.0.1:14550", False),
        ("udpout:station.invalid:14550", "udpin:0.0.0.0:14550", False),
        ("udpin:127.0.0.1:14550", "udpout:127.0.0.1:14550", True),
        ("tcp:127.0.0.1:5760", "tcpin:0.0.0.0:5760", True),
        ("tcp:127.0.0.1:5760", "udpin:0.0.0.0:5760", False),
        ("/dev/null", "/dev/null", True),
    ],
)
def test_an_endpoint_that_leads_back(endpoint: str, source: str, back: bool) -> None:
    assert leads_back(parse_source(endpoint), parse_source(source)) is back
