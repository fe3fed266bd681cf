"""The QPs that are recorded are those that the controller solves."""

import jax
import numpy as np
import pytest

from kjax import qp
from kjax.bench.qp import checks, problems

pytestmark = pytest.mark.slow


def test_box_problems_are_those_of_every_tick_of_a_closed_loop():
    log = problems.record_box("trot_velocity", 0.03)
    count = len(log["q"])
    assert count == 6  # ticks of 5 ms
    assert log["q"].shape == log["lower"].shape == log["upper"].shape == (count, 24)
    assert (log["lower"] <= log["upper"]).all()
    np.testing.assert_array_equal(log["mode"], log["mode"][0])  # one stance of the trot
    # H is that of the problem as the solver has it prepared: the minimiser has no residual.
    mode = int(log["mode"][0])
    prepared = jax.tree.map(lambda a: a[mode], log["prepared"])
    for q, lower, upper in zip(log["q"], log["lower"], log["upper"], strict=True):
        solution = jax.jit(qp.solve)(prepared, *map(jax.numpy.asarray, (q, lower, upper)))
        assert int(solution.status) == qp.Status.SOLVED
        x = np.asarray(solution.x)
        assert checks.independent_residual(log["H"][mode], q, lower, upper, x) < 1e-8
    assert np.abs(np.diff(log["q"], axis=0)).max() > 0.0  # another state, another q


def test_problems_with_rows_are_those_of_the_bound_through_flight():
    found = problems.record_rows(0.03)
    assert len(found) == 6
    for H, q, C, low, high, lower, upper in found:
        n, m = len(q), len(C)
        assert H.shape == (n, n)
        assert C.shape == (m, n)
        assert low.shape == high.shape == (m,)
        assert (low <= high).all()
        assert (lower <= upper).all()
        assert np.isfinite(H).all()
        assert np.linalg.eigvalsh(H).min() > -1e-9 * np.abs(H).max()
