"""Parameters as texts, in real programs: editors, cp, the shell's redirections, git (docs/servers.md 17)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from mavftpfs.parameters.packed import unpack
from tests.mount.conftest import Field
from tests.support.mounts import Mount
from tests.support.terminal import NANO, Terminal

FLOAT_NAME = {"ardupilot5": "ATC_RAT_PIT_P", "px4-2026": "MC_PITCHRATE_P"}
INT_NAME = {"ardupilot5": "RTL_ALT", "px4-2026": "PWM_MAIN_DIS1"}


class Texts:
    """The parameters of a vehicle that is mounted; `told`: what its packed file says."""

    def __init__(self, mount: Mount, profile: str) -> None:
        self.mount = mount
        self.folder = mount.path / "@PARAM"
        self.all = self.folder / "params.parm"
        self.real = FLOAT_NAME[profile]
        self.whole = INT_NAME[profile]

    def values(self) -> dict[str, float]:
        """Return all values."""
        packed = self.mount.read_bytes(self.folder / "param.pck")
        return {one.name: one.value for one in unpack(packed).parameters}

    def told(self, name: str) -> float:
        """Return a value."""
        return self.values()[name]

    def errors(self) -> str:
        """Return what the last save said."""
        return self.mount.read_bytes(self.folder / "last_error.txt").decode()

    def line(self, name: str) -> int:
        """Return the number of a parameter's line."""
        lines = self.mount.read_bytes(self.all).decode().splitlines()
        return next(place for place, line in enumerate(lines, 1) if line.startswith(name + ","))

    def shell(self, command: str, code: int | None = 0) -> str:
        """Run a shell there."""
        done = self.mount.run("sh", "-c", command, cwd=self.folder, code=code)
        return done.stdout + done.stderr


@pytest.fixture(scope="module", params=list(FLOAT_NAME))
def texts(request: pytest.FixtureRequest, module_field: Field, small_tree: Path) -> Iterator[Texts]:
    """A mount of a vehicle with parameters, and a home where vim leaves its backups of what was refused."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(module_field.local("home")))
        source = module_field.sim(small_tree, request.param).source
        mount = module_field.mount(source)
        yield Texts(mount, request.param)
        mount.finish()


@pytest.fixture(autouse=True)
def restored(texts: Texts) -> Iterator[None]:
    """Give the next test the values that this one found."""
    before = texts.values()
    yield
    lines = [f"{name},{before[name]}" for name in (texts.real, texts.whole)]
    texts.shell(f"printf '%s\\n' {' '.join(lines)} >> params.parm")


VIM = "vim -es -N -i NONE -n -u NONE"
BACKUP = f"{VIM} --cmd 'set writebackup backupskip='"
PAUSE = "-c 'call system(\"sleep 1\")'"
"""Parameters that a vehicle sets by itself change each second."""
MOVING = {"ATC_RAT_PIT_P": "STAT_RUNTIME", "MC_PITCHRATE_P": "LND_FLIGHT_T_LO"}


@pytest.mark.parametrize("vim", [VIM, BACKUP])
def test_vim_sets_what_its_user_changed(texts: Texts, vim: str) -> None:
    """vim reads the file once more to make a backup, and values have moved since."""
    before, moving = texts.values(), MOVING[texts.real]
    texts.shell(f"{vim} -c '%s/^{texts.real},.*/{texts.real},0.5/' {PAUSE} -c wq params.parm")
    after = texts.values()
    assert after[texts.real] == 0.5
    assert after[texts.whole] == before[texts.whole]
    assert after[moving] > before[moving]
    assert texts.errors() == ""


def test_vim_on_a_terminal_saves_without_a_question(texts: Texts) -> None:
    """Though what the vehicle sets by itself moved between the listing, the open and the save."""
    texts.shell("ls -l; sleep 1")
    words = ["vim", "-N", "-i", "NONE", "-n", "-u", "NONE", "--cmd", "set backupskip=", str(texts.all)]
    terminal = Terminal(words, 100, 30)
    terminal.read_until(lambda shown: "params.parm" in shown.raw)
    time.sleep(1)
    terminal.type(f":%s/^{texts.real},.*/{texts.real},0.75/\r:w\r")
    terminal.read_until(lambda shown: "written" in shown.raw or "WARNING" in shown.raw)
    terminal.type(":q\r")
    assert terminal.finish() == 0
    assert "WARNING" not in terminal.raw
    assert texts.told(texts.real) == 0.75


def test_vim_hears_of_a_bad_line(texts: Texts) -> None:
    texts.shell(f"{BACKUP} -c '1s/.*/rubbish/' -c wq params.parm", code=1)
    assert "params.parm:1: 'rubbish' is not NAME,VALUE" in texts.errors()


def test_nano(texts: Texts) -> None:
    line, name = texts.line(texts.whole), texts.whole
    before = texts.told(name)
    texts.shell(f"{NANO} params.parm {line},{len(name) + 2} 1")
    assert texts.told(name) == float(f"1{before:.0f}")


def test_cp_and_redirections(texts: Texts, tmp_path: Path) -> None:
    saved = tmp_path / "saved.params"
    texts.shell(f"cp params.params {saved}; echo '{texts.real},7' > params.parm")
    assert texts.told(texts.real) == 7
    texts.shell(f"echo '{texts.whole} 21 # why' >> changed.parm")
    assert texts.told(texts.whole) == 21
    texts.shell(f"cp {saved} params.parm")
    assert texts.told(texts.real) == pytest.approx(0.135 if texts.real.startswith("ATC") else 0.15)
    assert texts.told(texts.whole) != 21


def test_rsync_in_place_works_and_else_is_refused(texts: Texts, tmp_path: Path) -> None:
    wanted = tmp_path / "params.parm"
    wanted.write_text(f"{texts.whole},44\n")
    said = texts.shell(f"rsync -I {wanted} params.parm", code=None)
    assert "Read-only file system" in said
    texts.shell(f"rsync -I --inplace {wanted} params.parm")
    assert texts.told(texts.whole) == 44


def test_a_listing_tells_sizes_that_are_right(texts: Texts) -> None:
    listed = texts.shell("ls -l").splitlines()[1:]
    assert len(listed) == 5
    texts.shell('wc -c params.parm | grep -q "$(stat -c %s params.parm)"')
    texts.shell("grep -c , params.parm params.params changed.parm")
