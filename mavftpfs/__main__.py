"""`python -m mavftpfs`."""

from __future__ import annotations

import sys

from mavftpfs.cli import main

if __name__ == "__main__":
    sys.exit(main())
