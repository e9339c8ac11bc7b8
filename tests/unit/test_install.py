"""The files of `mavftpfs install`, and whether the programs that they are for can read them."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

from mavftpfs.cli import install
from mavftpfs.cli import main as cli
from mavftpfs.mount.options import option_help
from mavftpfs.shared.errors import EXIT_CODES, ExitCode

COMMANDS = [name for name in cli._COMMANDS if name != "mount"]


@pytest.fixture
def pieces() -> dict[str, install.Piece]:
    """Return the files that root would install, by their paths without the first /."""
    program = Path("/opt/py thon/100%/mavftpfs")
    found = install.for_everybody(cli.whole_parser(), program)
    return {piece.path.relative_to("/").as_posix(): piece for piece in found}


def checked(*command: str | Path) -> str:
    """Run a checker and return what it says; it must be content."""
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout + result.stderr


def test_what_was_installed_is_removed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("HOME", "XDG_DATA_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(install, "SYSTEMD_RUNS", tmp_path / "nowhere")
    unit = tmp_path / "systemd/user/mavftpfs@.service"
    assert cli.main(["install"]) == 0
    out = capsys.readouterr().out
    assert f"wrote {unit}" in out
    assert "if the package bash-completion is installed" in out
    assert "sudo loginctl enable-linger $USER" in out
    assert unit.is_file()
    for _ in range(2):
        assert cli.main(["install", "--remove"]) == 0
        assert [path for path in tmp_path.rglob("*") if not path.is_dir()] == []


def test_a_user_needs_no_root(tmp_path: Path) -> None:
    parser = cli.whole_parser()
    found = list(install.for_user(parser, Path("/home/me/.local/bin/mavftpfs"), {"HOME": "/home/me"}))
    paths = [piece.path.as_posix() for piece in found]
    assert all(path.startswith("/home/me/") for path in paths)
    assert "/home/me/.config/systemd/user/mavftpfs@.service" in paths
    assert "/home/me/.config/systemd/user/mavftpfs-sync@.service" in paths
    assert not any("udev" in path for path in paths)
    moved = {"HOME": "/home/me", "XDG_DATA_HOME": "/data", "XDG_CONFIG_HOME": "/config"}
    for piece in install.for_user(parser, Path("/usr/bin/mavftpfs"), moved):
        assert piece.path.as_posix().startswith(("/data/", "/config/"))


def test_the_man_page_has_every_command_option_and_exit_code(pieces: dict[str, install.Piece]) -> None:
    page = pieces["usr/local/share/man/man1/mavftpfs.1"].text.replace("\\", "")
    for name in COMMANDS:
        assert f"\n.SS mavftpfs {name}\n" in page
    for option in option_help():
        assert f"\n.B {option}\n" in page
    assert set(EXIT_CODES) == set(ExitCode)
    assert not re.search(r"^[.'](?!TH|SH|SS|B|BR|I|TP|PP|br|nf|fi)", page, re.MULTILINE)


def test_man_reads_the_pages_without_a_warning(pieces: dict[str, install.Piece], tmp_path: Path) -> None:
    for name in ("man1/mavftpfs.1", "man8/mount.mavftpfs.8"):
        page = tmp_path / Path(name).name
        page.write_text(pieces[f"usr/local/share/man/{name}"].text)
        said = checked("man", "--warnings", "--encoding=UTF-8", "--local-file", page)
        assert "warning" not in said
        assert "drone" in said


def test_the_unit_calls_this_program(pieces: dict[str, install.Piece]) -> None:
    for name, words in (("mavftpfs@", "${MAVFTPFS_SOURCE} "), ("mavftpfs-sync@", "sync %I ")):
        unit = pieces[f"usr/local/lib/systemd/user/{name}.service"].text
        assert f'\nExecStart="/opt/py thon/100%%/mavftpfs" {words}' in unit
        assert "@MAVFTPFS@" not in unit


@pytest.mark.parametrize("name", install.UNITS)
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text(install._unit(Path("/bin/true"), name))
    said = subprocess.run(
        ["systemd-analyze", "verify", "--user", "--man=no", path],
        env={"XDG_RUNTIME_DIR": str(tmp_path), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (said.returncode, said.stderr) == (0, "")


@pytest.mark.parametrize(
    ("unit", "wanted_by"),
    [
        ("mavftpfs@ttyAMA0.service", "dev-ttyAMA0.device"),
        (r"mavftpfs@serial-by\x2did-usb\x2dx.service", r"dev-serial-by\x2did-usb\x2dx.device"),
        ("mavftpfs-sync@udpin:0.0.0.0:14550.service", "default.target"),
    ],
)
def test_units_can_be_enabled(tmp_path: Path, unit: str, wanted_by: str) -> None:
    place = tmp_path / "etc/systemd/user"
    place.mkdir(parents=True)
    for name in install.UNITS:
        (place / name).write_text(install._unit(Path("/bin/true"), name))
    words = ["systemctl", f"--root={tmp_path}", "--global", "enable", unit]
    subprocess.run(words, capture_output=True, timeout=60, check=True)
    link = place / f"{wanted_by}.wants" / unit
    assert link.is_symlink()
    assert Path(link.readlink()).name == f"{unit.partition('@')[0]}@.service"


RULE = re.compile(r'(\w+)(\{\w+\})?(==|!=|\+=|=)"([^"]*)"$')
MATCHES = {"ACTION", "SUBSYSTEM", "KERNEL", "ENV"}
SETS = {"GOTO", "LABEL", "TAG", "ENV"}


def test_every_word_of_the_udev_rule_is_one(pieces: dict[str, install.Piece]) -> None:
    text = pieces["etc/udev/rules.d/70-mavftpfs.rules"].text
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    labels = re.findall(r'LABEL="(\w+)"', text)
    for line in lines:
        for word in line.split(", "):
            match = RULE.match(word)
            assert match, word
            assert match[1] in (MATCHES if match[3] in ("==", "!=") else SETS), word
            assert match[1] != "GOTO" or match[4] in labels, word
