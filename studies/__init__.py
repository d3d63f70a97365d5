"""The tables and pages of this repository's results.

Not installed with the package; run from a clone: ``python -m studies``.
"""
