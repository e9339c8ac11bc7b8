"""support.privileges: a test that needs root passes as root, or the run names it and the reason."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]

CONFTEST = """
import os
os.geteuid = lambda: 0 if "AS_ROOT" in os.environ else 1000
pytest_plugins = ("tests.support.privileges",)
def pytest_configure(config):
    config.addinivalue_line("markers", "needs(*privileges): what it needs")
"""
TESTS = """
import os
import pytest
@pytest.mark.needs("root")
@pytest.mark.parametrize("wanted", ["0", "1"])
def test_of_root(wanted):
    assert os.environ.get("AS_ROOT") == "1" == wanted
def test_of_everybody():
    assert "AS_ROOT" not in os.environ
"""
GRANTS = '#!/bin/sh\n[ "$1" = -n ] || exit 9\nshift\nAS_ROOT=1 exec "$@"\n'
REFUSES = "#!/bin/sh\necho 'sudo: a password is required' >&2\nexit 1\n"


def run(place: Path, sudo: str) -> list[str]:
    """Run the tests as an ordinary user with such a sudo; return the lines of the run."""
    for name, text in (("conftest.py", CONFTEST), ("test_it.py", TESTS), ("sudo", sudo)):
        (place / name).write_text(text)
    (place / "sudo").chmod(0o755)
    environment = {**os.environ, "PATH": f"{place}:/usr/bin:/bin", "PYTHONPATH": str(PROJECT)}
    environment.pop("PYTEST_ADDOPTS", None)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", "/dev/null"]
    done = subprocess.run(
        [*command, "--rootdir", place, place / "test_it.py"],
        cwd=place,
        env=environment,
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
    )
    return (done.stdout + done.stderr).splitlines()


def test_sudo_runs_a_test_of_root_and_its_failure_is_the_tests_failure(tmp_path: Path) -> None:
    lines = run(tmp_path, GRANTS)
    assert "1 failed, 2 passed" in lines[-1], lines
    assert any(line.startswith("FAILED test_it.py::test_of_root[0]") for line in lines), lines
    assert any("assert '1' == '0'" in line for line in lines), "what it said as root"


def test_what_sudo_refuses_is_named_in_the_last_lines(tmp_path: Path) -> None:
    lines = run(tmp_path, REFUSES)
    assert lines[-4:-1] == [
        "not run without root (sudo: a password is required): 2 tests",
        "  test_it.py::test_of_root[0]",
        "  test_it.py::test_of_root[1]",
    ]
    assert "1 passed, 2 skipped" in lines[-1]
