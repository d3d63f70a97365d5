"""Measurements of this package; run them as ``python -m benchmarks.speed``."""
