"""`mavftpfs param`, as a user runs it: on a link of its own, and through a mount."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import command
from tests.support.terminal import Terminal


@pytest.fixture(scope="module", params=["link", "mount"])
def source(request: pytest.FixtureRequest, module_field: Field, small_tree: Path) -> str:
    """A vehicle, mounted or not."""
    vehicle = module_field.sim(small_tree, "ardupilot5")
    if request.param == "mount":
        return str(module_field.mount(vehicle.source).path)
    return str(vehicle.source)


THROUGH_A_MOUNT = pytest.mark.parametrize("source", ["mount"], scope="module", indirect=True)
"""Cases that do not depend on the way to the vehicle."""


def param(source: str, *words: object, code: int = 0) -> list[str]:
    """Return the lines of stdout."""
    return command("param", source, *words, code=code)[0].splitlines()


def said(source: str, *words: object, code: int = 0) -> str:
    """Return what went to stderr."""
    return command("param", source, *words, code=code)[1]


def test_printing(source: str) -> None:
    assert param(source, "wpnav*", "RTL_ALT") == ["WPNAV_SPEED,1000", "RTL_ALT,1500"]
    assert param(source, "BATT*")  # as the guide shows it
    assert len(param(source)) > 60
    assert "SERVO1_MIN,1101 # default 1100" in param(source, "--changed")
    assert not any(line.startswith("RTL_ALT") for line in param(source, "--changed"))
    (facts,) = json.loads("\n".join(param(source, "--json", "ATC_RAT_PIT_P")))
    assert facts == {"name": "ATC_RAT_PIT_P", "type": "float", "value": 0.135, "default": 0.135}
    assert "no parameter is called NOPE*" in said(source, "NOPE*", code=1)


def test_versions_with_parameters_are_named_where_a_vehicle_has_none(field: Field, small_tree: Path) -> None:
    for words in (("RTL*",), ("--save", "-"), ("RTL_ALT=1",)):
        line = said(field.sim(small_tree).source, *words, code=1)
        assert "ArduPilot has them since 2020, PX4 since September 2026: update its firmware" in line


def test_setting(source: str) -> None:
    assert param(source, "rtl_alt=3000") == ["RTL_ALT 1500 -> 3000"]
    assert param(source, "RTL_ALT") == ["RTL_ALT,3000"]
    assert "already has these values" in said(source, "RTL_ALT=3000.0")
    lines = said(source, "RTL_ALT=1500", "WPNAV_SPEED=750.5").splitlines()
    assert lines == ["RTL_ALT 3000 -> 1500", "WPNAV_SPEED 1000 -> 750.5", "2 set"]
    assert param(source, "WPNAV_SPEED=1000", "--yes") == ["WPNAV_SPEED 750.5 -> 1000"]
    told = json.loads("\n".join(param(source, "RTL_ALT=1600", "--json")))
    assert told == {"set": [{"name": "RTL_ALT", "from": 1500, "to": 1600}], "error": None}
    param(source, "RTL_ALT=1500")
    for words, why in ((["RTL_ALT=x"], "'x' is not a number"), (["--load", "/nowhere/x"], "No such file")):
        told = json.loads("\n".join(param(source, "--json", *words, code=1)))
        assert told["set"] == []
        assert why in told["error"]


WRONG = {
    ("RTL_ALT=x",): "'x' is not a number",
    ("RTL_ALT", "=", "3"): "without blanks: RTL_ALT=3",
    ("RTL_ALT", "=3"): "without blanks: RTL_ALT=3",
    ("RTL_ALT=", "3"): "without blanks: RTL_ALT=3",
    ("=3",): "write NAME=VALUE",
    ("RTL_ALT=1.5",): "not a whole number",
    ("RTL_ALT=1", "rtl_alt=2"): "has two values",
    ("NOPE=1",): "has no NOPE",
    ("RTL_ALT=1", "WPNAV_SPEED"): "not both",
    ("--load", "/nowhere/x"): "No such file",
    ("--load", "x", "--diff", "y"): "one thing",
    ("--skip-unknown",): "--load",
}


@THROUGH_A_MOUNT
def test_what_cannot_be_is_one_line_and_sets_nothing(source: str) -> None:
    for words, named in WRONG.items():
        (line,) = said(source, *words, code=1).splitlines()
        assert named in line
    assert param(source, "RTL_ALT") == ["RTL_ALT,1500"]


@THROUGH_A_MOUNT
def test_saving_comparing_and_loading(source: str, tmp_path: Path) -> None:
    saved, qgc = tmp_path / "a.parm", tmp_path / "a.params"
    param(source, "--save", saved)
    param(source, "--save", qgc)
    assert param(source, "--diff", saved) == []
    assert param(source, "--diff", qgc) == []
    assert "# Vehicle-Id" in qgc.read_text()
    param(source, "RTL_ALT=1700", "SERVO1_MIN=900", "-y")
    table = [line.split() for line in param(source, "--diff", saved, code=1)]
    assert table == [["VEHICLE", "FILE"], ["SERVO1_MIN", "900", "1101"], ["RTL_ALT", "1700", "1500"]]
    facts = json.loads("\n".join(param(source, "--diff", saved, "--json", code=1)))
    assert facts[1] == {"name": "RTL_ALT", "vehicle": "1700", "file": "1500"}
    qgc.write_text(re.sub(r"(STAT_RUNTIME\t)\d+", r"\g<1>1000000", qgc.read_text()))  # it moves each second
    told = said(source, "--load", qgc)
    assert "RTL_ALT 1700 -> 1500" in told
    assert "STAT_RUNTIME" in told  # left alone
    assert param(source, "--diff", saved) == []
    names = [line.partition(",")[0] for line in saved.read_text().splitlines()]
    assert [line.partition(",")[0] for line in param(source, "--save", "-")] == names


@THROUGH_A_MOUNT
def test_loading_goes_twice_where_parameters_appear_only_then(source: str, tmp_path: Path) -> None:
    file = tmp_path / "grip.parm"
    file.write_text("GRIP_GRAB,1800\nGRIP_ENABLE,1\nNO_SUCH,4\nRTL_ALT,1500\n")
    assert "has no NO_SUCH" in said(source, "--load", file, code=1)
    param(source, "GRIP_ENABLE=0")
    told = said(source, "--load", file, "--skip-unknown")
    assert "left out" in told
    assert "NO_SUCH" in told
    assert param(source, "GRIP*") == ["GRIP_ENABLE,1", "GRIP_GRAB,1800"]
    param(source, "GRIP_GRAB=1900")
    param(source, "GRIP_ENABLE=0")


@THROUGH_A_MOUNT
def test_lines_of_other_components_are_left_out_or_an_error(source: str, tmp_path: Path) -> None:
    file = tmp_path / "both.params"
    file.write_text("1\t1\tRTL_ALT\t1500\t6\n1\t154\tRTL_ALT\t99\t6\n".replace("\t99\t6", "\t1500\t6"))
    assert "1 line(s) of component 154" in said(source, "--load", file, code=1)
    assert "left out: 1 line(s) of component 154" in said(source, "--load", file, "--skip-unknown")
    assert param(source, "--diff", file) == []


@THROUGH_A_MOUNT
@pytest.mark.parametrize(("answer", "code"), [("y\r", 0), ("n\r", 1), ("\r", 1)])
def test_on_a_terminal_it_asks_before_it_sets_several(source: str, answer: str, code: int) -> None:
    words = ["RTL_ALT=1800", "WPNAV_SPEED=800"]
    terminal = Terminal([sys.executable, "-m", "mavftpfs", "param", source, *words], 100, 30)
    terminal.read_until(lambda shown: "[y/N]" in shown.raw)
    assert "RTL_ALT 1500 -> 1800" in terminal.raw
    terminal.type(answer)
    assert terminal.finish() == code, terminal.raw
    assert param(source, "RTL_ALT") == ["RTL_ALT,1500" if code else "RTL_ALT,1800"]
    if code == 0:
        param(source, "RTL_ALT=1500", "WPNAV_SPEED=1000", "-y")
