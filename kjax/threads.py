"""Cores of this process, and threads of BLAS, which jaxlib's LAPACK calls.

One thread is enough, and on a busy machine far faster. OpenBLAS takes one per core and waits for
all of them by spinning: where another program keeps a core busy, a QR factorisation of 5 x 10,000 x
34 entries takes 1.2 s then, and 26 ms with one thread.
"""

import os

import scipy.linalg  # noqa: F401, so that its BLAS is loaded: only loaded ones can be limited
from threadpoolctl import threadpool_limits


def one_blas_thread() -> threadpool_limits:
    """Limit BLAS to one thread, from now on or, as a context, until its end."""
    return threadpool_limits(1, user_api="blas")


def usable_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
