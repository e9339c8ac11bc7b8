"""report: facts as a person reads them."""

from __future__ import annotations

import pytest

from mavftpfs.report import describe, printable, readable_size


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("rtt", 0.02, "20 ms"),
        ("uptime", 12.34, "12.3 s"),
        ("bytes_held", 1536, "1.5 KiB"),
        ("armed", True, "yes"),
        ("anything", None, "unknown"),
        ("anything", [], "none"),
        ("transfers", [], "none"),
        ("anything", {}, "none"),
        ("names", ["a", "b"], "a, b"),
        ("window_rate", 5120.4, "5.0 KiB/s"),
        ("rate", None, "unknown"),
        ("loss", 0.052, "5.2 %"),
    ],
)
def test_describe(key: str, value: object, text: str) -> None:
    assert describe(key, value) == text


def test_transfers_show_how_far_they_are() -> None:
    sending = {"path": "/a", "size": 4096, "bytes_left": 1024, "sending": True, "eta": 3.4}
    waiting = {"path": "/b", "size": 0, "bytes_left": 0, "sending": False, "eta": None}
    assert describe("transfers", [sending, waiting]) == (
        "/a sending, 75 % of 4.0 KiB, 3 s left; /b waiting, empty of 0 B"
    )


def test_sizes_and_names() -> None:
    assert [readable_size(n) for n in (0, 1023, 1024, 1 << 20, 5 << 30)] == [
        "0 B",
        "1023 B",
        "1.0 KiB",
        "1.0 MiB",
        "5.0 GiB",
    ]
    assert printable("a\x1b[31mb") == "a?[31mb"
