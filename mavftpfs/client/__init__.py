"""A vehicle's files for programs: options, connecting, mounts, get and put. Prints nothing."""
