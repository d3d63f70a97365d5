"""Finished runs: tables, curves, diagnosis, export and video."""
