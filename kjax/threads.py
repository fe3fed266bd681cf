"""Threads of BLAS, which jaxlib's LAPACK calls: one is enough, and on a busy machine far faster.

OpenBLAS takes a thread per core and waits for all of them by spinning. Where another program keeps
a core busy, a QR factorisation of 5 x 10,000 x 34 entries takes 1.2 s then, and 26 ms with one
thread.
"""

import scipy.linalg  # noqa: F401, so that its BLAS is loaded: only loaded ones can be limited
from threadpoolctl import threadpool_limits


def one_blas_thread() -> threadpool_limits:
    """Limit BLAS to one thread, from now on or, as a context, until its end."""
    return threadpool_limits(1, user_api="blas")
