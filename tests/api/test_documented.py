"""The examples of docs/library.md, one after the other, as a program of its own."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from tests.mount.conftest import Field
from tests.support.trees import content

PAGE = Path(__file__).parents[2] / "docs" / "library.md"
SOURCE = "udpin:0.0.0.0:14550"


def test_the_examples_run(field: Field, tmp_path: Path) -> None:
    examples = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert len(examples) >= 7
    card = field.local("card")
    (card / "fs/microsd/log/2026-05-01").mkdir(parents=True)
    (card / "fs/microsd/etc").mkdir()
    (card / "fs/microsd/log/2026-05-01/10_00_00.ulg").write_bytes(b"ULog\x01\x12\x35" + content("log", 5_000))
    (card / "fs/microsd/etc/flights.csv").write_text("flight,seconds\n1,300\n2,420\n")
    program = "\n".join(examples)
    assert SOURCE in program
    program = program.replace(SOURCE, field.sim(card).source)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=tmp_path,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "120" in done.stdout
    assert "nothing.txt' does not exist" in done.stdout
    assert (card / "fs/microsd/etc/extras.txt").read_text() == "mavlink start\n"
    assert [path.stat().st_size for path in (tmp_path / "logs").rglob("*.ulg")] == [5_007]
