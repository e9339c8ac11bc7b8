"""The entry point of `mavftpfs`, and of `python -m mavftpfs`."""

from __future__ import annotations

import sys


def main() -> int:
    """Run a command; return the exit code. Ctrl-C ends it without a traceback, even while modules load."""
    try:
        from mavftpfs.cli import main as command_line

        return command_line.main()
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
