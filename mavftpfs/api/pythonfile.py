"""Python's files over an open file of a vehicle. Layer: api.

`RawFile` has no buffer; Python's own buffers and text files use it. Python may collect garbage in any thread,
also in the event loop's, so a finalizer must not wait. Collecting a file that was never closed delivers
nothing: the raw file posts that its changes are discarded, and warns.
"""

from __future__ import annotations

import codecs
import errno
import io
import logging
import os
import warnings
from typing import IO, Any

from mavftpfs.api.errors import NotDelivered, note_or_raise, whereabouts
from mavftpfs.api.opened import Opened
from mavftpfs.api.portal import Closed, LoopThread

log = logging.getLogger("mavftpfs.api")

READ_BUFFER = 128 * 1024
WRITE_BUFFER = 128 * 1024
"""Bytes of each request to the event loop."""

FIRST_READ = 4 * 1024
"""Bytes of a buffer's first read, and of the first one after a seek; each further read doubles them. A radio
carries 5 kB in a second, and a program may want only the head of a file."""


class Mode:
    """The arguments of open(), checked before anything is opened.

    Attributes:
        plain: r, w, a or x, and perhaps +. text: whether the file is opened as text.
    """

    def __init__(
        self,
        mode: str,
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
    ) -> None:
        """Check the arguments. Raises ValueError or LookupError if they are invalid, or contradict one
        another."""
        letters = set(mode)
        kinds = letters & set("rwax")
        known = len(letters) == len(mode) and letters <= set("rwaxbt+")
        if not known or len(kinds) != 1 or {"b", "t"} <= letters:
            raise ValueError(f"invalid mode: {mode!r}")
        self.plain = kinds.pop() + ("+" if "+" in letters else "")
        self.text = "b" not in letters
        if not self.text and (encoding, errors, newline) != (None, None, None):
            raise ValueError("binary mode takes no encoding, errors or newline argument")
        if self.text and buffering == 0:
            raise ValueError("can't have unbuffered text I/O")
        if newline not in (None, "", "\n", "\r", "\r\n"):
            raise ValueError(f"illegal newline value: {newline!r}")
        self.encoding = encoding or "utf-8"
        codecs.lookup(self.encoding)
        self.buffering, self.errors, self.newline = buffering, errors, newline

    @property
    def reads(self) -> bool:
        """Whether the file may be read."""
        return self.plain[0] == "r" or "+" in self.plain

    @property
    def writes(self) -> bool:
        """Whether the file may be written."""
        return self.plain != "r"


class _Ending:
    """The end of a `with` statement around a file."""

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, where: Any) -> None:
        """Close the file. If the body raised an error, keep that, with a note about the file."""
        try:
            self.close()  # type: ignore[attr-defined]
        except NotDelivered as exc:
            note_or_raise(exc, error)


