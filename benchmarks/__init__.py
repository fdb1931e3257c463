"""Measurements for developers, not in the wheel: speed and accuracy (`python -m benchmarks --help`), and whether two
versions give bit-identical results (`python -m benchmarks.results --help`)."""
