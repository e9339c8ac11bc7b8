"""Packed files and lines of parameters: what goes out comes back, and no bytes break the parser."""

from __future__ import annotations

import struct

from hypothesis import given
from hypothesis import strategies as st

from mavftpfs.parameters.packed import HEADER, MAGIC, MAGIC_DEFAULTS, pack_upload, unpack
from mavftpfs.parameters.text import parse, render_all, render_changed, render_qgc
from mavftpfs.parameters.values import WIDTHS, Kind, Parameter, fit, float_text, same
from mavftpfs.shared.errors import RemoteProtocolError
from mavftpfs.sim.parameters import Parameter as Served
from mavftpfs.sim.parameters import Selection, Table

FLOATS = st.floats(width=32)
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_"
MAX_NAME = 16
NAMES = st.text(LETTERS, min_size=1, max_size=MAX_NAME).filter(lambda name: not name.isdecimal())


def value_of(kind: Kind) -> st.SearchStrategy[int | float]:
    if kind is Kind.FLOAT:
        return FLOATS
    most = 1 << (8 * WIDTHS[kind] - 1)
    return st.integers(-most, most - 1)


PARAMETERS = st.sampled_from(Kind).flatmap(
    lambda kind: st.builds(Parameter, NAMES, st.just(kind), value_of(kind), value_of(kind))
)
LISTS = st.lists(PARAMETERS, max_size=30, unique_by=lambda one: one.name)


def alike(one: Parameter, other: Parameter) -> bool:
    return (one.name, one.kind) == (other.name, other.kind) and same(one.value, other.value)


def served(parameters: list[Parameter]) -> Table:
    def pack(one: Parameter, value: int | float) -> bytes:
        return struct.pack({1: "<b", 2: "<h", 3: "<i", 4: "<f"}[one.kind], value)

    return Table(
        Served(one.name.encode(), one.kind, pack(one, one.value), pack(one, one.default or 0))
        for one in parameters
    )


@given(LISTS.filter(bool), st.integers(16, 239), st.booleans())
def test_a_download_in_any_blocks_comes_back(parameters: list[Parameter], block: int, ask: bool) -> None:
    found = unpack(served(parameters).download(Selection(defaults=ask), block, 0))
    assert found.with_defaults == ask
    assert len(found.parameters) == len(parameters)
    assert all(map(alike, found.parameters, parameters))
    if ask:
        for one, given_ in zip(found.parameters, parameters, strict=True):
            default = one.value if one.default is None else one.default
            assert same(default, given_.default or 0)


@given(LISTS.filter(bool))
def test_an_upload_comes_back(parameters: list[Parameter]) -> None:
    pieces = pack_upload(parameters)
    packed = b"".join(pieces)
    assert len(pieces) == len(parameters)
    assert HEADER.unpack_from(packed) == (MAGIC, len(parameters), len(packed))
    download = HEADER.pack(MAGIC, len(parameters), len(parameters)) + packed[HEADER.size :]
    assert all(map(alike, unpack(download).parameters, parameters))


@given(LISTS)
def test_texts_come_back(parameters: list[Parameter]) -> None:
    for text in (render_all(parameters), render_qgc(parameters, 1, 1)):
        lines, problems = parse(text, 1)
        assert problems == []
        assert [line.name for line in lines] == [one.name for one in parameters]
        for line, one in zip(lines, parameters, strict=True):
            assert same(fit(one.kind, line.value), one.value)
    lines, problems = parse(render_changed(parameters))
    assert problems == []
    assert [line.name for line in lines] == [one.name for one in parameters if one.changed]


@given(FLOATS.filter(lambda value: value == value and abs(value) != float("inf")))
def test_no_shorter_decimal_gives_the_same_float(value: float) -> None:
    text = float_text(value)
    assert struct.pack("<f", float(text)) == struct.pack("<f", value)
    digits = len(text.partition("e")[0].lstrip("-").replace(".", "").strip("0")) or 1
    for shorter in range(1, digits):
        near = float(f"{value:.{shorter}g}")
        assert abs(near) > 3.4e38 or struct.pack("<f", near) != struct.pack("<f", value)


@given(
    st.binary(max_size=200), st.sampled_from([MAGIC, MAGIC_DEFAULTS]), st.integers(0, 40), st.integers(0, 40)
)
def test_any_bytes_are_parameters_or_an_error(body: bytes, magic: int, count: int, total: int) -> None:
    for data in (body, HEADER.pack(magic, count, total) + body):
        try:
            found = unpack(data)
        except RemoteProtocolError:
            continue
        assert len(found.parameters) <= found.total
        assert all(one.name.isprintable() and len(one.name) <= MAX_NAME for one in found.parameters)


@given(LISTS.filter(bool), st.data())
def test_a_damaged_download_is_an_error_or_of_as_many_parameters(
    parameters: list[Parameter], data: st.DataObject
) -> None:
    packed = bytearray(served(parameters).download(Selection(), 239, 0))
    packed[data.draw(st.integers(0, len(packed) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(packed[: data.draw(st.integers(0, len(packed)))])
    for damaged in (bytes(packed), cut):
        try:
            found = unpack(damaged)
        except RemoteProtocolError:
            continue
        assert len({one.name for one in found.parameters}) == len(found.parameters)


@given(st.text(max_size=200))
def test_any_text_is_lines_or_problems(text: str) -> None:
    lines, problems = parse(text, 1)
    numbers = [line.number for line in lines] + [problem.number for problem in problems]
    assert all(1 <= number <= text.count("\n") + 1 for number in numbers)
