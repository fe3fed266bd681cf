"""Learned lifting, parameters on disk, dictionaries as data, and what a fit says to bad data."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.config import SrbConfig
from kjax.controllers.rigid_body import own_body
from kjax.koopman import edmd, observables
from kjax.koopman.dataset import Snapshots
from kjax.koopman.observables import custom_dictionary
from kjax.prediction import build, families, learned, storage
from kjax.prediction.kind import ModelChoice
from kjax.robots import go1
from kjax.types import Mode

DT = 1e-3


def made_up(rollouts=30, steps=20, seed=0):
    """x+ = x + small linear part + 0.2 sin(theta) u_1 on omega: a system that needs lifting."""
    rng = np.random.default_rng(seed)
    A = np.eye(6) + 0.02 * np.random.default_rng(9).normal(size=(6, 6))
    A[:, 0] = np.eye(6)[0]
    x = rng.normal(size=(rollouts, 6)) * 0.5
    inputs = rng.normal(size=(rollouts, steps, 4))
    states = [x]
    for t in range(steps):
        x = states[-1] @ A.T
        x[:, 5] += 0.2 * np.sin(2.0 * states[-1][:, 2]) * inputs[:, t, 1]
        states.append(x)
    return Snapshots(
        jnp.asarray(np.stack(states, 1)), jnp.asarray(inputs), jnp.zeros((rollouts, 2, 2))
    )


@pytest.fixture(scope="module")
def trained():
    train = jax.jit(
        lambda key, data: learned.train(
            key, data, hidden=16, features=1, window=10, updates=600, rate=1e-2, every=50
        )
    )
    return train(jax.random.key(0), made_up(rollouts=120))


def test_training_beats_the_random_network_it_begins_with(trained):
    model, how = trained
    assert not how.diverged
    assert how.loss.shape == (600,)
    fresh = made_up(seed=5)
    unit = jnp.ones(6)
    loss = jax.jit(learned.prediction_loss)
    first = jax.jit(
        lambda data: learned.initial(
            jax.random.split(jax.random.key(0))[0], data, hidden=16, features=1, head="bilinear"
        )
    )(made_up(rollouts=120))
    assert loss(model, fresh, unit) < 0.5 * loss(first, fresh, unit)


def test_the_loss_is_the_many_step_error_of_the_family(trained):
    model, _ = trained
    data = made_up(rollouts=4, steps=6, seed=3)
    family = learned.learned(DT, 1)
    unit = np.array([1.0, 2.0, 0.5, 1.0, 3.0, 0.1])
    errors = []
    for states, inputs, feet in zip(*data, strict=True):
        start = families.Start(states[0], feet)
        predicted = families.rollout(family, model, start, inputs)
        errors.append(np.asarray(predicted[1:] - states[1:]) / unit)
    wanted = np.mean(np.square(errors))
    got = jax.jit(learned.prediction_loss)(model, data, jnp.asarray(unit))
    np.testing.assert_allclose(got, wanted, rtol=1e-12)


def test_a_linear_head_holds_no_products():
    train = jax.jit(
        lambda key, data: learned.train(
            key, data, head="linear", hidden=4, features=2, window=5, updates=4, every=2
        )
    )
    model, _ = train(jax.random.key(1), made_up(rollouts=10))
    np.testing.assert_array_equal(model.head.B[1:], 0.0)
    assert np.abs(model.head.B[0]).max() > 0


def test_it_does_not_see_where_the_robot_is(trained):
    model, _ = trained
    x = jnp.asarray([0.0, 0.2, 0.1, 0.3, -0.2, 0.5])
    here, there = learned.lift(model, x), learned.lift(model, x.at[0].add(7.0))
    np.testing.assert_array_equal(here[2:], there[2:])


def test_a_window_longer_than_the_rollouts_is_refused():
    with pytest.raises(ValueError, match="window must be at most the rollouts' 20 steps, got 21"):
        learned.train(jax.random.key(0), made_up(), window=21)


# ---------------------------------------------------------------- on disk


def stacked(model):
    return jax.tree.map(lambda a: np.stack([np.asarray(a)] * len(Mode)), model)


def test_a_learned_model_comes_back_from_disk(trained, tmp_path):
    model = stacked(trained[0])
    spread = np.full((len(Mode), 6), 1e-3)
    path = tmp_path / "model.npz"
    storage.save(path, storage.Stored("learned", 1e-3, model, spread))
    back = storage.load(path, "learned")
    jax.tree.map(np.testing.assert_array_equal, back.params, model)
    choice = ModelChoice(model="learned", file=str(path))
    assert build.build_family(build.model_spec(choice)).size == 8
    body = edmd.srb_params(own_body(SrbConfig(), go1.PARAMS))
    built = build.build_prediction(
        body, choice, jax.random.key(0), modes=tuple(Mode), heights=(0.27,) * len(Mode)
    )
    np.testing.assert_array_equal(built.spread, spread)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"family": "residual"}, "holds residual, wanted a learned model"),
        ({"A": None}, "lacks 'A'"),
        ({"centre": np.full((len(Mode), 6), np.nan)}, "centre holds values that are not finite"),
        ({"dt": 0.005}, "steps of 0.005 s, dataset.dt is 0.001 s"),
        ({"spread": np.zeros((3, 6))}, f"holds 3 contact modes, wanted {len(Mode)}"),
    ],
)
def test_a_file_that_is_no_such_model_is_refused(trained, tmp_path, change, message):
    path = tmp_path / "model.npz"
    storage.save(
        path, storage.Stored("learned", 1e-3, stacked(trained[0]), np.zeros((len(Mode), 6)))
    )
    arrays = {**np.load(path), **change}
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    with pytest.raises(ValueError, match=message):
        build.model_spec(ModelChoice(model="learned", file=str(path)))


def test_a_file_that_is_not_there_or_no_file_at_all(tmp_path):
    with pytest.raises(ValueError, match=r"file: cannot read"):
        storage.load(tmp_path / "none.npz", "residual")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(ValueError, match=r"file: cannot read"):
        storage.load(tmp_path / "text.npz", "residual")
    with pytest.raises(ValueError, match="model = 'residual' needs a file"):
        build.model_spec(ModelChoice(model="residual"))
    with pytest.raises(ValueError, match="model = 'exact' takes no file"):
        build.model_spec(ModelChoice(model="exact", file="a.npz"))


def test_weights_of_unknown_features_are_refused(tmp_path):
    path = tmp_path / "residual.npz"
    W, spread = np.zeros((len(Mode), 6, 21)), np.zeros((len(Mode), 6))
    storage.save(path, storage.Stored("residual", 0.005, W, spread, "history"))
    assert storage.load(path, "residual").features == "history"
    storage.save(path, storage.Stored("residual", 0.005, W, spread, "mystery"))
    with pytest.raises(ValueError, match="features 'mystery', wanted one of affine, history"):
        storage.load(path, "residual")


# ---------------------------------------------------------------- dictionaries

X = np.array([0.1, 0.3, 0.2, 0.5, -0.4, 1.5])


def test_monomials_are_all_products_without_the_position_along():
    dictionary = observables.monomials(3)
    z = np.asarray(dictionary.lift(jnp.asarray(X)))
    assert dictionary.size == len(z) == 7 + 15 + 35
    np.testing.assert_array_equal(z[1:7], X)
    at = dictionary.names.index("theta omega")
    np.testing.assert_allclose(z[at], X[2] * X[5])
    assert dictionary.units[at] == "rad rad/s"
    at = dictionary.names.index("p_z v_x v_x")
    np.testing.assert_allclose(z[at], X[1] * X[3] ** 2)
    assert not any("p_x" in name for name in dictionary.names[7:])


def test_fourier_features_approach_the_gaussian_kernel():
    dictionary = observables.fourier(4000, scale=0.7, seed=1)
    spread = np.array(observables.FOURIER_SPREAD)
    y = X + 0.3 * spread * np.array([5.0, 1.0, -1.0, 0.5, 1.0, -0.5])
    a, b = (np.asarray(dictionary.lift(jnp.asarray(v)))[7:] for v in (X, y))
    # 2 E[cos(wx + b) cos(wy + b)] is the kernel of the distance; p_x does not count.
    distance = (0.7 * (X - y) / spread)[1:]
    wanted = np.exp(-0.5 * distance @ distance)
    assert abs(2.0 * np.mean(a * b) - wanted) < 4.0 / np.sqrt(4000)


def test_ones_own_observables_in_one_line():
    dictionary = custom_dictionary(lambda x: jnp.stack([jnp.sin(x[2]), x[5] * x[3]]))
    z = dictionary.lift(jnp.asarray(X))
    np.testing.assert_allclose(z[7:], [np.sin(0.2), 0.75])
    assert dictionary.names[7:] == ("own 0", "own 1")
    model, report = jax.jit(lambda d: edmd.fit(dictionary, d))(made_up())
    assert model.A.shape == (9, 9)
    assert report.finite


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: custom_dictionary(lambda x: x[2]), "function must return a vector"),
        (
            lambda: custom_dictionary(lambda x: x[:2] @ x),
            "does not take a state of shape",
        ),
        (
            lambda: custom_dictionary(lambda x: x[:2], names=["a"]),
            "must have 2 entries each, got 1",
        ),
        (lambda: observables.monomials(0), "degree must be 1 or more, got 0"),
        (lambda: observables.fourier(0), "count must be at least 1, got 0"),
        (lambda: observables.delays(observables.states_only(), 0), "count must be at least 1"),
    ],
)
def test_a_wrong_dictionary_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_delay_coordinates_fit_a_system_with_memory():
    """omega+ depends on the last omega but one: one delay explains it, none does not."""
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(30, 25, 4))
    x = rng.normal(size=(30, 26, 6))
    x[..., 0] = 0.0
    for t in range(1, 25):
        x[:, t + 1] = 0.5 * x[:, t]
        x[:, t + 1, 5] = 0.6 * x[:, t, 5] - 0.3 * x[:, t - 1, 5] + 0.1 * inputs[:, t, 2]
        x[:, t + 1, 0] = x[:, t, 0] + 0.01 * x[:, t, 3]
    data = Snapshots(jnp.asarray(x[:, 1:]), jnp.asarray(inputs[:, 1:]), jnp.zeros((30, 2, 2)))
    plain = observables.states_only()
    delayed = observables.delays(plain, 1)
    assert delayed.size == 13
    assert delayed.names[-1] == "omega, 1 steps ago"
    residual = {
        d.window: np.asarray(jax.jit(lambda s, d=d: edmd.fit(d, s)[1].residual_rms)(data))
        for d in (plain, delayed)
    }
    assert residual[1][5] > 1e-3
    assert residual[2].max() < 1e-13


# ---------------------------------------------------------------- bad data


def snapshots(**changes):
    data = {k: np.array(v) for k, v in made_up(rollouts=6)._asdict().items()}
    t = np.arange(21) * DT
    # Smooth motion whose positions follow from the velocities.
    data["states"] = np.zeros((6, 21, 6))
    data["states"][..., 3:] = np.random.default_rng(0).normal(size=(6, 1, 3))
    data["states"][..., :3] = data["states"][..., 3:] * t[:, None] + 0.1
    for key, change in changes.items():
        data[key] = change(data[key])
    return Snapshots(**data)


def put(index, value):
    def change(array):
        array = array.copy()
        array[index] = value
        return array

    return change


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": put((3, 7, 2), np.nan)}, "states: 1 of 6 rollouts.*the first one is rollout 3"),
        ({"inputs": put((0, 0), np.inf)}, "inputs: 1 of 6 rollouts hold values that are not"),
        ({"states": lambda a: a[..., :5]}, r"states: got shape \(6, 21, 5\), wanted"),
        ({"inputs": lambda a: a[:, :-1]}, r"inputs: got shape \(6, 19, 4\), wanted \(6, 20, 4\)"),
        ({"feet": lambda a: a[:1]}, r"feet: got shape \(1, 2, 2\), wanted \(6, 2, 2\)"),
        (
            {"states": lambda a: np.concatenate([a[:, :10], a[::-1, 10:] + 0.4], axis=1)},
            "rollout 0 jumps by .* between steps 9 and 10.*two episodes",
        ),
    ],
)
def test_bad_data_is_named(changes, message):
    with pytest.raises(ValueError, match=message):
        edmd.check_snapshots(snapshots(**changes), observables.paper(4), dt=DT)


def test_too_few_samples_and_still_observables_are_named():
    few = jax.tree.map(lambda a: a[:, :3] if a.ndim == 3 and a.shape[1] == 21 else a, snapshots())
    few = Snapshots(few.states[:2], few.inputs[:2, :2], few.feet[:2])
    with pytest.raises(ValueError, match="4 snapshots are too few for 19 regressors"):
        edmd.check_snapshots(few, observables.paper(4), dt=DT)
    still = snapshots(states=put((..., 4), 0.25))
    still.states[..., 1] = 0.1 + 0.25 * np.arange(21) * DT
    remarks = edmd.check_snapshots(still, observables.states_only(), dt=DT)
    assert remarks == ["observable 'v_z' does not vary in the data: it counts as a constant"]


def test_the_spectrum_is_in_rates_per_second():
    A = np.array(
        [[1.0, 0.0, 0.0], [0.0, np.cos(5e-3), -np.sin(5e-3)], [0.0, np.sin(5e-3), np.cos(5e-3)]]
    )
    rates = edmd.spectrum(A * 1.001, DT)
    np.testing.assert_allclose(rates.real, np.log(1.001) / DT)
    np.testing.assert_allclose(np.sort(rates.imag), [-5.0, 0.0, 5.0], atol=1e-9)
