"""The parts of `tests/sim/test_matrix.py`: what programs do, what happens meanwhile, and who judges."""
