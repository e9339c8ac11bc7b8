"""client.manifest: the downloaded logs, in a file that a power cut may end anywhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mavftpfs.client.manifest import NAME, Downloaded, Manifest

LOG = Downloaded("/log/1.ulg", "1.ulg", 100, None, proven=False)


def test_what_was_noted_last_counts(tmp_path: Path) -> None:
    manifest = Manifest(tmp_path)
    manifest.note(LOG)
    manifest.note(replace(LOG, vehicle="a"))
    manifest.note(replace(LOG, proven=True))
    again = Manifest(tmp_path)
    assert again.of(None, LOG.path) == replace(LOG, proven=True)
    assert again.of("a", LOG.path) == replace(LOG, vehicle="a")
    assert again.of("b", LOG.path) is None


def test_a_name_that_is_no_text(tmp_path: Path) -> None:
    odd = replace(LOG, path="/log/\udcff", file="\udcff")
    Manifest(tmp_path).note(odd)
    assert Manifest(tmp_path).of(None, odd.path) == odd


def test_a_line_that_was_cut_spoils_no_other(tmp_path: Path) -> None:
    Manifest(tmp_path).note(LOG)
    whole = (tmp_path / NAME).read_bytes()
    for cut in range(len(whole)):
        (tmp_path / NAME).write_bytes(whole + whole[:cut])
        manifest = Manifest(tmp_path)
        assert manifest.of(None, LOG.path) == LOG
        manifest.note(replace(LOG, path="/log/2.ulg"))
        assert Manifest(tmp_path).of(None, "/log/2.ulg") is not None


def test_what_others_wrote_there_is_left_out(tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(b'\xff\n[1]\n{"path": 1}\n{"path": 1, "file": "", "size": 2, "mtime": 3}\n')
    manifest = Manifest(tmp_path)
    manifest.note(LOG)
    assert Manifest(tmp_path).of(None, LOG.path) == LOG
