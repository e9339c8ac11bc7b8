"""The program that asks: threads of one process are one, and a number that is used again is another."""

from __future__ import annotations

import os
import subprocess
import threading

from mavftpfs.mount.programs import Process, program_of


def test_threads_of_a_process_are_one_program() -> None:
    found: list[Process | None] = []
    thread = threading.Thread(target=lambda: found.append(program_of(threading.get_native_id())))
    thread.start()
    thread.join()
    assert found == [program_of(os.getpid())]
    assert found[0] is not None
    assert found[0].number == os.getpid()


def test_another_process_is_another_program_and_an_ended_one_is_none() -> None:
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE) as child:
        assert program_of(child.pid) not in (None, program_of(os.getpid()))
        running = program_of(child.pid)
        assert running is not None
        assert not running.ended()
    assert running.ended()
    assert program_of(child.pid) is None
    assert program_of(0) is None
