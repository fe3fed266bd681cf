"""What the EDMD benchmark compares is the same thing on both sides, and it counts it right."""

import shutil
import sys
from argparse import Namespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.bench.edmd import benchmark, peers, report, stream
from kjax.bench.edmd import data as drawing
from kjax.dynamics import srb_planar
from kjax.koopman import edmd, observables


@pytest.fixture(scope="module")
def small():
    """The benchmark's setting with 14 rollouts of 50 steps: 700 snapshots, no multiple of 500."""
    return drawing.setting()._replace(rollouts=14, steps=50)


@pytest.fixture(scope="module")
def data(small):
    """Three data sets of the small setting."""
    draw = drawing.sampler(small, small.rollouts, small.steps)
    return jax.lax.map(draw, jax.random.split(jax.random.key(0), 3))


class LeastSquares:
    """A peer in NumPy that does what is asked of pykoopman and pykoop."""

    def __init__(self, module):
        self.lift = module.lift

    def pack(self, states, inputs):
        flat = (states[:, :-1], states[:, 1:], inputs)
        return tuple(a.reshape(-1, a.shape[-1]) for a in flat)

    def fit(self, data, order, constant):
        now, then, inputs = data
        lifted = (self.lift(a, order, constant) for a in (now, then))
        return self.fit_lifted(*lifted, inputs), order, constant

    def fit_lifted(self, now, then, inputs):
        return np.linalg.lstsq(np.hstack([now, inputs]), then, rcond=None)[0]

    def predict(self, model, starts, inputs):
        K, order, constant = model
        z = self.lift(starts, order, constant)
        for u in inputs.transpose(1, 0, 2):
            z = np.hstack([z, u]) @ K
        return z[:, :6]


def test_rollouts_in_numpy_are_those_of_kjax(small):
    rng = np.random.default_rng(0)
    x0, inputs = drawing.numpy_draw(rng, small, 5)
    alpha = np.array([2.0, 1.0])  # no symmetry that hides a swap of the ends
    roll = jax.vmap(lambda x, u: srb_planar.rollout(small.body, jnp.asarray(alpha), x, u, small.dt))
    wanted = np.asarray(jax.jit(roll)(x0, inputs))
    body = jax.tree.map(np.asarray, small.body)
    for rival in (drawing.numpy_rollouts, drawing.numpy_loop):
        found = rival(body, alpha, x0, inputs, small.dt)
        # 50 steps that round states of up to 3 (m, rad, m/s, rad/s) differently.
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)


def test_numpy_draws_from_the_ranges_of_kjax(small):
    x0, inputs = drawing.numpy_draw(np.random.default_rng(0), small, 200)
    ranges = small.ranges
    spread = (x0 - ranges.state_centre) / ranges.state_half
    part = (inputs - ranges.input_low) / (ranges.input_high - ranges.input_low)
    assert inputs.shape == (200, small.steps, 4)
    assert 0.95 < np.abs(spread).max() <= 1.0
    assert 0.0 <= part.min() < 0.01 < 0.99 < part.max() <= 1.0


def test_a_hundred_fits_in_one_call_are_single_fits_in_their_dictionaries(data):
    models, reports = benchmark.many(data)
    use = benchmark.cuts()
    assert models.A.shape[:2] == (3, len(benchmark.DICTIONARIES)) == (3, 10)
    for i, j in ((2, 4), (1, 9)):
        order, constant = benchmark.DICTIONARIES[j]
        dictionary = observables.paper(order, constant_rotation=constant)
        assert use[j].sum() == dictionary.size
        model, report = jax.jit(lambda data, d=dictionary: edmd.fit(d, data))(
            jax.tree.map(lambda leaf: leaf[i], data)
        )
        assert reports.rank[i, j] == report.rank
        # Rounding times the condition of the columns, about 1e3, and their lengths, up to 1e2.
        np.testing.assert_allclose(models.A[i, j][np.ix_(use[j], use[j])], model.A, atol=1e-10)
        np.testing.assert_allclose(models.B[i, j][use[j]], model.B, atol=1e-10)


def test_a_stream_ends_in_the_coefficients_of_one_factorisation(data):
    factor, sets = stream.empty_factor(), []
    for i in range(3):
        sets.append(jax.tree.map(lambda leaf: leaf[i], data))
        factor = stream.push(factor, sets[-1])
    assert factor.rows == 3 * 700  # the rest of 200 behind each block of 500 is in it
    # Rounding of some hundred rows times the condition of the columns.
    assert stream.difference_from_one_shot(factor, sets) < 1e-10
    assert stream.difference_from_one_shot(factor, sets[:2]) > 1e-6


