"""Fifty threads write a file each, all at once, in the working directory; prints the errors."""

from __future__ import annotations

import os
import threading

errors: list[OSError] = []


def write(number: int) -> None:
    """Write a file in a few parts."""
    try:
        with open(f"crowd/{number}", "wb") as file:
            for part in range(4):
                file.write(bytes([number]) * (number * 37 + part))
                file.flush()
    except OSError as error:
        errors.append(error)


def main() -> None:
    """Run them."""
    os.mkdir("crowd")
    threads = [threading.Thread(target=write, args=(number,)) for number in range(50)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print(errors)


if __name__ == "__main__":
    main()
