# SPDX-License-Identifier: Apache-2.0
"""Keep freed memory in the process, where the next temporary array finds it."""

import numpy as np

LARGE = 3_900_000
"""Length of an array of float64 that takes 31 MB, just below the 32 MB up to which glibc adapts its
limits.
"""


def keep_freed_memory() -> None:
    """Let the C library keep up to 64 MB of freed memory.

    glibc returns memory that is freed at the end of its heap to the system if it is more than twice
    the largest array freed so far. The next arrays then cost a page fault for every 4 kB, up to
    half of the time of an engine whose temporary arrays are that large. One large array, which
    is never touched, raises the limit for the rest of the process; it takes microseconds. Other C
    libraries ignore it.
    """
    np.empty(LARGE)
