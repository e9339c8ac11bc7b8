"""A vehicle whose listings lie, or that does not answer."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.sim.tree import MemoryTree
from tests.mount.conftest import Field
from tests.support.mounts import Mount, mounted_at
from tests.support.replies import ack, nak

GOOD = b"good"
GOOD_NAMES = {"good.txt", "no_size", "caf\udce9"}
"""The names of the directory /names that may appear, as os.listdir shows them; all hold GOOD."""

NAMES = (
    b"F../../etc/passwd\t4",
    b"F/etc/shadow\t4",
    b"D..",
    b"D.",
    b"F\t4",
    b"D",
    b"S",
    b"Xunknown\t4",
    b"Fgood.txt\t4",
    b"Fgood.txt\t4",
    b"Dgood.txt",
    b"Fno_size",
    b"Fcaf\xe9\t4",
    b"Fsub/dir\t4",
)


def card() -> MemoryTree:
    """Return the vehicle's files."""
    tree = MemoryTree()
    for name in GOOD_NAMES:
        tree.add(b"/names/" + os.fsencode(name), GOOD)
    for name in ("same", "refused"):
        tree.add_directory(f"/{name}".encode())
    return tree


def listing(request: Payload) -> list[Payload] | None:
    """Answer requests for pages of the bad directories."""
    if request.opcode != Opcode.LIST_DIRECTORY:
        return None
    match request.data.strip(b"/\0"):
        case b"same":
            names = [b"Fsame_for_ever\t4"]
        case b"names":
            names = list(NAMES[request.offset : request.offset + 5])
        case b"refused":
            return [nak(request, NakCode.FILE_NOT_FOUND)]
        case _:
            return None
    return [ack(request, b"\0".join(names) + b"\0") if names else nak(request, NakCode.EOF)]


@pytest.fixture(scope="module")
def liar(module_field: Field) -> Mount:
    """A mount of the vehicle with hostile listings."""
    vehicle = module_field.lying(card())
    vehicle.server.answer = listing
    return module_field.mount(vehicle.source, "dir_timeout=600")


@pytest.mark.holds("promise 10", "fault odd listing")
def test_only_usable_names_enter_the_tree(liar: Mount) -> None:
    out = liar.python("import os, sys; print(ascii(sorted(os.listdir(sys.argv[1]))))", liar.path / "names")
    assert out.strip() == ascii(sorted(GOOD_NAMES))
    for name in sorted(GOOD_NAMES):
        assert liar.read_bytes(liar.path / "names" / name) == GOOD


def test_a_vehicle_that_never_answers_ftp_is_exit_2(field: Field) -> None:
    vehicle = field.lying(card())
    vehicle.server.answer = lambda request: []
    mount = field.prepare(vehicle.source)
    result = mount.run(
        sys.executable, "-m", "mavftpfs", vehicle.source, mount.path, "-o", "connect_timeout=3", code=2
    )
    assert len(result.stderr.splitlines()) == 1, result.stderr
    assert "FTP" in result.stderr
    assert not mounted_at(mount.path)


@pytest.mark.holds("promise 10")
@pytest.mark.parametrize(("directory", "shown"), [("same", ["same_for_ever"]), ("refused", [])])
def test_programs_end_with_an_error_where_a_directory_was_not_listed_to_its_end(
    liar: Mount, tmp_path: Path, directory: str, shown: list[str]
) -> None:
    """`same` repeats its first page for ever, and listing `refused` is refused as if it were not there. A
    backup must not lose what they do not show."""
    backup = tmp_path / "backup"
    backup.mkdir()
    (backup / "kept").write_text("shown by no page")
    where = liar.path / directory
    assert liar.run("ls", where, code=2).stdout.split() == shown
    liar.run("find", where, code=1)
    liar.run("rsync", "-a", "--delete", f"{where}/", backup, code=23)
    assert (backup / "kept").exists()
    get = (sys.executable, "-m", "mavftpfs", "get", "-r", "--to", tmp_path, liar.path)
    complaints = liar.run(*get, "/names", f"/{directory}", code=2).stderr.splitlines()
    assert [f"/{directory}" in line for line in complaints] == [True]
    assert (tmp_path / "names" / "good.txt").read_bytes() == GOOD
