"""The suite: its processes, and those that it starts, share the machine's cores."""

import os
from importlib.util import find_spec

# Before torch is imported. Threads of several processes on the same cores wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Its doctests import the extra that it is for.
collect_ignore = [] if find_spec("rsl_rl") else ["torchrl_l2c2/rsl_rl"]
