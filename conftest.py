"""The suite: its processes, and those that it starts, share the machine's cores."""

import os

# Before torch is imported. Threads of several processes on the same cores wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
