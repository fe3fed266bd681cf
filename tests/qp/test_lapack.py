"""Cholesky and triangular inverse: values, derivatives, batches, and two programs at once."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.qp import lapack

N = 6
TWO_AT_ONCE = """
import threading
import jax, jax.numpy as jnp, numpy as np
from kjax import qp
rng = np.random.default_rng(0)
n, m = 72, 100
A = rng.normal(size=(4, n, n))
H = jnp.asarray(A @ A.transpose(0, 2, 1) + n * np.eye(n))
C, q = jnp.asarray(rng.normal(size=(m, n))), jnp.asarray(rng.normal(size=(4, n)))
far, free = jnp.full(m, 1e3), jnp.full(n, jnp.inf)
solve = jax.jit(jax.vmap(lambda H, q: qp.solve_rows(H, q, C, -far, far, -free, free).x))
wanted = np.asarray(solve(H, q))
def work():
    for _ in range(100):
        np.testing.assert_allclose(np.asarray(solve(H, q)), wanted, atol=1e-6)
threads = [threading.Thread(target=work) for _ in range(2)]
[one.start() for one in threads]
[one.join() for one in threads]
print("both ended")
"""


def definite(seed, batch=()):
    A = np.random.default_rng(seed).normal(size=(*batch, N, N))
    return jnp.asarray(A @ np.swapaxes(A, -1, -2) + np.eye(N))


def test_factor_inverse_and_solution_are_numpys():
    A, b = definite(0), jnp.arange(float(N))
    L = lapack.cholesky(A)
    np.testing.assert_allclose(L, np.linalg.cholesky(A), atol=1e-12)
    np.testing.assert_allclose(lapack.inverse_of_lower(L), np.linalg.inv(L), atol=1e-12)
    np.testing.assert_allclose(lapack.cholesky_solve(L, b), np.linalg.solve(A, b), atol=1e-12)
    assert not np.isfinite(lapack.cholesky(-A)).all()


def test_a_batch_equals_one_after_the_other():
    A, b = definite(1, (3,)), jnp.asarray(np.random.default_rng(2).normal(size=(3, N)))
    L = jax.jit(jax.vmap(lapack.cholesky))(A)
    np.testing.assert_allclose(L, np.linalg.cholesky(A), atol=1e-12)
    for which in ((0, None), (None, 0), (0, 0)):
        one, other = (x if axis == 0 else x[0] for x, axis in zip((L, b), which, strict=True))
        together = jax.jit(jax.vmap(lapack.cholesky_solve, which))(one, other)
        for i, found in enumerate(together):
            matrix = A[i if which[0] == 0 else 0]
            right = b[i if which[1] == 0 else 0]
            np.testing.assert_allclose(found, np.linalg.solve(matrix, right), atol=1e-11)


def test_derivatives_are_those_of_differences_in_both_modes():
    A, direction = definite(3), definite(4)
    weight = jnp.asarray(np.random.default_rng(5).normal(size=(N, N)))

    def value(t):
        return (weight * lapack.inverse_of_lower(lapack.cholesky(A + t * direction))).sum()

    wanted = (value(1e-6) - value(-1e-6)) / 2e-6
    assert float(jax.grad(value)(0.0)) == pytest.approx(float(wanted), rel=1e-7)
    assert float(jax.jacfwd(value)(0.0)) == pytest.approx(float(wanted), rel=1e-7)
    batch = jax.vmap(jax.grad(lambda t: value(t)))(jnp.array([0.0, 0.1]))
    assert float(batch[0]) == pytest.approx(float(wanted), rel=1e-7)


def test_two_programs_of_batches_at_once_both_end():
    done = subprocess.run(
        [sys.executable, "-c", TWO_AT_ONCE], capture_output=True, text=True, timeout=120
    )
    assert "both ended" in done.stdout, done.stderr