def test_the_stream_counts_its_snapshots(small):
    found = stream.stream(small, 2100)
    assert found["snapshots"] == 2100
    assert found["snapshots_per_s"] > found["snapshots_per_s_with_drawing"] > 0.0
    assert found["all_rows_MB"] == pytest.approx(2100 * (15 + 4 + 15) * 8 / 1e6)
    assert found["coefficients_difference"] < 1e-10


@pytest.mark.parametrize(("order", "constant"), [(4, False), (4, True), (2, True), (0, False)])
def test_peers_lift_to_the_same_observables(order, constant):
    x = np.random.default_rng(0).normal(size=(7, 6))
    dictionary = observables.paper(order, constant_rotation=constant)
    wanted = np.asarray(jax.vmap(dictionary.lift)(x))
    wanted = np.hstack([wanted[:, 1:7], wanted[:, :1], wanted[:, 7:]])  # theirs: the states first
    found = peers.lift(x, order, constant)
    np.testing.assert_allclose(found, wanted, rtol=1e-14)
    np.testing.assert_array_equal(found, peers.lift(x, 4, True)[:, peers.columns(order, constant)])
    own = [function(*x.T) for function in peers._functions(order, constant)]
    np.testing.assert_allclose(np.column_stack([x, *own]), wanted, rtol=1e-14)


def test_a_peer_that_solves_the_same_problem_predicts_the_same(small, monkeypatch):
    def round_of_peers(python, path):
        with np.load(path) as read:
            return peers.measure({"pykoopman": LeastSquares(peers)}, dict(read))

    monkeypatch.setattr(benchmark, "_peers", round_of_peers)
    monkeypatch.setattr(benchmark, "ROUNDS", 2)
    monkeypatch.setattr(benchmark, "SEEDS", 3)
    found = benchmark.fits(small, "python", {"pykoopman": "0"}, 2)
    for key in benchmark.KEYS:
        assert set(found[key]) == {"kjax", "pykoopman"}
        assert all(value > 0.0 for value in found[key].values())
    assert found["many_timed"] == {"pykoopman": 30}
    ours, theirs = (found["error"][name]["max"] for name in ("kjax", "pykoopman"))
    # Both are exact least squares: apart by rounding, while the errors are centimetres per second.
    np.testing.assert_allclose(theirs, ours, rtol=1e-7, atol=1e-9)
    assert 1e-3 < ours[0] < 0.5


def test_peers_that_are_too_slow_are_timed_in_part(monkeypatch):
    monkeypatch.setattr(peers, "LIMIT", 1e-9)
    called = []
    spent, done = peers._loop(lambda *place: called.append(place), [(0, "a"), (0, "b")])
    assert done == len(called) == 1
    assert spent > 0.0


def test_figures_are_none_where_the_peer_is_absent(tmp_path):
    fits = {key: {"kjax": 2.0} for key in benchmark.KEYS}
    fits |= {"error": {"kjax": {"max": [0.1, 0.2, 0.3]}}, "many_timed": {}}
    rates = {"kjax": 200.0, "numpy_vectorised": 100.0, "numpy_loop": 2.0}
    stream = {"snapshots": 10, **dict.fromkeys((
        "snapshots_per_s", "snapshots_per_s_with_drawing", "peak_MB", "growth_MB", "all_rows_MB",
        "coefficients_difference"), 1.0)}  # fmt: skip
    result = {"fits": fits, "rollouts": rates, "stream": stream, "peers": {},
              "missing": ["pykoopman", "pykoop"]}  # fmt: skip
    found = benchmark.summary(result)
    assert found["rollouts_speedup"] == 100.0
    assert found["rollouts_over_vectorised_numpy"] == 2.0
    assert found["fit_over_pykoopman"] is found["fit_over_pykoop"] is None
    assert found["fits100_speedup"] is found["fits100_speedup_lifted_once"] is None
    assert "Not measured: pykoopman, pykoop." in report.table(result)
    for key in benchmark.KEYS:
        fits[key] |= {"pykoopman": 8.0, "pykoop": 6.0}
    found = benchmark.summary(result)
    assert (found["fit_over_pykoopman"], found["fits100_speedup"]) == (0.25, 3.0)
    report.figure(result, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


@pytest.mark.parametrize("wrong", ["/nowhere/python", "true", sys.executable])
def test_a_wrong_interpreter_is_one_line_and_exit_code_2(wrong, tmp_path, capsys, monkeypatch):
    def no_further():
        raise AssertionError("it went on")

    monkeypatch.setattr(benchmark, "_one_thread", no_further)
    if wrong == "true" and shutil.which("true") is None:
        pytest.skip("there is no program that says nothing")
    with pytest.raises(SystemExit) as stop:
        benchmark.run(tmp_path, Namespace(peers=wrong, quick=True))
    assert stop.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith(f"error: --peers {wrong}: ")
    assert err.count("\n") == 1
