"""The kernel mount: inodes, handles, pyfuse3 operations, and the life of the process that serves them."""
