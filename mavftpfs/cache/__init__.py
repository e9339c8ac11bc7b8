"""The memory of the vehicle: entries, blocks, open files."""
