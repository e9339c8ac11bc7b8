"""mftp URLs."""

from __future__ import annotations

import pytest

from mavftpfs.protocol.url import MftpUrl, parse_url
from mavftpfs.shared.errors import UsageError


@pytest.mark.parametrize(
    ("text", "component", "path"),
    [
        ("mftp:///fs/microsd/log", None, b"/fs/microsd/log"),
        ("mftp://fs/microsd/log", None, b"/fs/microsd/log"),
        ("MFTP://a", None, b"/a"),
        ("mftp://comp=100:/a/b", 100, b"/a/b"),
        ("mftp://[comp=100:]/a/b", 100, b"/a/b"),
        ("mftp://[comp=1:]@SYS/uarts.txt", 1, b"/@SYS/uarts.txt"),
        ("mftp://comp=1:@SYS/uarts.txt", 1, b"/@SYS/uarts.txt"),
        ("mftp://@SYS/uarts.txt", None, b"/@SYS/uarts.txt"),
        ("mftp://@PARAM/param.pck?withdefaults=1", None, b"/@PARAM/param.pck?withdefaults=1"),
        ("mftp://[;comp=1]/general.json", 1, b"/general.json"),
        ("mftp://[;comp=255]etc/general.json", 255, b"/etc/general.json"),
        ("mftp:///[;comp=7]/a", 7, b"/a"),
        ("mftp://comp=3:", 3, b"/"),
        ("mftp://", None, b"/"),
        ("mftp:///a%20b%2Fc%ff", None, b"/a b/c\xff"),
        ("mftp:///caf\udce9", None, b"/caf\xe9"),
        ("mftp:///comp=3:x", None, b"/comp=3:x"),
        ("mftp:///a//./b/", None, b"/a/b"),
    ],
)
def test_both_spellings(text: str, component: int | None, path: bytes) -> None:
    assert parse_url(text) == MftpUrl(component, path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("/fs/microsd", "is no mftp URL"),
        ("http://a", "is no mftp URL"),
        ("mftp://comp=:/a", "component ''"),
        ("mftp://comp=0:/a", "component '0'"),
        ("mftp://comp=256:/a", "component '256'"),
        ("mftp://comp=x:/a", "component 'x'"),
        ("mftp://[;comp=1/a", "not closed"),
        ("mftp://[;comp=]a", "component ''"),
        ("mftp://comp=1", "not closed"),
        ("mftp://[comp=1:/a", "not closed"),
        ("mftp://[comp=1]/a", "not closed"),
        ("mftp://[comp=:]/a", "component ''"),
        ("mftp://comp=1/a:b", "not closed"),
        ("mftp:///a%2", "two hex digits"),
        ("mftp:///a%zz", "two hex digits"),
        ("mftp:///a%00", "NUL"),
        ("mftp:///a/%2e%2e/b", "'..'"),
    ],
)
def test_errors(text: str, says: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_url(text)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
