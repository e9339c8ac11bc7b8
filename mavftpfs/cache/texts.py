"""Texts that stand for a packed `@` file: reading shows the vehicle, saving changes it. Layer: cache.

Each handle that writes has a text of its own, which no other handle sees. If it changed, the text is *saved*
as a whole by fsync and by each close (flush). `Texts.carry_out`, which the parameters and the missions
implement, compares a saved text with the vehicle, and changes the vehicle. No text is kept: a refused text is
gone with its handle.

A program reads a text, changes some lines, and saves all of them. It means only the lines that it changed. So
what a program read is remembered, for each program, until it saves.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import trio

from mavftpfs.cache.attributes import SECOND, Stat
from mavftpfs.cache.card import Card
from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.source import Opening, Source
from mavftpfs.cache.virtual import SnapshotHandle, VirtualTrees
from mavftpfs.parameters.text import Problem
from mavftpfs.shared import readonly
from mavftpfs.shared.errors import (
    FtpNak,
    InvalidText,
    LocalProtocolError,
    MavftpfsError,
    NotTaken,
    ReadOnly,
    RemoteProtocolError,
)
from mavftpfs.shared.model import EntryKind, split

LAST_ERROR = b"last_error.txt"
MAX_TEXT = 4 << 20
"""Bytes of the longest text that can be saved."""

MAX_READS, MAX_PROGRAM_READS = 32, 8
"""The most texts that are remembered after a read, of all programs and of one."""

B = TypeVar("B")
P = TypeVar("P")


class Program(Hashable, Protocol):
    """A process that opens files; equal to itself alone."""

    def ended(self) -> bool:
        """Return whether it ended, so that it stopped saving."""


@dataclass(frozen=True, slots=True)
class Shown(Generic[B]):
    """A text as a reader gets it. base: its values, for a later save. since_ns: when they changed last."""

    text: bytes
    base: B
    since_ns: int


@dataclass(slots=True)
class Reads(Generic[B]):
    """The texts that a program read, the oldest first, and the lines that it still knows of them. rereads:
    the program tried to make another file beside the text, as an editor does that is about to read the text
    again for a backup.
    """

    bases: list[B] = field(default_factory=list)
    texts: list[bytes] = field(default_factory=list)
    rereads: bool = False


@dataclass(frozen=True, slots=True)
class Save(Generic[B]):
    """A text that is saved.

    bases: what its program read, the oldest first; rereads: see Reads. appended: the lines were appended, so
    each of them is meant.
    """

    name: bytes
    text: bytes
    bases: Sequence[B]
    rereads: bool
    appended: bool


@dataclass(frozen=True, slots=True)
class Saved(Generic[B]):
    """A save that was carried out. known: what its program still knows of what it had read, None: as before.
    sent: whether the vehicle was changed. notes: lines for people.
    """

    known: Sequence[B] | None = None
    sent: bool = False
    notes: Sequence[str] = ()


@dataclass(slots=True)
class TextUpload:
    """An upload that is under way, in bytes."""

    path: bytes
    size: int
    acked: int = 0

    def on_acked(self, count: int) -> None:
        """Note that so many more bytes were ACKed."""
        self.acked += count

    def facts(self) -> dict[str, object]:
        """Return facts for people and scripts."""
        left = self.size - self.acked
        return {
            "path": self.path.decode(errors="replace"),
            "size": self.size,
            "bytes_left": left,
            "sending": True,
            "eta": None,
        }


class Texts(Source, ABC, Generic[B]):
    """The texts in one `@` directory."""

    directory: ClassVar[bytes]

    def __init__(self, card: Card, virtual: VirtualTrees) -> None:
        self._card, self._store, self._wall = card, card.store, card.wall
        self._virtual = virtual
        self.error_text = b""
        self._error_at = int(self._wall() * SECOND)
        self._reads: OrderedDict[Program | None, Reads[B]] = OrderedDict()
        self._failed: Program | None = None  # the program whose save was refused, if that was the last save
        self._saving = trio.Lock()
        self._upload: TextUpload | None = None

    # --- what the parameters and the missions implement

    @property
    @abstractmethod
    def names(self) -> Sequence[bytes]:
        """The names of all texts that there may be."""

    @abstractmethod
    async def show(self, name: bytes, *, reread: bool) -> Shown[B]:
        """Return a text. reread: read the vehicle now; else what was read last will do, if anything was.

        Raises:
            NotFound: the vehicle has nothing that the text could show. Otherwise as RemoteStore.read_whole.
        """

    @abstractmethod
    def forget(self) -> None:
        """Forget what was read: the vehicle restarted, or a user wants it read again."""

    @abstractmethod
    async def carry_out(self, save: Save[B]) -> Saved[B]:
        """Change the vehicle, where a text asks for it.

        Raises:
            Refused: the vehicle did not take it, or not all of it. Otherwise as RemoteStore.read_whole.
        """

    # --- what the tree asks

    def owns(self, path: bytes) -> bool:
        """Return whether it is the path of a text."""
        parent, name = split(path)
        return parent == self.directory and (name in self.names or name == LAST_ERROR)

    def may_be_written(self, path: bytes) -> bool:
        """Return whether a path is that of a text that can be saved, or of the texts' directory, in which
        editors try to make files before they save."""
        return path == self.directory or (self.owns(path) and split(path)[1] != LAST_ERROR)

    async def stat(self, path: bytes) -> Stat:
        """Return attributes. Raises NotFound; otherwise as show."""
        return await self._stat(split(path)[1])

    async def _stat(self, name: bytes) -> Stat:
        if name == LAST_ERROR:
            return Stat(EntryKind.FILE, len(self.error_text), self._error_at, 0.0)
        shown = await self.show(name, reread=False)
        return Stat(EntryKind.FILE, len(shown.text), shown.since_ns, 0.0)

    async def set_times(self, path: bytes, mtime_ns: int) -> None:
        """Ignore it: a text shows when the vehicle changed."""

    async def list(self, patience: float) -> list[tuple[bytes, Stat]]:
        """Return the texts that are there. One that was not read within `patience` seconds has size 0."""
        found = {}
        with trio.move_on_after(patience) as scope:
            for name in self.names:
                with suppress(MavftpfsError):  # it does not open; the program that opens it is told
                    found[name] = await self._stat(name)
        if scope.cancelled_caught:
            unread = Stat(EntryKind.FILE, 0, 0, 0.0)
            found = {name: found.get(name, unread) for name in self.names}
        if found:
            found[LAST_ERROR] = await self._stat(LAST_ERROR)
        return list(found.items())

    async def open(self, path: bytes, how: Opening) -> TextHandle[B] | SnapshotHandle:
        """Open one.

        Raises:
            ReadOnly, Armed, NotFound; otherwise as show.
        """
        name = split(path)[1]
        if name == LAST_ERROR:
            if how.write:
                raise ReadOnly(readonly.virtual(name))
            return SnapshotHandle(self.error_text)
        if how.write:
            try:
                self._require_writable()
            except MavftpfsError as error:
                self._tell(name, [f"nothing was set: {error}"])
                raise
        shown = await self.show(name, reread=not how.truncate)
        return TextHandle(self, name, shown, how)

    def note_other_file(self, program: Program | None) -> None:
        """Note that a program tried to make a file beside the texts."""
        if program in self._reads:
            self._reads[program].rereads = True

    def _require_writable(self) -> None:
        if self._card.options.read_only:
            raise ReadOnly(readonly.NOTHING_BY_OPTION)
        self._card.require_disarmed()

    # --- what handles ask

    def note_read(self, program: Program | None, text: bytes, base: B) -> None:
        """Note what a program read."""
        if program is None:
            return
        reads = self._reads.setdefault(program, Reads())
        self._reads.move_to_end(program)
        if text not in reads.texts:
            reads.texts = [*reads.texts, text][-MAX_PROGRAM_READS:]
        if not any(known is base for known in reads.bases):
            # The oldest stays: an editor made its text from that.
            reads.bases = [*reads.bases[:1], *[*reads.bases[1:], base][1 - MAX_PROGRAM_READS :]]
            self._bound_reads()

    def _bound_reads(self) -> None:
        """Forget what programs read that ended, and then what those read that read last long ago."""
        if self._remembered > MAX_READS:
            for program in [program for program in self._reads if program is None or program.ended()]:
                del self._reads[program]
        while self._remembered > MAX_READS:
            self._reads.popitem(last=False)

    @property
    def _remembered(self) -> int:
        return sum(len(reads.bases) for reads in self._reads.values())

    async def save(
        self,
        name: bytes,
        text: bytes,
        *,
        program: Program | None,
        base: B | None,
        appended: bool,
    ) -> None:
        """Save a text; one save at a time. base: what its handle showed before.

        Raises:
            InvalidText, NotTaken, Armed; otherwise as RemoteStore.read_whole.
        """
        async with self._saving:
            reads: Reads[B] = self._reads.get(program, Reads())
            puts_back = program is not None and program == self._failed and text in reads.texts
            bases = [] if appended else reads.bases
            if base is not None and not any(known is base for known in bases):
                bases = [*bases, base]
            try:
                self._require_writable()
                done = await self.carry_out(Save(name, text, bases, reads.rereads, appended))
            except (Refused, MavftpfsError) as exc:
                refused = exc if isinstance(exc, Refused) else Refused(exc, [f"nothing was set: {exc}"])
                self._failed = None if puts_back else program
                self._know(program, refused.known)
                self._tell(name, refused.lines, more=puts_back)
                raise refused.error from exc.__cause__
            finally:
                self._upload = None
            self._failed = None
            if not puts_back:  # else it still has the text that it could not save
                self._know(program, done.known)
                self._tell(name, done.notes)
            elif done.sent:
                self._tell(name, ["the program put back what it had read", *done.notes], more=True)

    def _know(self, program: Program | None, known: Sequence[B] | None) -> None:
        """Note what a program still knows after its save."""
        if known is not None and program in self._reads:
            self._reads[program] = Reads(list(known), self._reads[program].texts)

    async def parsed(self, file: bytes, raw: bytes, parse: Callable[[bytes], P]) -> tuple[bytes, P]:
        """Parse a packed file that was read. One that does not add up is read once more: it may have changed
        while it was read. Returns the bytes that were parsed, too.

        Raises:
            RemoteProtocolError; otherwise as RemoteStore.read_whole.
        """
        try:
            return raw, parse(raw)
        except RemoteProtocolError:
            self._virtual.outdate(file)
            raw = await self._virtual.content(file, reread=True)
            return raw, parse(raw)

    async def send(
        self, name: bytes, file: bytes, uploads: Sequence[Sequence[bytes]]
    ) -> MavftpfsError | None:
        """Send what a save makes, in pieces that are not cut, and return why that ended, if it failed. Its
        progress is in `transfers`, until the save ends. Only another download shows its result.
        """
        failure: MavftpfsError | None = None
        self._virtual.outdate(file)
        try:
            for pieces in uploads:
                sent = self._upload = TextUpload(self.directory + b"/" + name, sum(map(len, pieces)))
                await self._store.write_whole(file, pieces, sent.on_acked)
        except MavftpfsError as error:
            failure = error
        self._virtual.outdate(file)  # a program may have read it while the upload waited for its turn
        return failure

    def transfers(self) -> Sequence[dict[str, object]]:
        """Return the upload that is under way, if one is, in the form of `Throttle.transfers`."""
        return [] if self._upload is None else [self._upload.facts()]

    def refuse_missing_newline(self, name: bytes, text: bytes, program: Program | None) -> InvalidText:
        """Note in last_error.txt that a text ends in the middle of a line, and return the error."""
        number = text.count(b"\n") + 1
        line = f"{name.decode()}:{number}: the last line has no end, so nothing was set"
        self._failed = program
        self._tell(name, [line])
        return InvalidText(line)

    def _tell(self, name: bytes, lines: Sequence[str], *, more: bool = False) -> None:
        """Make last_error.txt say what came of the last save. more: also keep what it says already.

        An editor that cannot save may put back the text that it had read (vim). The reason why the first save
        failed has to stay readable then.
        """
        now = self._wall()
        when = datetime.fromtimestamp(now, UTC)
        head = f"# {when:%Y-%m-%d %H:%M:%S} UTC, {name.decode()}"
        before = self.error_text if more else b""
        self.error_text = before + ("\n".join([head, *lines]) + "\n").encode() if lines else before
        self._error_at = int(now * SECOND)


class Refused(Exception):
    """A save was not carried out, or not wholly.

    error: for the program. lines: for people. known: see Saved; None: the program knows what it knew before.
    """

    def __init__(self, error: MavftpfsError, lines: Sequence[str], known: Any = None) -> None:
        super().__init__(str(error))
        self.error = error
        self.lines = lines
        self.known = known


class TextHandle(OpenFile, Generic[B]):
    """One open() of a text."""

    direct_io = True
    writable = False

    def __init__(
        self,
        texts: Texts[B],
        name: bytes,
        shown: Shown[B],
        how: Opening,
    ) -> None:
        self.writable = how.write
        self._texts = texts
        self._name = name
        self._program: Program | None = how.program()
        self._append = how.append and how.write
        self._base = None if how.truncate or self._append else shown.base
        self._shown = shown.base
        self._before = b"" if how.truncate else shown.text  # what the appended lines follow
        self._content = bytearray() if self._append else bytearray(self._before)
        self._changed = False
        self._error: MavftpfsError | None = None

    @property
    def size(self) -> int:
        """Bytes."""
        return len(self._content) + (len(self._before) if self._append else 0)

    async def read(self, offset: int, size: int) -> bytes:
        """Return bytes, fewer only at the end."""
        if not self._changed and self._before:
            self._texts.note_read(self._program, self._before, self._shown)
        content = self._before + self._content if self._append else self._content
        return bytes(content[offset : offset + size])

    async def write(self, offset: int, data: bytes | memoryview) -> int:
        """Put bytes into the text; behind its end if it was opened for appending.

        Raises:
            InvalidText: it becomes too long.
        """
        if not self.writable:
            raise LocalProtocolError("write to a handle opened for reading")
        at = len(self._content) if self._append else offset
        if at + len(data) > MAX_TEXT:
            raise InvalidText(f"{self._name.decode()} may have {MAX_TEXT} bytes")
        if at > len(self._content):
            self._content.extend(bytes(at - len(self._content)))
        self._content[at : at + len(data)] = data
        self._changed = True
        return len(data)

    async def truncate(self, size: int) -> None:
        """Cut the text, or extend it with zeros, which no line may hold.

        Raises:
            InvalidText: it becomes too long.
        """
        if not self.writable:
            raise LocalProtocolError("truncate of a handle opened for reading")
        if size > MAX_TEXT:
            raise InvalidText(f"{self._name.decode()} may have {MAX_TEXT} bytes")
        if not size:
            self._base = None  # vim opens a text, and then empties it
        if self._append:
            self._before, size = self._before[:size], max(0, size - len(self._before))
        del self._content[size:]
        self._content.extend(bytes(size - len(self._content)))
        self._changed = True

    async def flush(self) -> None:
        """Save the text if it changed since the last time. A last line without its end is an error; the text
        stays, because more may come.

        Raises:
            InvalidText, NotTaken, Armed. If nothing changed since a save failed, its error again.
        """
        if not self._changed:
            if self._error is not None:
                raise self._error
            return
        text = bytes(self._content)
        if text and not text.endswith(b"\n"):
            raise self._texts.refuse_missing_newline(self._name, text, self._program)
        self._changed, self._error = False, None
        if not text:
            return
        try:
            await self._texts.save(
                self._name,
                text,
                program=self._program,
                base=self._base,
                appended=self._append,
            )
        except MavftpfsError as error:
            self._error = error
            raise
        if self._append:
            self._before += text
            del self._content[: len(text)]

    async def fsync(self, *, ends_write: bool = False) -> None:
        """As flush."""
        await self.flush()

    async def release(self) -> None:
        """Drop the text, saved or not: the program that closed it was told."""

    async def take_back(self) -> bool:
        """Drop the text; return whether the vehicle has it."""
        return not self._changed and self._error is None

    def close(self) -> None:
        """Drop the text."""


def problems_refused(name: bytes, problems: Sequence[Problem]) -> Refused:
    """Return the refusal of a text with invalid lines. It names each line."""
    ordered = sorted(problems, key=lambda problem: problem.number)
    lines = [f"{name.decode()}:{problem.number}: {problem.reason}" for problem in ordered]
    return Refused(InvalidText(lines[0]), [*lines, "nothing was set"])


def cause_of(failure: MavftpfsError | None, missed: str) -> MavftpfsError:
    """Return the error of a save that does not hold: why the upload failed, or NotTaken if the vehicle
    answered all of it. missed: what the vehicle did not take.
    """
    return NotTaken(missed) if failure is None or isinstance(failure, FtpNak) else failure
