"""The kernel's side: inodes, handles, options, pyfuse3 operations."""
