"""Run a command of mavftpfs as the user nobody: as_nobody.py WORDS...

Root starts this program, which loads all modules before it becomes nobody, because nobody may not read
Python or this checkout if they lie in a home that only root may enter.
"""

from __future__ import annotations

import encodings.idna  # noqa: F401
import importlib
import os
import pkgutil
import sys
from pathlib import Path

NOBODY = 65534

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import mavftpfs  # noqa: E402
from mavftpfs.__main__ import main  # noqa: E402

for module in pkgutil.walk_packages(mavftpfs.__path__, "mavftpfs."):
    importlib.import_module(module.name)
os.setgroups([])
os.setresgid(NOBODY, NOBODY, NOBODY)
os.setresuid(NOBODY, NOBODY, NOBODY)
sys.exit(main())
