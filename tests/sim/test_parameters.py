"""Parameters as texts, over simulated links: a read gives the vehicle's values, and a save sets them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, nullcontext
from dataclasses import dataclass, field, replace

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.texts import MAX_PROGRAM_READS, MAX_READS
from mavftpfs.cache.tree import Tree
from mavftpfs.client import parameters as client
from mavftpfs.client.files import Session
from mavftpfs.client.progress import Progress, followed
from mavftpfs.client.status import Facts, snapshot
from mavftpfs.parameters.packed import pack_upload
from mavftpfs.parameters.text import Line, parse
from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    AlreadyExists,
    Armed,
    InvalidText,
    MavftpfsError,
    NotFound,
    NotTaken,
    ReadOnly,
    RemoteProtocolError,
    RequestTimeout,
    VehicleLost,
)
from mavftpfs.sim.linkmodel import LinkSettings
from mavftpfs.sim.parameters import FLOAT, INT32, Parameter, Selection, Table, parameter
from tests.support.rigs import EPOCH, Rig, read_file, rig

ALL, CHANGED, QGC = b"/@PARAM/params.parm", b"/@PARAM/changed.parm", b"/@PARAM/params.params"
ERRORS = b"/@PARAM/last_error.txt"
PACKED = b"/@PARAM/param.pck"
PROFILES = ("px4-2026", "ardupilot", "ardupilot5")
MARKS = pytest.mark.parametrize("profile", PROFILES)
LINKS = (LinkSettings(delay=0.02), LinkSettings(delay=0.02, loss=0.03), LinkSettings(delay=0.02, loss=0.1))


def many(count: int = 300, drifting: int = 20) -> list[Parameter]:
    """Return parameters of which some change by themselves."""
    made = [parameter(f"GAIN_{i:03}", FLOAT, i / 7, i / 7 if i % 3 else 0) for i in range(count)]
    made += [parameter(f"MODE_{i:03}", INT32, i, 0) for i in range(20)]
    made += [parameter(f"LEARNED_{i:02}", FLOAT, i, 0, drift=0.25) for i in range(drifting)]
    return [*made, parameter("STAT_RUNTIME", INT32, 100, 0, drift=1)]


def table_of(here: Rig) -> Table:
    return here.server._storage.virtual.table


def number(here: Rig, name: str) -> float:
    return table_of(here).number(name, here.server.firmware.now)


def numbers(here: Rig) -> dict[str, float]:
    """Return what the vehicle has by now, by name."""
    return {one.name.decode(): one.number for one in table_of(here).visible(here.server.firmware.now)}


def assert_nothing_written_back(here: Rig, before: dict[str, float], *but: str) -> None:
    """Check that drifting values drifted on, and that no other value changed."""
    drifting = {one.name.decode() for one in table_of(here).visible(here.server.firmware.now) if one.drift}
    for name, value in numbers(here).items():
        if name not in but:
            assert value >= before[name] if name in drifting else value == before[name], name


@asynccontextmanager
async def vehicle(
    profile: str, *, link: LinkSettings = LINKS[0], parameters: list[Parameter] | None = None
) -> AsyncIterator[tuple[Rig, Tree]]:
    async with rig(profile, {b"/fs/a": b"a"}, link=link) as here:
        here.server._storage.virtual.table = Table(many() if parameters is None else parameters)
        yield here, here.mount()


@dataclass(eq=False)
class Editor:
    """A program of its own that reads a text and saves it."""

    tree: Tree
    path: bytes = ALL
    lines: list[str] = field(default_factory=list)
    backup: list[str] = field(default_factory=list)
    running: bool = True

    def ended(self) -> bool:
        return not self.running

    async def open(self, *, write: bool = False, truncate: bool = False, append: bool = False) -> OpenFile:
        return await self.tree.open(
            self.path, write=write, truncate=truncate, append=append, program=lambda: self
        )

    async def read(self) -> Editor:
        file = await self.open()
        self.lines = bytes(await file.read(0, file.size)).decode().splitlines()
        file.close()
        return self

    async def back_up(self) -> None:
        """Do what vim does before it saves: try to make a file beside it, and read the file once more."""
        with pytest.raises(ReadOnly):
            await self.tree.create(b"/@PARAM/4913", exclusive=True, program=lambda: self)
        lines = self.lines
        self.backup = (await self.read()).lines
        self.lines = lines

    def edit(self, name: str, value: str) -> Editor:
        found = [i for i, line in enumerate(self.lines) if line.partition(",")[0] == name]
        assert len(found) == 1
        self.lines[found[0]] = f"{name},{value}"
        return self

    async def save(self, text: str | None = None, *, append: bool = False) -> None:
        content = "".join(line + "\n" for line in self.lines) if text is None else text
        file = await self.open(write=True, truncate=not append, append=append)
        try:
            await file.write(0, content.encode())
            await file.flush()
        finally:
            await file.release()
            file.close()


async def errors(tree: Tree) -> str:
    return (await read_file(tree, ERRORS)).decode()


def gains(count: int) -> str:
    """Return a text that sets as many values."""
    return "".join(f"GAIN_{i:03},{i + 0.5}\n" for i in range(count))


def taken(here: Rig, count: int) -> set[str]:
    """Return the names of those that the vehicle has."""
    return {f"GAIN_{i:03}" for i in range(count) if number(here, f"GAIN_{i:03}") == i + 0.5}


def writes(here: Rig) -> int:
    return here.count(Opcode.CREATE_FILE, Opcode.OPEN_FILE_WO, Opcode.WRITE_FILE)


# --- reading


@MARKS
@pytest.mark.parametrize("link", LINKS, ids=lambda link: f"{link.loss:.0%}")
async def test_reading_is_what_the_vehicle_has(profile: str, link: LinkSettings) -> None:
    async with vehicle(profile, link=link, parameters=many(drifting=0)[:-1]) as (here, tree):
        for path in (ALL, QGC):
            lines, problems = parse((await read_file(tree, path)).decode())
            assert problems == []
            assert {line.name: line.value for line in lines}.keys() == {
                one.name.decode() for one in table_of(here).visible(0)
            }
            for line in lines:
                assert table_of(here).number(line.name, 0) == pytest.approx(line.value, rel=1e-6)
        changed = parse((await read_file(tree, CHANGED)).decode())[0]
        assert {line.name for line in changed} == {
            one.name.decode() for one in table_of(here).visible(0) if one.default != one.value
        }


@MARKS
@pytest.mark.parametrize("longest", [91, 78])
async def test_parameters_come_whole_where_replies_are_shorter_than_asked(profile: str, longest: int) -> None:
    """PX4 may send what a radio carries (servers.md 7). A block of another length is another question."""
    async with vehicle(profile, parameters=many(drifting=0)[:-1]) as (here, tree):
        here.server.profile = here.server.firmware.profile = replace(
            here.server.profile, longest_reply=longest
        )
        lines, problems = parse((await read_file(tree, ALL)).decode())
        assert problems == []
        assert {line.name: line.value for line in lines} == pytest.approx(numbers(here), rel=1e-6)


@pytest.mark.parametrize("after", [1, 3, 7])
async def test_parameters_come_whole_where_a_clamp_comes_and_goes(after: int) -> None:
    """A link may be signed only for a while: so many reads pass, as many are clamped, and so on."""
    async with vehicle("px4-2026", parameters=many(drifting=0)[:-1]) as (here, tree):
        reads = 0

        def clamp(request: Payload, reply: Payload) -> list[Payload]:
            nonlocal reads
            reads += request.opcode == Opcode.READ_FILE
            longest = 91 if reads // after % 2 else MAX_DATA
            here.server.profile = here.server.firmware.profile = replace(
                here.server.profile, longest_reply=longest
            )
            return [reply]

        here.server.change = clamp
        lines, problems = parse((await read_file(tree, ALL)).decode())
        assert problems == []
        assert {line.name: line.value for line in lines} == pytest.approx(numbers(here), rel=1e-6)
        assert reads > after


@MARKS
async def test_one_download_serves_a_listing_and_the_opens_of_a_second(profile: str) -> None:
    async with vehicle(profile) as (here, tree):
        names = {name: stat.size for name, stat in await tree.list(b"/@PARAM")}
        assert list(names) == [
            *(b"param.pck", b"params.parm", b"changed.parm", b"params.params", b"last_error.txt")
        ]
        await trio.sleep(2)
        before = here.count(Opcode.OPEN_FILE_RO)
        for path in (ALL, QGC, CHANGED, PACKED):
            await tree.stat(path)
            file = await tree.open(path)
            assert (await tree.stat(path)).size == file.size
            file.close()
        assert here.count(Opcode.OPEN_FILE_RO) == before + 1
        await trio.sleep(2)
        (await tree.open(ALL)).close()
        assert here.count(Opcode.OPEN_FILE_RO) == before + 2


async def test_what_the_vehicle_sets_by_itself_gives_no_new_time() -> None:
    """An editor that looks at the time before it saves would warn each time."""
    clock = parameter("STAT_RUNTIME", INT32, 100, drift=1)
    async with vehicle("ardupilot5", parameters=[clock, parameter("GAIN", FLOAT, 1)]) as (here, tree):
        before = await tree.stat(ALL)
        assert (await tree.stat(ERRORS)).mtime >= EPOCH
        await trio.sleep(100)
        assert await tree.stat(ALL) == before
        assert here.count(Opcode.OPEN_FILE_RO) == 1
        assert b"STAT_RUNTIME,100" not in await read_file(tree, ALL)
        assert (await tree.stat(ALL)).mtime_ns == before.mtime_ns
        table_of(here).set(b"GAIN", 2, here.server.firmware.now)
        await trio.sleep(2)
        await read_file(tree, ALL)
        assert (await tree.stat(ALL)).mtime_ns > before.mtime_ns


async def test_a_vehicle_that_tells_no_defaults_has_no_changed_parm() -> None:
    async with vehicle("ardupilot5") as (here, tree):
        here.faults.refuse(Opcode.OPEN_FILE_RO, NakCode.FILE_NOT_FOUND, nth=2)
        names = {name for name, _ in await tree.list(b"/@PARAM")}
        assert names == {b"param.pck", b"params.parm", b"params.params", b"last_error.txt"}
        with pytest.raises(NotFound):
            await tree.stat(CHANGED)


async def test_a_damaged_download_is_read_again_and_then_an_error() -> None:
    async with vehicle("px4-2026") as (here, tree):
        good, damaged = table_of(here).download, 1

        def lie(wanted: Selection, block: int, now: float) -> bytes:
            broken = here.count(Opcode.OPEN_FILE_RO) <= damaged
            return good(wanted, block, now)[: -3 if broken else None]

        table_of(here).download = lie  # type: ignore[method-assign]
        assert b"GAIN_001" in await read_file(tree, ALL)
        damaged = 100
        await trio.sleep(2)
        with pytest.raises(RemoteProtocolError, match="ends before its last entry"):
            await tree.open(ALL)


# --- saving


VIM = {
    "nothing, then one": [{}, {"MODE_001": "5"}],
    "five each time": [{f"MODE_{5 * nth + i:03}": "77" for i in range(5)} for nth in range(3)],
    "refused": [*[{"MODE_001": "rubbish"}] * (MAX_PROGRAM_READS + 2), {"MODE_001": "77"}],
}
"""The changes that a user of a running vim makes before each save."""


@MARKS
@pytest.mark.parametrize("saves", VIM.values(), ids=VIM)
async def test_vim_writes_nothing_back_however_often_it_saves(
    profile: str, saves: list[dict[str, str]]
) -> None:
    """vim reads the file anew each time, and saves the text that it had read first: neither a save nor a
    refusal in between takes that base away."""
    async with vehicle(profile, parameters=many(drifting=1)) as (here, tree):
        vim = await Editor(tree).read()
        for edits in saves:
            await trio.sleep(20)
            await vim.back_up()
            for name, value in edits.items():
                vim.edit(name, value)
            before, written = numbers(here), writes(here)
            refused = "rubbish" in edits.values()
            with pytest.raises(InvalidText) if refused else nullcontext():
                await vim.save()
            if edits and not refused:
                assert {name: number(here, name) for name in edits} == {n: float(v) for n, v in edits.items()}
                assert_nothing_written_back(here, before, *edits)
            else:
                assert writes(here) == written


@MARKS
@pytest.mark.parametrize("bad", ["MODE_002,rubbish", "CLAMPED,70"])
async def test_an_editor_that_puts_back_its_backup_after_a_failed_save(profile: str, bad: str) -> None:
    """vim does so. The error stays readable; the vehicle gets no value that the failed save did not set."""
    table = [*many(), parameter("CLAMPED", FLOAT, 1, limits=(0, 10))]
    async with vehicle(profile, parameters=table) as (here, tree):
        editor = await Editor(tree).read()
        edited = editor.edit("MODE_001", "5").edit(*bad.split(",")).lines
        await trio.sleep(20)
        await editor.back_up()
        with pytest.raises((InvalidText, NotTaken)):
            await editor.save()
        said = await errors(tree)
        await trio.sleep(20)
        before = numbers(here)
        editor.lines = editor.backup
        await editor.save()
        assert_nothing_written_back(here, before, "MODE_001", "CLAMPED")
        assert (number(here, "MODE_001"), number(here, "CLAMPED")) == (1, 1)
        assert (await errors(tree)).startswith(said)
        assert ("put back" in await errors(tree)) is (bad == "CLAMPED,70")
        await trio.sleep(20)
        before = numbers(here)
        editor.lines = edited
        await editor.back_up()
        await editor.edit("MODE_002", "2").edit("CLAMPED", "1").save()
        assert_nothing_written_back(here, before, "MODE_001")
        assert number(here, "MODE_001") == 5
        assert await errors(tree) == ""


@pytest.mark.holds("promise 8")
async def test_many_programs_that_read_and_end_take_no_editor_its_base() -> None:
    async with vehicle("ardupilot5", parameters=many(20)) as (here, tree):
        editor = await Editor(tree).read()
        for _ in range(3 * MAX_READS):
            await trio.sleep(2)
            (await Editor(tree).read()).running = False
        before = numbers(here)
        await editor.back_up()
        await editor.edit("MODE_001", "5").save()
        assert number(here, "MODE_001") == 5
        assert_nothing_written_back(here, before, "MODE_001")
        (texts,) = (one for one in tree._texts if one.names[0] == b"params.parm")
        assert texts._remembered <= MAX_READS


async def test_what_a_program_reads_again_is_its_base() -> None:
    """Others set a value, the program saw that, and goes back to the text that it had read first."""
    async with vehicle("px4-2026", parameters=many(drifting=0)[:-1]) as (here, tree):
        editor = await Editor(tree).read()
        first = list(editor.lines)
        table_of(here).set(b"MODE_001", 9, here.server.firmware.now)
        await trio.sleep(2)
        await editor.read()
        editor.lines = first
        await editor.save()
        assert number(here, "MODE_001") == 1


@MARKS
async def test_a_copy_sets_all_that_does_not_hold(profile: str) -> None:
    async with vehicle(profile) as (here, tree):
        saved = (await read_file(tree, QGC)).decode()
        for name in (b"GAIN_001", b"MODE_002"):
            table_of(here).set(name, 50, here.server.firmware.now)
        await trio.sleep(5)
        await Editor(tree, QGC).save(saved)
        assert number(here, "GAIN_001") == pytest.approx(1 / 7)
        assert number(here, "MODE_002") == 2
        assert number(here, "STAT_RUNTIME") > 100
        assert "STAT_RUNTIME" in await errors(tree)


@MARKS
async def test_only_appended_lines_count(profile: str) -> None:
    async with vehicle(profile) as (here, tree):
        editor = Editor(tree)
        await editor.save("MODE_001,5\n", append=True)
        await editor.save("# why\nMODE_001 6\n", append=True)
        assert number(here, "MODE_001") == 6
        file = await editor.open(write=True, append=True)
        for value in (7, 8):
            await file.write(0, b"MODE_001,%d\n" % value)
            await file.flush()
            assert number(here, "MODE_001") == value
        await file.release()
        await editor.save("STAT_RUNTIME,0\n", append=True)
        assert number(here, "STAT_RUNTIME") < 50


async def test_a_file_opened_for_both_is_changed_in_place() -> None:
    async with vehicle("ardupilot5") as (here, tree):
        editor = Editor(tree)
        file = await editor.open(write=True)
        text = bytes(await file.read(0, file.size))
        at = text.index(b"MODE_001,1\n")
        await file.write(at + len(b"MODE_001,"), b"4")
        await trio.sleep(10)
        await file.fsync()
        assert number(here, "MODE_001") == 4
        assert bytes(await file.read(at, 11)) == b"MODE_001,4\n"
        assert b"MODE_001,4" in await read_file(tree, ALL)
        await file.release()
        assert here.count(Opcode.WRITE_FILE) == 1


async def test_a_file_that_is_emptied_after_the_open_has_no_other_base() -> None:
    """vim opens without O_TRUNC, and then cuts."""
    async with vehicle("ardupilot") as (here, tree):
        editor = await Editor(tree).read()
        await trio.sleep(20)
        file = await editor.open(write=True)
        await file.truncate(0)
        await file.write(0, "".join(line + "\n" for line in editor.lines).encode())
        await file.flush()
        assert writes(here) == 0


# --- what is refused


BAD = [
    ("\n# c\nNO_SUCH,1\n", "params.parm:3: the vehicle has no parameter NO_SUCH"),
    ("MODE_001,2.9\n", "params.parm:1: MODE_001: 2.9 is not a whole number"),
    ("rubbish\n", "params.parm:1: 'rubbish' is not NAME,VALUE"),
    ("MODE_002,9\n\xff\n", "params.parm:2: this is no text"),
    ("1\t7\tMODE_001\t5\t6\n", "params.parm:1: MODE_001 is a parameter of component 7"),
]


@pytest.mark.parametrize(("text", "said"), BAD)
async def test_bad_lines_are_named_and_nothing_is_sent(text: str, said: str) -> None:
    async with vehicle("ardupilot") as (here, tree):
        file = await Editor(tree).open(write=True, truncate=True)
        good = b"MODE_005,50\n"
        await file.write(0, text.encode("latin-1") + good)
        for _ in range(2):
            with pytest.raises(InvalidText) as caught:
                await file.flush()
            assert errno_for(caught.value) == 22
        await file.release()
        assert said in await errors(tree)
        assert writes(here) == 0
        await Editor(tree).save("# nothing to set\n", append=True)
        assert await errors(tree) == ""
        with pytest.raises(InvalidText):
            await Editor(tree).save("rubbish\n")
        assert await errors(tree) != ""
        await Editor(tree).save(good.decode())
        assert await errors(tree) == ""


async def test_half_a_last_line_sets_nothing_and_may_be_finished() -> None:
    """A forked child flushes the buffer that it inherits."""
    async with vehicle("ardupilot5") as (here, tree):
        file = await Editor(tree).open(write=True, truncate=True)
        await file.write(0, b"MODE_001,5\nMODE_002,7")
        with pytest.raises(InvalidText):
            await file.flush()
        assert writes(here) == 0
        assert "params.parm:2" in await errors(tree)
        await file.write(21, b"7\n")
        await file.flush()
        assert (number(here, "MODE_001"), number(here, "MODE_002")) == (5, 77)


STUBBORN = [
    parameter("CLAMPED", FLOAT, 1, limits=(0, 10)),
    parameter("FIXED", INT32, 3, read_only=True),
    parameter("FREE", INT32, 1),
    parameter("RUNNING", INT32, 0, drift=1),
]


@MARKS
async def test_what_the_vehicle_changes_or_refuses_is_named(profile: str) -> None:
    async with vehicle(profile, parameters=STUBBORN) as (here, tree):
        for name, wanted, got in (("CLAMPED", "70", "10"), ("FIXED", "4", "3")):
            with pytest.raises(NotTaken, match=f"{name}: wanted {wanted}, got {got}") as caught:
                await Editor(tree).save(f"FREE,{wanted}\n{name},{wanted}\n")
            assert errno_for(caught.value) == 5
            said = await errors(tree)
            assert f"{name}: wanted {wanted}, got {got}" in said
            assert "set: FREE" in said
            assert number(here, "FREE") == float(wanted)


@MARKS
async def test_a_line_changed_here_and_there_names_both_values(profile: str) -> None:
    async with vehicle(profile) as (here, tree):
        editor = await Editor(tree).read()
        table_of(here).set(b"MODE_001", 50, here.server.firmware.now)
        await trio.sleep(2)
        with pytest.raises(NotTaken, match="MODE_001: it was 1, and the vehicle changed it to 50"):
            await editor.edit("MODE_001", "9").edit("MODE_002", "9").save()
        assert writes(here) == 0
        assert (number(here, "MODE_001"), number(here, "MODE_002")) == (50, 2)
        await (await editor.read()).edit("MODE_001", "9").save()
        assert number(here, "MODE_001") == 9


@MARKS
async def test_nothing_is_set_in_flight_nor_after_it(profile: str) -> None:
    async with vehicle(profile) as (here, tree):
        early = await Editor(tree).open(write=True, truncate=True)
        await early.write(0, b"MODE_001,9\n")
        await here.arm()
        with pytest.raises(Armed) as caught:
            await early.flush()
        assert errno_for(caught.value) == 30
        await early.release()
        early.close()
        await here.disarm()
        await Editor(tree).save("# all is well\n")
        assert await errors(tree) == ""
        await here.arm()
        with pytest.raises(Armed):
            await Editor(tree).open(write=True)
        assert "armed" in await errors(tree)
        assert b"MODE_001,1\n" in await read_file(tree, ALL)
        await here.disarm()
        await trio.sleep(120)
        assert writes(here) == 0
        assert number(here, "MODE_001") == 1


@MARKS
@pytest.mark.parametrize(
    ("opcode", "nth"),
    [
        *((Opcode.OPEN_FILE_RO, 1), (Opcode.CREATE_FILE, 1), (Opcode.WRITE_FILE, 1), (Opcode.WRITE_FILE, 7)),
        *((Opcode.TERMINATE_SESSION, 2), (Opcode.READ_FILE, 22)),
    ],
)
async def test_cut_in_the_middle(profile: str, opcode: Opcode, nth: int) -> None:
    """The message names the values that were set, and the next one sets the rest; no value is set in half."""
    async with vehicle(profile) as (here, tree):
        await tree.stat(ALL)
        await trio.sleep(2)
        before = numbers(here)
        here.faults.at(opcode, here.link.cut, nth=nth)
        with pytest.raises((RequestTimeout, VehicleLost)):
            await Editor(tree).save(gains(300))
        assert "set" in await errors(tree)
        await here.find()
        await trio.sleep(60)
        assert_nothing_written_back(here, before, *taken(here, 300))
        await Editor(tree).save(gains(300))
        assert len(taken(here, 300)) == 300
        assert await errors(tree) == ""


@MARKS
async def test_a_refused_upload_that_was_set_in_part_is_said(profile: str) -> None:
    async with vehicle(profile) as (here, tree):
        here.faults.refuse(Opcode.WRITE_FILE, NakCode.FAIL, nth=4)
        with pytest.raises(MavftpfsError):
            await Editor(tree).save(gains(100))
        said = await errors(tree)
        assert taken(here, 100) == set(said.rpartition("set: ")[2].strip().split(", ")) - {"nothing"}
        await Editor(tree).save(gains(100))
        assert len(taken(here, 100)) == 100


@MARKS
async def test_two_writers_at_once_save_one_after_the_other(profile: str) -> None:
    async with vehicle(profile) as (here, tree):
        first, second = await Editor(tree).read(), await Editor(tree).read()
        async with trio.open_nursery() as nursery:
            nursery.start_soon(first.edit("MODE_001", "11").save)
            nursery.start_soon(second.edit("MODE_002", "12").save)
        assert (number(here, "MODE_001"), number(here, "MODE_002")) == (11, 12)
        opcodes = [op for op in here.faults.requests if op in (Opcode.CREATE_FILE, Opcode.OPEN_FILE_RO)]
        creates = [place for place, op in enumerate(opcodes) if op == Opcode.CREATE_FILE]
        assert len(creates) == 2
        assert creates[1] > creates[0] + 1  # the first was read back before the second began


async def test_names_beside_the_texts_are_refused() -> None:
    async with vehicle("ardupilot") as (_, tree):
        for name in (b"sedXyz", b"params.parm~", b".params.parm.swp"):
            with pytest.raises(ReadOnly):
                await tree.create(b"/@PARAM/" + name, exclusive=True)
        for change in (tree.unlink(ALL), tree.rename(ALL, b"/@PARAM/x"), tree.mkdir(b"/@PARAM/d")):
            with pytest.raises(ReadOnly):
                await change
        for path in (PACKED, ERRORS):
            with pytest.raises(ReadOnly):
                await tree.open(path, write=True, truncate=True)
        with pytest.raises((ReadOnly, AlreadyExists)):
            await tree.create(ALL, exclusive=True)


# --- the command


async def test_300_values_over_57600_baud() -> None:
    """The save takes at most twice the time that the bytes need, and shows its progress."""
    rate = 5760.0
    link = LinkSettings(delay=0.01, rate=rate, queue=4096)
    parameters = many(count=1329, drifting=0)
    async with vehicle("ardupilot5", link=link, parameters=parameters) as (here, tree):

        async def status() -> Facts:
            return snapshot(here.connection.status(), tree.status(), None)

        session = Session(tree, status)
        await tree.stat(ALL)
        await trio.sleep(20)
        began, bar, seen, states = trio.current_time(), Progress(trio.current_time), set[int](), set[str]()
        lines = [Line(i, f"GAIN_{i:03}", i + 0.5) for i in range(300)]
        wish = client.plan_changes(lines, await client.read_parameters(session), "", meant=True)
        assert len(wish.changes) == 300

        async def look() -> None:
            while True:
                await trio.sleep(0.1)
                seen.add(bar.here)
                states.add(bar.state)

        async with trio.open_nursery() as nursery:
            nursery.start_soon(look)
            async with followed(session, bar):
                await client.set_values(session, wish.changes, bar)
            nursery.cancel_scope.cancel()
        took = trio.current_time() - began
        assert number(here, "GAIN_299") == 299.5
        table = len(table_of(here).download(Selection(), 239, here.server.firmware.now))
        upload = sum(map(len, pack_upload([change.after for change in wish.changes])))
        assert took < 2 * (2 * table + upload) / rate
        assert len(seen) > 2
        assert states == {"", "checking"}, "that it is read back shows"
