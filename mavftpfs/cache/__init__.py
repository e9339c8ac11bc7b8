"""What is remembered of the vehicle: entries, blocks, open files."""
