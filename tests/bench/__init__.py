"""Measurements, not tests: run by scripts/bench."""
