"""Tests. Matrix products take one thread, as in the program: processes of tests share the
processors, and threads of theirs would wait for one another.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is loaded
