"""What the QP benchmark counts: its judges judge, and they find the solvers right."""

from argparse import Namespace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import qp
from kjax.bench.qp import checks, random_rows

PUBLIC = Path(__file__).parents[4] / "shared" / "data" / "mpc_qpbenchmark"


def test_the_judge_tells_a_minimiser_from_what_is_none(random_qp):
    H, q, lower, upper, x = random_qp(0)
    assert checks.independent_residual(H, q, lower, upper, x) < 1e-14
    for wrong in (x + 1e-3 * (upper - lower) * np.eye(12)[2], x + 1e-3, np.full(12, np.nan)):
        assert not checks.independent_residual(H, q, lower, upper, wrong) <= 1e-5
    # 0.1 past an upper bound is outside, however little the gradient minds.
    outside = np.where(np.arange(12) == 1, upper + 0.1, x)
    assert checks.independent_residual(H, q, lower, upper, outside) == np.inf


def test_no_random_problem_is_called_solved_that_is_not(monkeypatch):
    monkeypatch.setattr(checks, "SIZES", (6, 20))
    monkeypatch.setattr(checks, "BATCH", 32)
    found = checks.random_solves(1)
    assert found["solves"] == 2 * 32 * checks.TICKS
    assert found["wrong_solved"] == found["other_status"] == 0
    assert found["iteration_limit"] <= 4


def test_a_solver_that_lies_is_found_out(monkeypatch):
    monkeypatch.setattr(checks, "SIZES", (6,))
    monkeypatch.setattr(checks, "BATCH", 32)

    def lie(prepared, q, lower, upper, warm, **options):
        point = jnp.clip(-q, lower, upper)
        return Namespace(warm=warm, x=point, status=jnp.asarray(qp.Status.SOLVED))

    monkeypatch.setattr(checks.qp, "solve", lie)
    assert checks.random_solves(1)["wrong_solved"] > 0.9 * 32 * checks.TICKS


def test_gradients_are_those_of_differences(random_qp):
    problems = [random_qp(seed)[:4] for seed in range(4)]
    H, q, lower, upper = (np.stack(part) for part in zip(*problems, strict=True))
    log = {
        "prepared": jax.vmap(qp.prepare)(jnp.asarray(H)),
        "mode": np.arange(4),
        "q": q,
        "lower": lower,
        "upper": upper,
    }
    found = checks.gradients(log, 4)
    assert found["problems"] >= 3
    assert found["max"] < 1e-8


@pytest.mark.skipif(not PUBLIC.is_dir(), reason="the public problems are not beside the checkout")
def test_public_problems_are_solved_to_1e_9(monkeypatch):
    monkeypatch.setattr(checks, "_median_us", lambda call: 1.0)  # no speed in tests
    found = checks.public_problems(PUBLIC, {})
    assert (found["problems"], found["solved_1e9"]) == (30, 30)


def test_no_random_problem_with_rows_has_a_wrong_answer(monkeypatch):
    monkeypatch.setattr(random_rows, "BATCH", 64)
    kinds = ("known", "infeasible", "unbounded", "linear")
    methods = ("auto", "active_set", "admm")
    found = random_rows.count(1, methods=methods, shapes=((4, 6),), kinds=kinds)
    assert random_rows.wrong(found) == 0
    for kind in kinds:
        entry = found[f"auto, {kind}"]
        assert entry["problems"] == 64
        assert entry["proven"] >= 60  # it does not merely refuse


def test_linear_programs_drawn_from_a_known_point_have_the_cost_that_highs_finds():
    problems = random_rows.draw(np.random.default_rng(3), "linear", 20, 5, 8)
    for i in range(20):
        best = random_rows.linear_program_cost(tuple(part[i] for part in problems.data))
        np.testing.assert_allclose(best, problems.least[i], rtol=0, atol=1e-6 * problems.terms[i])


def test_a_lie_about_rows_is_found_out(monkeypatch):
    monkeypatch.setattr(random_rows, "BATCH", 64)

    def lie(H, q, C, row_lower, row_upper, lower, upper, **options):
        return Namespace(x=jnp.clip(-q, lower, upper), status=jnp.asarray(qp.Status.SOLVED))

    monkeypatch.setattr(random_rows.qp, "solve_rows", lie)
    found = random_rows.count(1, methods=("auto",), shapes=((4, 6),), kinds=("known", "infeasible"))
    assert random_rows.wrong(found) > 0.9 * 128