class RawFile(_Ending, io.RawIOBase):
    """An open file without a buffer.

    Attributes:
        name, mode: as of io.FileIO.
    """

    def __init__(self, opened: Opened, loop: LoopThread[Any], mode: Mode, owner: object = None) -> None:
        """Wrap an open file; `owner` lives as long as this one."""
        super().__init__()
        self._owner = owner
        self.name = opened.name
        self.mode = mode.plain + "b"
        self._opened = opened
        self._loop = loop
        self._mode = mode
        self._pid = os.getpid()
        self._at = opened.size if mode.plain[0] == "a" else 0
        self._read_to, self._ahead = -1, FIRST_READ

    @property
    def size(self) -> int:
        """Bytes."""
        return self._opened.size

    def readable(self) -> bool:
        """Return whether the file may be read."""
        return self._mode.reads

    def writable(self) -> bool:
        """Return whether the file may be written."""
        return self._mode.writes

    def seekable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any, /) -> int:
        """Fill the buffer up to the end of the file, or a part of a large buffer; return the number of
        bytes."""
        self._require(self._mode.reads, "readable")
        view = memoryview(buffer).cast("B")
        size = len(view)
        if self._mode.buffering != 0 and size <= READ_BUFFER:  # a program that wants more asks for more
            further = self._at == self._read_to
            self._ahead = min(2 * self._ahead, READ_BUFFER) if further else FIRST_READ
            size = min(size, self._ahead)
        data = self._loop.call(self._opened.read, self._at, size)
        view[: len(data)] = data
        self._at += len(data)
        self._read_to = self._at
        return len(data)

    def readall(self) -> bytes:
        """Return everything from the position on."""
        self._require(self._mode.reads, "readable")
        data = self._loop.call(self._opened.read_to_end, self._at)
        self._at += len(data)
        return data

    def write(self, data: Any, /) -> int:
        """Write all of `data`; see Opened.write."""
        taken = bytes(memoryview(data))  # a copy: the program may interrupt the call, and change the buffer
        self._require(self._mode.writes, "writable")
        at = None if self._mode.plain[0] == "a" else self._at
        try:
            self._at = self._loop.call(self._opened.write, at, taken)
        except BaseException as exc:  # if bytes were written, Python's buffer writes them again
            self._opened.fail(exc)
            raise
        return len(taken)

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Set the position, and return it."""
        self._require(True, "")
        starts = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._opened.size}
        if whence not in starts:
            raise ValueError(f"invalid whence ({whence}, should be 0, 1 or 2)")
        if starts[whence] + offset < 0:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        self._at = starts[whence] + offset
        return self._at

    def tell(self) -> int:
        """Return the position."""
        self._require(True, "")
        return self._at

    def truncate(self, size: int | None = None, /) -> int:
        """Cut or extend the file to `size`, or to the position; return the size."""
        self._require(self._mode.writes, "writable")
        size = self._at if size is None else size
        if size < 0:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        self._loop.call(self._opened.truncate, size)
        return size

    def close(self) -> None:
        """Close the file; return when its content is on the card, verified.

        Raises:
            NotDelivered: the card does not have it; `on_vehicle` says what is there.
        """
        if self.closed:
            return
        super().close()
        try:
            self._loop.call(self._opened.close)
        except Closed:
            if self._mode.writes:
                raise
        except KeyboardInterrupt as exc:
            if self._mode.writes:
                exc.add_note(f"{self.name} was not closed: {whereabouts(self._opened.there)}")
            raise

    def __del__(self) -> None:
        """Post the rest of the work, without waiting."""
        if self.closed or getattr(self, "_pid", None) != os.getpid():
            return
        super().close()
        if self._opened.closed:
            return
        lost = ": its changes are discarded" if self._mode.writes else ""
        self._loop.post(self._opened.abandon)
        if lost:
            log.error("%s was not closed%s", self.name, lost)
        warnings.warn(f"{self.name} was not closed{lost}", ResourceWarning, stacklevel=2, source=self)

    def _require(self, allowed: bool, what: str) -> None:
        if self.closed:
            raise ValueError("I/O operation on closed file")
        if not allowed:
            raise io.UnsupportedOperation(f"not {what}")


class _Buffer(_Ending):
    def __del__(self) -> None:
        """Do as RawFile's, which follows, because Python's would deliver, and wait."""


class _Reader(_Buffer, io.BufferedReader): ...


class _Writer(_Buffer, io.BufferedWriter): ...


class _Random(_Buffer, io.BufferedRandom): ...


class _Text(_Buffer, io.TextIOWrapper): ...


def python_file(opened: Opened, loop: LoopThread[Any], mode: Mode, *, owner: object = None) -> IO[Any]:
    """Return the file that the builtin open() would; `owner` lives as long as the file."""
    raw: Any = RawFile(opened, loop, mode, owner)
    if mode.buffering == 0:
        return raw  # type: ignore[no-any-return]
    size = mode.buffering if mode.buffering > 1 else WRITE_BUFFER if mode.writes else READ_BUFFER
    kind = _Random if mode.reads and mode.writes else _Writer if mode.writes else _Reader
    buffered: Any = kind(raw, size)
    if not mode.text:
        return buffered  # type: ignore[no-any-return]
    text = _Text(buffered, mode.encoding, mode.errors, mode.newline, mode.buffering == 1)
    text.mode = mode.plain  # type: ignore[misc]
    return text
