"""BLAS keeps to one thread where kjax fits, whatever else the machine does."""

import os
import subprocess
import sys

import pytest
from threadpoolctl import threadpool_info

from kjax.threads import one_blas_thread

# A process of its own: these tests run with one BLAS thread as it is.
FIT = """
import jax, numpy as np
from threadpoolctl import threadpool_info
from kjax import RunConfig, resolve
from kjax.controllers import resolve_fits as module

seen = []
def watched(*args, **options):
    out = jax.block_until_ready(fit(*args, **options))
    seen.extend(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
    return out
fit, module._fit_modes = module._fit_modes, watched
before = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
resolve(RunConfig())
after = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
print(max(before), max(seen), min(after))
"""


def blas_threads():
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


def test_a_context_limits_every_blas_and_gives_back_what_was():
    before = blas_threads()
    assert len(before) >= 2, "NumPy's and SciPy's"
    with one_blas_thread():
        assert set(blas_threads()) == {1}
    assert blas_threads() == before


@pytest.mark.slow
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one core, so one thread as it is")
def test_resolve_fits_with_one_blas_thread_and_gives_the_others_back():
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    out = subprocess.run(
        [sys.executable, "-c", FIT], env=environment, capture_output=True, text=True, check=True
    )
    before, during, after = map(int, out.stdout.split())
    assert (during, after) == (1, before)
    assert before > 1
