"""Programs are killed while the kernel has requests of theirs that the mount has not read yet.

It takes those back. A read that waits for them stopped the whole mount, link and all, until somebody asked
for something else: in one of ten rounds of this. What is done about it, at that very moment:
tests/unit/test_kernel.py.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import Mount
from tests.support.vehicles import PROJECT

pytestmark = pytest.mark.holds("promise 4")

ROUNDS = 8
ASKER = PROJECT / "tests/support/programs/asker.py"


def kill_in_mid_question(mount: Mount) -> None:
    """Let two programs ask for many names, and kill them."""
    with ExitStack() as stack:
        children = [
            stack.enter_context(mount.started(sys.executable, ASKER, cwd=mount.path)) for _ in range(2)
        ]
        for child in children:
            assert child.stdout is not None
            assert child.stdout.readline() == "asking\n"
        for child in children:
            child.kill()
        mount.status()  # asked by its socket, not by the kernel
        for child in children:
            child.wait(20)


def test_killed_programs_do_not_stop_the_mount(field: Field) -> None:
    mount = field.mount(field.sim(field.local("card"), "px4").source)
    for _ in range(ROUNDS):
        kill_in_mid_question(mount)
    assert mount.status()["kernel"]["open_files"] == 0
