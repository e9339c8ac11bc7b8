"""cli and commands: words, exit codes, one line of complaint. Nothing here needs a vehicle."""

from __future__ import annotations

import argparse
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from mavftpfs import __main__
from mavftpfs.cli import commands
from mavftpfs.cli import main as cli
from mavftpfs.client import connect as compose
from mavftpfs.client import control, mounts
from mavftpfs.shared import errors
from mavftpfs.shared.errors import (
    ExitCode,
    MavftpfsError,
    MountFailed,
    NoFtp,
    NotDelivered,
    UsageError,
    VehicleLost,
    exit_code_for,
)
from mavftpfs.shared.options import Options
from tests.support.vehicles import free_udp_port
from tests.unit.test_daemon import restored_logging

__all__ = ["restored_logging"]

SOURCE = "udpin:127.0.0.1:0"


def complaint(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    """Run a command that must fail with one line on stderr and nothing on stdout."""
    code = cli.main(words)
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("mavftpfs: ")
    return code, lines[0]


# -- exit codes -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (UsageError("x"), 1),
        (VehicleLost("x"), 2),
        (NoFtp("x"), 2),
        (errors.RequestTimeout("x"), 2),
        (MountFailed("x"), 3),
        (NotDelivered("x"), 4),
        (control.NobodyThere("x"), 3),
        (MavftpfsError("x"), 2),
    ],
)
def test_exit_codes(error: MavftpfsError, code: int) -> None:
    assert exit_code_for(error) == code


# -- words ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ((SOURCE,), "MOUNTPOINT"),
        (("lss", SOURCE, "/"), "'lss' is neither a command"),
        (("lss", "/tmp"), "did you mean ls?"),
        ((SOURCE, "/mnt", "-o", "dir_timout=3"), "did you mean dir_timeout?"),
        (("lss", SOURCE), "did you mean ls?"),
        (("/tmp", SOURCE), "SOURCE comes first"),
        ((".", SOURCE), "SOURCE comes first"),
        (("ls",), "required: SOURCE; try"),
        (("rm", "/tmp"), "required: PATH; try"),
        (("cat", "~/drone/x*"), "does not expand ~ in quotes"),
        (("mkdir", "~/drone", "/x"), "does not expand ~ in quotes"),
        (("~/drone", "/mnt"), "does not expand ~ in quotes"),
        (("param",), "required: SOURCE; try"),
        ((SOURCE, "/mnt", "extra"), "extra"),
        ((SOURCE, "/mnt", "-o"), "-o"),
        (("mount", SOURCE), "MOUNTPOINT"),
        (("warp:9", "/mnt"), "warp"),
        ((f"{SOURCE}#/a", "/mnt", "-o", "root=/b"), "root="),
        (("get", SOURCE), "PATH"),
        (("get", SOURCE, "mftp://comp=1:/a", "mftp://comp=2:/a"), "components"),
        (("ls", SOURCE, "-l", "mftp://comp=300:/a"), "'300' is not"),  # an option may stand between
        (("ls", SOURCE, "/", "-o", "uid=x"), "uid"),
        (("put", SOURCE, "/etc/hostname"), "PATH"),
        (("put", SOURCE, "/proc/none/file", "/x"), "/proc/none/file"),
        (("put", SOURCE, "/etc", "/x"), "-r"),
        (("rm", SOURCE, "-r", "mftp:///"), "root"),
        (("mv", SOURCE, "/a"), "NEW"),
        (("crc", SOURCE, "/x", "-o", "signing_key=/proc/none/key"), "/proc/none/key"),
        (("ls", SOURCE, "/", "-o", "tlog=/proc/none/t"), "/proc/none/t"),
        (("sync", SOURCE, "/tmp", "--json"), "--json"),
        (("recover", SOURCE, "--all", "--force"), "--force"),
        (("recover", "--json"), "--json"),
        (("ls", "-t", SOURCE), "-t"),
        (("install", "--root", "/x"), "--root"),
        (("ls", "/etc", "/"), "no vehicle is mounted on /etc"),
        (("sync", SOURCE, "/tmp", "--newest", "0"), "not a number"),
        (("get", SOURCE, "/a", "--to", "-"), "mavftpfs cat"),
        (("sim", "/proc/none/a b"), "mkdir -p '/proc/none/a b/fs/microsd/log'"),
        (("sim", "/proc/none/a", "--profile", "ardupilot"), "mkdir -p /proc/none/a/APM/LOGS"),
        (("sync", SOURCE, "/tmp", "--since", "soon"), "not a date"),
    ],
)
def test_usage_errors_are_one_line_and_exit_1(
    capsys: pytest.CaptureFixture[str], words: tuple[str, ...], named: str
) -> None:
    code, line = complaint(capsys, *words)
    assert code == 1
    assert named in line


