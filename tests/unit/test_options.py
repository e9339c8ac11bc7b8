"""Every word that `-o` may hold, and the library's keywords."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import fields
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavftpfs.client.options import GONE, at_source, options_of
from mavftpfs.link.uri import parse_source
from mavftpfs.mount.options import (
    IGNORED_WORDS,
    KERNEL_WORDS,
    option_help,
    parse_options,
    permissions,
)
from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.options import TABLE, Options
from tests.support.optiontable import option_table, told_table

DEFAULTS = {field.name: field.default for field in fields(Options)}
ELSEWHERE = {"root", "baud", "local", "kernel_words", "gone"}
"""Fields that SOURCE, words of 0.2 or for the kernel, and the library set."""


def test_each_field_is_a_row_of_the_table() -> None:
    assert {row.field for row in TABLE.rows} == DEFAULTS.keys() - ELSEWHERE
    assert not {*TABLE.values, *TABLE.words} & (KERNEL_WORDS | IGNORED_WORDS)


def test_each_value_option_takes_its_own_default() -> None:
    for name, row in TABLE.values.items():
        default = DEFAULTS[name]
        if default:
            assert TABLE.parsed(name, row.default, {}) == default


@pytest.mark.parametrize(
    "word", [*sorted(IGNORED_WORDS), "x-gvfs-show", "comment=systemd.automount", "user=x"]
)
def test_words_for_others_are_ignored(word: str) -> None:
    assert parse_options([word]) == Options()


@pytest.mark.parametrize(
    ("text", "field", "value"),
    [
        ("uid=1000", "uid", 1000),
        ("umask=022", "umask", 0o022),
        ("read_mode=burst", "read_mode", "burst"),
        ("dir_timeout=0.5", "dir_timeout", 0.5),
        ("cache_size=2g", "cache_size", 2 << 30),
        ("chunk=110", "chunk", 110),
        ("tlog=a=b", "tlog", "a=b"),
        (r"tlog=a\,b", "tlog", "a,b"),
        ("allow_other", "allow_other", True),
        ("ro", "read_only", True),
    ],
)
def test_values(text: str, field: str, value: object) -> None:
    options = parse_options([text])
    assert getattr(options, field) == value


def test_the_last_word_wins() -> None:
    options = parse_options(["ro,uid=1", "rw,uid=2"])
    assert (options.read_only, options.uid) == (False, 2)
    assert parse_options(["async,sync,async"]).kernel_words == ("async",)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("frobnicate", "frobnicate"),
        ("max_read=131072", "max_read"),
        ("remount", "unmount, and mount"),
        ("uid", "uid"),
        ("uid=-1", "uid"),
        ("ro=1", "ro"),
        ("read_mode=fast", "read_mode"),
        ("dir_timeout=inf", "dir_timeout"),
        ("source_system=0", "source_system"),
        ("chunk=²", "chunk"),
        ("root=", "root"),
        ("root=/a/../b", "root"),
        ("tlog=", "tlog"),
        ("tlog", "tlog"),
        ("cache_size=3x", "with K, M or G"),
        ("cache_size=1K", "within 1M and 1024G"),
        ("chunk=64K", "whole number, or auto"),
        ("op_deadline=soon", "number of seconds"),
        ("op_deadline=nan", "within 1 and 3600"),
        ("umask=9", "octal"),
    ],
)
def test_wrong_words_are_named(text: str, named: str) -> None:
    with pytest.raises(UsageError, match=named):
        parse_options([f"rw,{text},dev"])


@given(st.text(max_size=40))
def test_any_text_is_parsed_or_refused(text: str) -> None:
    with suppress(UsageError):
        assert isinstance(parse_options([text]), Options)


@pytest.mark.parametrize(
    ("keywords", "text"),
    [
        ({"ro": True, "inplace": False}, "ro"),
        ({"ro": False}, "rw"),
        ({"rw": False}, "ro"),
        ({"cache_size": "1G", "target_system": 2, "baud": None}, "cache_size=1G,target_system=2"),
        ({"cache_size": 1 << 30, "op_deadline": 2.5}, "cache_size=1G,op_deadline=2.5"),
        ({"chunk": "auto", "tlog": b"a"}, "chunk=auto,tlog=a"),
        ({"tlog": Path("a/b")}, "tlog=a/b"),
    ],
)
def test_keywords_say_what_words_say(keywords: dict[str, object], text: str) -> None:
    assert options_of(keywords) == parse_options([text])


@pytest.mark.parametrize(
    ("keywords", "named"),
    [
        ({"frobnicate": 1}, "unknown option 'frobnicate'"),
        ({"uid": 0}, "unknown option 'uid'"),
        ({"read_only": True}, "unknown option 'read_only'"),
        ({"ro": "yes"}, "option ro is True or False"),
        ({"target_system": True}, "option target_system cannot be True"),
        ({"target_system": 2.5}, "target_system=2.5: must be a whole number"),
        ({"tlog": ["a"]}, "option tlog cannot be"),
        ({"verify": "perhaps"}, "unknown option 'verify'"),
        ({"cache_size": 1}, "cache_size=1: must be within"),
    ],
)
def test_wrong_keywords_are_named(keywords: dict[str, object], named: str) -> None:
    with pytest.raises(UsageError, match=named):
        options_of(keywords)


@pytest.mark.parametrize(
    ("text", "files", "directories"),
    [
        ("", 0o644, 0o755),
        ("ro", 0o444, 0o555),
        ("umask=077", 0o600, 0o700),
        ("umask=0,ro", 0o444, 0o555),
        ("fmask=0111,dmask=0", 0o666, 0o777),
        ("umask=077,fmask=022", 0o644, 0o700),
    ],
)
def test_modes(text: str, files: int, directories: int) -> None:
    options = parse_options([text])
    assert permissions(options, 0o666, options.fmask, 0o022) == files
    assert permissions(options, 0o777, options.dmask, 0o022) == directories


def test_default_permissions_is_always_on() -> None:
    assert parse_options(["default_permissions"]) == parse_options(["", " , "]) == Options()


def test_the_guide_has_the_table() -> None:
    assert told_table() == option_table(), "run: python -m tests.support.optiontable"


# --- words of 0.2 ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "word",
    [
        "auto_unmount",
        r"fsname=my drone\,2",
        "log_file=/var/log/drone",
        "cache_dir=/var/tmp/drone",
        "attr_timeout=5",
        "negative_timeout=0",
        "dirty_max=auto",
        "spool_max=2G",
        "verify=auto",
        "source_component=3",
        "rmw_max=1G",
        "local=",
        "local=+*.tmp",
        "heartbeat=onboard",
        "window=4",
        "trace=/tmp/trace",
    ],
)
def test_harmless_words_of_0_2_are_ignored_and_named(word: str) -> None:
    options = parse_options([f"ro,{word},uid=7"])
    assert options == parse_options(["ro,uid=7"])
    (line,) = options.gone
    assert f"option {word.partition('=')[0]} is gone, and is ignored: " in line


@pytest.mark.parametrize(
    ("word", "field", "value"),
    [
        ("root=/fs/microsd/", "root", b"/fs/microsd"),
        ("root=@SYS", "root", b"/@SYS"),
        ("baud=921600", "baud", 921600),
        ("verify=size", "verify_max", 0),
        ("verify=none", "verify_max", 0),
    ],
)
def test_some_words_of_0_2_are_translated(word: str, field: str, value: object) -> None:
    options = parse_options([word])
    assert getattr(options, field) == value
    (line,) = options.gone
    assert "is still understood: " in line
    name, _, text = word.partition("=")
    assert options_of({name: text}) == options


@pytest.mark.parametrize(
    ("word", "advice"),
    [
        ("verify=crc", "write verify_max=1024G"),
        ("force", "leave the word out"),
        ("heartbeat=gcs", "leave the option out"),
        ("heartbeat=none", "leave the option out"),
    ],
)
def test_words_of_0_2_that_changed_a_promise_are_errors(word: str, advice: str) -> None:
    name, _, value = word.partition("=")
    with pytest.raises(UsageError, match=f"option {name} is gone: .*{advice}"):
        parse_options([f"ro,{word}"])
    with pytest.raises(UsageError, match=f"option {name} is gone: .*{advice}"):
        options_of({name: value or True})


def test_words_that_are_gone_are_in_no_help_and_free_for_nothing_else() -> None:
    names = {word.partition("=")[0] for word in GONE}
    assert not names & {name.strip("=") for name in option_help()}
    assert not names & (KERNEL_WORDS | IGNORED_WORDS)


def forwarded(options: Options) -> tuple[str, ...]:
    return at_source(parse_source("udpin:0.0.0.0:14550"), options)[1].forward


def test_endpoints_are_collected() -> None:
    wanted = ("udpout:127.0.0.1:14550", "tcpin:127.0.0.1:5760")
    for words in (
        ["forward=udpout:127.0.0.1:14550,forward=tcpin::5760"],
        [f"forward={place}" for place in (*wanted, "tcpin::5760")],
    ):
        assert forwarded(parse_options(words)) == wanted
    assert forwarded(options_of({"forward": list(wanted)})) == wanted
    assert forwarded(options_of({"forward": wanted[0]})) == wanted[:1]
    with pytest.raises(UsageError, match="option forward=nowhere: "):
        forwarded(parse_options(["forward=nowhere"]))


def test_words_for_access_times_reach_neither_libfuse_nor_the_user() -> None:
    words = "atime,noatime,diratime,nodiratime,relatime,norelatime,strictatime,nostrictatime,lazytime"
    assert parse_options([words]).kernel_words == ()
