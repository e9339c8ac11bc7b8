"""shared.errnos is total, and says what servers.md 12 and 14.35 ask for."""

from __future__ import annotations

import errno

import pytest

from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared import errnos, errors
from mavftpfs.shared.errnos import errno_for

REQUESTS = [opcode for opcode in Opcode if opcode < Opcode.ACK]
SESSION_REQUESTS = [opcode for opcode in REQUESTS if opcode not in errnos.PATH_OPCODES]


def nak(opcode: int, code: int, server_errno: int | None = None) -> int:
    return errno_for(errors.FtpNak(opcode, code, server_errno))


def all_error_classes() -> list[type[errors.MavftpfsError]]:
    found = [errors.MavftpfsError]
    for cls in found:
        found.extend(cls.__subclasses__())
    return [cls for cls in found if cls.__module__ == errors.__name__]


def test_path_opcodes_are_those_with_a_path() -> None:
    without = {0, 1, 2, Opcode.READ_FILE, Opcode.WRITE_FILE, Opcode.BURST_READ_FILE}
    without.add(Opcode.TRUNCATE_FILE)  # is never sent
    assert {int(opcode) for opcode in REQUESTS} - without == errnos.PATH_OPCODES


@pytest.mark.holds("fault NAK")
@pytest.mark.parametrize("opcode", [*REQUESTS, 17, 255])
def test_every_opcode_code_and_errno_gives_a_real_errno(opcode: int) -> None:
    for code in range(256):
        for server_errno in (None, *range(256)) if code == NakCode.FAIL_ERRNO else (None, 17):
            number = nak(opcode, code, server_errno)
            assert number in errno.errorcode
            assert number not in (errno.ENOSYS, 0), "ENOSYS would silence the kernel for good"


def test_every_error_class_is_in_the_table() -> None:
    """A new class must not become EIO because nobody thought of it."""
    inherits = {errors.FtpNak, errors.LinkClosed, errors.ProtocolError, errors.SessionTaken}
    assert set(all_error_classes()) - inherits == set(errnos._BY_CLASS)


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (errors.NotFound("x"), errno.ENOENT),
        (errors.PathTooLong("x"), errno.ENAMETOOLONG),
        (errors.VehicleLost("x"), errno.ETIMEDOUT),
        (errors.LinkClosed("x"), errno.EIO),
        (errors.MavftpfsError("x"), errno.EIO),
        (ValueError("a bug"), errno.EIO),
    ],
)
def test_errors_without_a_nak(error: Exception, expected: int) -> None:
    assert errno_for(error) == expected


OPEN, FAILED = Opcode.OPEN_FILE_RO, NakCode.FAIL_ERRNO


@pytest.mark.holds("rule 14.35")
@pytest.mark.parametrize(
    ("opcode", "code", "number", "expected"),
    [
        (OPEN, NakCode.FAIL, None, errno.EIO),
        (OPEN, NakCode.INVALID_DATA_SIZE, None, errno.ENAMETOOLONG),
        (OPEN, NakCode.INVALID_SESSION, None, errno.EBUSY),
        (OPEN, NakCode.NO_SESSIONS_AVAILABLE, None, errno.EBUSY),
        (OPEN, NakCode.EOF, None, errno.EIO),
        (OPEN, NakCode.UNKNOWN_COMMAND, None, errno.EOPNOTSUPP),
        (OPEN, NakCode.FILE_PROTECTED, None, errno.EACCES),
        (OPEN, NakCode.FILE_NOT_FOUND, None, errno.ENOENT),
        (OPEN, 201, None, errno.EIO),
        # Sticky where nothing is made.
        (OPEN, NakCode.FILE_EXISTS, None, errno.EIO),
        (Opcode.LIST_DIRECTORY, NakCode.FILE_EXISTS, None, errno.EIO),
        (Opcode.REMOVE_FILE, NakCode.FILE_EXISTS, None, errno.EIO),
        (Opcode.CREATE_FILE, NakCode.FILE_EXISTS, None, errno.EEXIST),
        (Opcode.CREATE_DIRECTORY, NakCode.FILE_EXISTS, None, errno.EEXIST),
        (Opcode.RENAME, NakCode.FILE_EXISTS, None, errno.EEXIST),
        # Old servers lack this.
        (Opcode.LIST_DIRECTORY_WITH_TIME, NakCode.FAIL, None, errno.EOPNOTSUPP),
        (Opcode.LIST_DIRECTORY_WITH_TIME, NakCode.UNKNOWN_COMMAND, None, errno.EOPNOTSUPP),
        # Low numbers are the same everywhere.
        *((OPEN, FAILED, number, number) for number in (1, 13, 17, 28, 30)),
        # Others by an allow list, of Linux and of newlib.
        *((OPEN, FAILED, number, errno.ENAMETOOLONG) for number in (36, 91)),
        *((OPEN, FAILED, number, errno.ENOTEMPTY) for number in (39, 90)),
        *((OPEN, FAILED, number, errno.ELOOP) for number in (40, 92)),
        (OPEN, FAILED, 88, errno.EOPNOTSUPP),
        *((OPEN, FAILED, number, errno.EIO) for number in (0, 255, None)),
        # A full directory has many numbers.
        *((Opcode.REMOVE_DIRECTORY, FAILED, number, errno.ENOTEMPTY) for number in (17, 21, 39, 90)),
    ],
)
def test_what_a_refusal_means(opcode: int, code: int, number: int | None, expected: int) -> None:
    assert nak(opcode, code, number) == expected


@pytest.mark.holds("rule 14.35")
@pytest.mark.parametrize("opcode", SESSION_REQUESTS)
def test_a_request_on_an_open_file_cannot_say_that_a_name_exists_or_is_missing(opcode: int) -> None:
    """8 there is PX4's sticky EEXIST, 10 is ArduPilot's lost session."""
    for code in (NakCode.FILE_EXISTS, NakCode.FILE_NOT_FOUND):
        assert nak(opcode, code) == errno.EIO
    for number in (errno.EEXIST, errno.ENOENT, errno.ENOTEMPTY, errno.ENOTDIR):
        assert nak(opcode, NakCode.FAIL_ERRNO, number) == errno.EIO


def test_a_refusal_is_told_in_words_and_numbers() -> None:
    told = str(errors.FtpNak(Opcode.RENAME, NakCode.FAIL_ERRNO, 13))
    assert told == "the vehicle refused to rename it: permission denied (opcode 13, NAK 2, errno 13)"
    assert "a name that the card cannot store" in str(errors.FtpNak(Opcode.RENAME, NakCode.FAIL_ERRNO, 22))
    assert "the card is full" in str(errors.FtpNak(Opcode.WRITE_FILE, NakCode.FAIL_ERRNO, 28))
    for opcode in set(Opcode) - {Opcode.NONE, Opcode.RESET_SESSIONS, Opcode.ACK, Opcode.NAK}:
        assert "do that" not in str(errors.FtpNak(opcode, NakCode.FAIL)), "each has its words"
    for code in set(NakCode) - {NakCode.NONE}:
        assert "without" not in str(errors.FtpNak(Opcode.READ_FILE, code))
