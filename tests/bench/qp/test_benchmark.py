"""What the QP benchmark reports: points against minimisers, ratios, absent peers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import qp
from kjax.bench.qp import benchmark, report


@pytest.fixture(scope="module")
def log(random_qp):
    """Ticks of two modes, as of ``record_box``."""
    problems = [random_qp(seed)[:4] for seed in range(2)]
    H, q, lower, upper = (np.stack(part) for part in zip(*problems, strict=True))
    mode = np.array([0, 1, 0, 1, 1, 0])
    scale = 1.0 + 0.1 * np.arange(len(mode))[:, None]
    return {
        "prepared": jax.vmap(qp.prepare)(jnp.asarray(H)),
        "mode": mode,
        "H": H,
        "q": q[mode] * scale,
        "lower": lower[mode],
        "upper": upper[mode],
    }


def test_single_calls_find_the_minimisers_that_daqp_finds(log):
    found = benchmark.box_single(log, {}, count=6)
    assert set(found) == {"kjax tableau, warm", "empty jitted call"}
    ours = found["kjax tableau, warm"]
    assert ours["us_median"] > 0.0
    # daqp stops at 1e-12; the variables are of order one.
    assert ours["force_error_max_N"] < 1e-9
    assert ours["kkt_residual_max"] < 1e-9
    assert "force_error_max_N" not in found["empty jitted call"]


def test_a_solver_that_is_wrong_shows_its_error(log, monkeypatch):
    def peers(present):
        return {"clipped": lambda H: lambda q, lower, upper: np.clip(-q, lower, upper)}

    monkeypatch.setattr(benchmark, "box_peers", peers)
    found = benchmark.box_single(log, {}, count=6)
    assert found["clipped"]["force_error_max_N"] > 0.01
    assert found["clipped"]["kkt_residual_max"] > 1e-3


def test_a_scan_and_batches_are_timed_per_problem(log):
    found = benchmark.box_in_scan(log)
    assert set(found) == {"kjax in a scan, value", "kjax in a scan, value and gradient"}
    batches = benchmark.box_batch(log, {"daqp": None}, (2, 4))
    assert list(batches) == ["2", "4"]
    for entry in (*found.values(), *batches.values()):
        assert all(value > 0.0 for value in entry.values())
    assert set(batches["2"]) == {"kjax", "daqp loop"}


def measured(**box):
    gait = {name: {"us_median": us} for name, us in box.items()}
    return {
        "box": {"trot_velocity": gait, "bound_velocity": gait},
        "batch": {g: {"1024": {"kjax": 2.0, "daqp loop": 6.0}} for g in benchmark.GAITS},
        "rows": {
            "kjax active_set": {"us_median": 300.0, "apart_from_active_set_max_N": 0.0},
            "PIQP": {"us_median": 100.0, "apart_from_active_set_max_N": 1e-6},
        },
        "gradient": {g: {"median": 1e-10, "max": 1e-8, "problems": 9} for g in benchmark.GAITS},
        "random": {"solves": 100, "wrong_solved": 0, "iteration_limit": 1, "other_status": 0},
        "size": {},
    }


def test_ratios_are_of_medians_and_none_where_a_peer_is_absent():
    ours = {"kjax tableau, warm": 10.0, "kjax in a scan, value": 2.0,
            "kjax in a scan, value and gradient": 5.0}  # fmt: skip
    found = benchmark.summary(measured(**ours, **{"daqp, cold": 20.0, "qpax": 300.0}))
    assert found["single_over_daqp_cold"] == 0.5
    assert found["qpax_over_single"] == 30.0
    assert found["grad_over_value"] == 2.5
    assert found["batch1024_over_daqp"] == 3.0
    assert found["rows_over_best_of_piqp_proxqp"] == 3.0
    assert found["scan_over_daqp_warm"] is found["osqp_over_single"] is None
    assert found["mpc_qpbenchmark_solved_1e9"] is None


def test_the_table_says_what_was_measured():
    text = report.table(measured(**{"kjax tableau, warm": 10.0}))
    assert "| kjax tableau, warm | 10.0 | 10.0 | 0.0e+00 |" in text
    assert "| trot_velocity, daqp loop, us per problem | 6.0 |" in text
    assert "| PIQP | 100 | 1.0e-06 |" in text
    assert "100 random solves, warm-started: 0 wrong, 1 at the iteration limit" in text
    assert "Public problems" not in text