def test_harmless_flags_of_0_2_are_ignored_and_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ran: list[argparse.Namespace] = []

    def run(args: argparse.Namespace) -> int:
        ran.append(args)
        return 0

    for (name, flag), advice in cli._GONE_FLAGS.items():
        make_parser, _ = cli._COMMANDS[name]
        monkeypatch.setitem(cli._COMMANDS, name, (make_parser, run))
        assert cli.main([name, SOURCE, flag, "/a"]) == 0
        assert f"mavftpfs: {flag} is gone, and is ignored: {advice}\n" in capsys.readouterr().err
        assert flag not in make_parser(name).format_help()
    assert len(ran) == len(cli._GONE_FLAGS)


def test_no_words_show_ten_commands_that_can_be_typed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    shown = re.findall(r"^  mavftpfs (.*\S)  +\S.*$", err, re.MULTILINE)
    assert len(shown) == 10
    for words in map(shlex.split, shown):
        name = words[0] if words[0] in cli._COMMANDS else "mount"
        cli._COMMANDS[name][0](name).parse_intermixed_args(words[words[0] == name :])
    assert all(place in err for place in ("mavftpfs --help", "man mavftpfs", "docs/guide.md"))
    assert max(map(len, err.splitlines())) <= 80


@pytest.mark.parametrize("command", ["", *cli._COMMANDS])
def test_help_fits_80_columns(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        cli.main([*filter(None, [command]), "--help"])
    assert [line for line in capsys.readouterr().out.splitlines() if len(line) > 80] == []


@pytest.mark.usefixtures("restored_logging")
def test_a_command_names_an_option_that_is_gone(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(("ls", "/dev/ttyNOWHERE", "/", "-o", "window=4"))
    assert "option window is gone, and is ignored: " in capsys.readouterr().err


UNITS_OF_0_2 = [
    ("/dev/ttyACM0", "/home/me/drone-ttyACM0", "-o", ""),
    ("/dev/ttyACM0", "/home/me/drone-ttyACM0", "-o", "ro,cache_dir=/var/tmp/drone"),
]
"""The commands in ExecStart of older units, as they were and as their own examples changed them."""


@pytest.mark.parametrize("words", UNITS_OF_0_2)
def test_units_of_0_2_go_on_to_start(monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]) -> None:
    started: list[Options] = []

    def start(args: argparse.Namespace) -> int:
        started.append(commands.connection_of(args)[0])
        return 0

    monkeypatch.setattr(commands, "mount", start)
    assert cli.main(words) == 0
    assert len(started) == 1


FSTAB_OF_0_2 = (
    "noauto,nofail,_netdev,x-systemd.automount,x-systemd.mount-timeout=40,allow_other,uid=1000,auto_unmount,"
    "fsname=drone,root=/fs/microsd,attr_timeout=5,negative_timeout=5,cache_dir=/var/cache/drone,"
    "verify=size,dirty_max=1M,spool_max=2G,rmw_max=16M,source_component=25,heartbeat=onboard,window=8,"
    "local=+*.tmp,log_file=/var/log/drone.log,trace=/var/log/drone.json"
)


def test_a_line_of_fstab_of_0_2_goes_on_to_mount(monkeypatch: pytest.MonkeyPatch) -> None:
    """`-f` only checks the words. mount(8) adds some of its own."""
    words = ["mount.mavftpfs", SOURCE, "/mnt/drone", "-f", "-o", f"rw,{FSTAB_OF_0_2}"]
    monkeypatch.setattr("sys.argv", words)
    assert cli.mount_helper() == 0


def test_words_of_0_2_that_belong_to_source_are_translated() -> None:
    args = argparse.Namespace(source="/dev/ttyX", options=["baud=921600,root=/fs/microsd/"])
    options, spec = commands.connection_of(args)
    plain = argparse.Namespace(source="/dev/ttyX,921600#/fs/microsd", options=[])
    same, there = commands.connection_of(plain)
    assert (spec.description, options.root) == (there.description, same.root)
    assert len(options.gone) == 2


def test_a_baud_rate_means_nothing_where_no_serial_port_is() -> None:
    options, _ = commands.connection_of(argparse.Namespace(source=SOURCE, options=["window=4,baud=57600"]))
    window, baud = options.gone
    assert window.startswith("option window is gone")
    assert baud == "option baud is gone, and means nothing here: SOURCE is not a serial port"


def test_relative_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    args = argparse.Namespace(source="/dev/ttyX", options=["tlog=a/b.log"])
    options, _ = commands.connection_of(args)
    monkeypatch.chdir(tmp_path)
    assert commands.absolute_paths(options).tlog == str(tmp_path / "a" / "b.log")


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        (b"/logs/a b", "'/logs/a b'"),
        ("/Flüge".encode(), "'/Flüge'"),
        (b"it's", "'it's'"),
        (b"\xff\x1b[2J", "'\\xff?[2J'"),
    ],
)
def test_names_of_the_vehicle_are_shown_as_they_are_read(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: bytes, shown: str
) -> None:
    def fail(args: argparse.Namespace) -> tuple[Options, Any]:
        raise errors.NotFound(f"{name!r} does not exist, nor does {name!r}")

    monkeypatch.setattr(commands, "connection_of", fail)
    code, line = complaint(capsys, SOURCE, "/mnt")
    assert (code, line) == (1, f"mavftpfs: {shown} does not exist, nor does {shown}")


