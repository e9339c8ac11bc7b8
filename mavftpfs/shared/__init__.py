"""Values and helpers every layer may use; pure (no clock, no I/O, no trio)."""