def test_a_bug_is_one_line_without_d(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(args: argparse.Namespace) -> tuple[Options, Any]:
        raise ValueError("surprise")

    monkeypatch.setattr(commands, "connection_of", fail)
    code, line = complaint(capsys, SOURCE, "/mnt")
    assert code == ExitCode.BUG
    assert "surprise" in line
    with pytest.raises(ValueError, match="surprise"):
        cli.main([SOURCE, "/mnt", "-d"])


def test_a_reader_that_leaves_ends_a_command_as_sigpipe_would(tmp_path: Path) -> None:
    code = (
        "import sys; from mavftpfs.cli import commands, main as cli\n"
        "def crowd(args):\n    [print('x' * 1000) for _ in range(1000)]\n"
        "cli._COMMANDS['ls'] = (cli._ls_parser, crowd)\n"
        "sys.exit(cli.main(['ls', 'udpin:127.0.0.1:0']))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()
        child.stdout.close()
        assert child.stderr is not None
        assert child.stderr.read() == b""
        assert child.wait(90) == 128 + signal.SIGPIPE, "it did not do all that it was asked for"


def test_streams_that_the_caller_closed_are_no_error(tmp_path: Path) -> None:
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "HOME": str(tmp_path)}
    command = f"{shlex.quote(sys.executable)} -m mavftpfs status <&- >&-"
    done = subprocess.run(
        ["sh", "-c", command], env=environment, stderr=subprocess.PIPE, text=True, timeout=90, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_what_came_from_stdin_is_kept_if_there_is_no_vehicle(tmp_path: Path) -> None:
    words = ["put", f"udpin:127.0.0.1:{free_udp_port()}", "-", "/fs/note.txt", "-o", "connect_timeout=1"]
    done = subprocess.run(
        [sys.executable, "-m", "mavftpfs", *words],
        env={**os.environ, "XDG_STATE_HOME": str(tmp_path)},
        input="made by a long computation\n",
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
    )
    assert done.returncode == ExitCode.NO_VEHICLE
    (kept,) = tmp_path.rglob("stdin")
    assert done.stderr.rstrip().endswith(f"the bytes from stdin are kept in {kept}")
    assert kept.read_text() == "made by a long computation\n"


def test_ctrl_c_while_modules_load_is_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted() -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "main", interrupted)
    assert __main__.main() == 130


def test_commands_that_mount_nothing_need_no_libfuse() -> None:
    code = "import sys; sys.modules['pyfuse3'] = None; import mavftpfs.cli.verbs, mavftpfs.cli.demo"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=90)


@pytest.mark.parametrize("words", [["--help"], ["sim", "--help"], ["status"], ["umount", "/proc/none"]])
def test_commands_that_only_ask_load_no_event_loop(tmp_path: Path, words: list[str]) -> None:
    """The libraries take most of the time until such a command prints a line."""
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('trio', 'pymavlink', 'rich')))\n"
        f"from mavftpfs.cli.main import main; sys.exit(main({words}))"
    )
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=90, check=False
    )
    assert "internal error" not in done.stderr
    assert "Traceback" not in done.stderr


# -- status and umount ----------------------------------------------------------------------------


def test_status_of_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "BOUND", tmp_path / "none")  # not those of other tests that run just now
    monkeypatch.setattr(mounts, "mounts", dict)
    code, line = complaint(capsys, "status", str(tmp_path / "mnt"))
    assert code == 3
    assert str(tmp_path / "mnt") in line
    assert cli.main(["status"]) == 0
    assert "no vehicle" in capsys.readouterr().out


# -- signing keys ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "mode", "key"),
    [
        (bytes(range(32)), 0o600, bytes(range(32))),
        (bytes(range(32)).hex().encode() + b"\n", 0o600, bytes(range(32))),
        (
            b"correct horse\n",
            0o600,
            bytes.fromhex("4104d36f8da2c254349f85836793ebe029e0c957063a34c91c2e9203187b5631"),
        ),
        (b"\n", 0o600, "the file is empty"),
        (bytes(32), 0o640, "mode 0640 lets others use the key; run: chmod 600 "),
        (bytes(32), 0o602, "mode 0602 lets others use the key; run: chmod 600 "),
    ],
)
def test_signing_keys(tmp_path: Path, content: bytes, mode: int, key: bytes | str) -> None:
    path = tmp_path / "key"
    path.write_bytes(content)
    path.chmod(mode)
    if isinstance(key, bytes):
        assert compose.read_key(str(path)) == key
        return
    with pytest.raises(UsageError, match=key):
        compose.read_key(str(path))
