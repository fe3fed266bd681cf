"""EDMD against numpy's least squares, exact linear systems and the rigid body's own algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.dynamics.srb_planar import SrbParams
from kjax.koopman import edmd, models, observables
from kjax.koopman.dataset import DatasetSpec, Snapshots
from kjax.spec import DictionarySpec
from kjax.types import MODE_ALPHA, Mode

DT = 1e-3  # s, the step of the shared snapshots
STATE = slice(1, 7)
BODY = SrbParams(mass=10.0, inertia=0.3, feet=np.array([[0.2, -0.3], [-0.1, -0.3]]))


input_map = jax.jit(models.input_map)


def pick(tree, mode):
    return jax.tree.map(lambda a: np.asarray(a)[mode], tree)


def cast(tree, dtype):
    return jax.tree.map(lambda a: np.asarray(a, dtype), tree)


def lift_by_hand(x):
    """The de-duplicated dictionary of order 4 on states (..., 6), in numpy."""
    c, s, omega = np.cos(x[..., 2]), np.sin(x[..., 2]), x[..., 5]
    powers = [f * omega**k for k in range(1, 5) for f in (c, s)]
    return np.stack([np.ones_like(c), *np.moveaxis(x, -1, 0), *powers], axis=-1)


def fit_by_hand(data):
    """[A, B] by numpy.linalg.lstsq on the full states, in double precision."""
    z = lift_by_hand(np.asarray(data.states, np.float64))
    now, then = (a.reshape(-1, z.shape[-1]) for a in (z[:, :-1], z[:, 1:]))
    Z = np.concatenate([now, np.asarray(data.inputs, np.float64).reshape(-1, 4)], axis=1)
    scale = np.linalg.norm(Z, axis=0)
    K = np.linalg.lstsq(Z / scale, then, rcond=None)[0] / scale[:, None]
    return K[:-4].T, K[-4:].T


@pytest.mark.parametrize("mode", list(Mode))
def test_the_fit_equals_numpys_least_squares_in_every_mode(mode, fitted, snapshots):
    model = pick(fitted[0], mode)
    A, B = fit_by_hand(pick(snapshots, mode))
    # Rounding 2e-16 times the condition of the scaled regressor (under 1e3) on values up to 1,
    # times the column scaling that is undone (a ratio of columns up to 16 for omega^4).
    np.testing.assert_allclose(model.A, A, rtol=0, atol=1e-10)
    # B is smaller by the size of a force, about 1e2 N.
    np.testing.assert_allclose(model.B, B, rtol=0, atol=1e-12)


@pytest.mark.parametrize("mode", [Mode.TROT, Mode.FRONT])
def test_the_fit_is_that_of_the_papers_gram_matrices(mode, fitted, snapshots):
    """K = G_1 G_2^-1, with G_2 the Gram matrix of [Pi; u], which has an inverse."""
    data, model = pick(snapshots, mode), pick(fitted[0], mode)
    z = lift_by_hand(data.states)
    now, then = (a.reshape(-1, z.shape[-1]) for a in (z[:, :-1], z[:, 1:]))
    Z = np.concatenate([now, data.inputs.reshape(-1, 4)], axis=1)
    G_1, G_2 = then.T @ Z / len(Z), Z.T @ Z / len(Z)
    K = G_1 @ np.linalg.pinv(G_2, rcond=1e-14)
    # The Gram matrix squares the condition of unscaled columns, about 1e5: 2e-16 times 1e10.
    predicted = now @ model.A.T + Z[:, -4:] @ model.B.T
    np.testing.assert_allclose(Z @ K.T, predicted, rtol=0, atol=1e-5)


def test_single_precision_predicts_like_double(fit_modes, fitted, snapshots):
    single, _ = fit_modes()(cast(snapshots, jnp.float32))
    assert single.A.dtype == single.B.dtype == jnp.float32
    rollout = jax.jit(jax.vmap(models.rollout, in_axes=(None, 0, 0, None)))
    data = pick(snapshots, Mode.TROT)
    x0, inputs = data.states[:, 0], data.inputs
    lift = jax.jit(jax.vmap(observables.paper(4).lift))
    predict = [
        rollout(cast(pick(m, Mode.TROT), jnp.float64), lift(x0), inputs, jnp.zeros((2, 2)))
        for m in (single, fitted[0])
    ]
    # Increments are fitted to 6e-8 of their data (v: eps * 2 m/s per step), condition 1e3, 25
    # steps, errors that average: measured on prototypes below 1e-5, and 1e-1 with a Gram matrix.
    np.testing.assert_allclose(*predict, rtol=0, atol=1e-4)


@pytest.fixture(scope="module")
def fitted_literal(fit_modes, snapshots):
    return fit_modes(literal=True)(snapshots)


def test_the_literal_dictionary_is_rank_deficient_and_the_short_one_is_not(fitted, fitted_literal):
    np.testing.assert_array_equal(fitted_literal[1].columns, 27)
    np.testing.assert_array_equal(fitted_literal[1].rank, 19)
    np.testing.assert_array_equal(fitted[1].columns, 19)
    np.testing.assert_array_equal(fitted[1].rank, 19)
    # Repeated columns leave singular values at rounding level: condition 1e12 and beyond.
    assert (np.asarray(fitted_literal[1].condition_full) > 1e12).all()
    assert (np.asarray(fitted[1].condition_full) < 1e5).all()
    np.testing.assert_array_equal(fitted[1].condition, fitted[1].condition_full)


def test_the_literal_dictionary_predicts_like_the_short_one(fitted, fitted_literal, snapshots):
    x0, inputs = (np.asarray(a)[:, :5] for a in (snapshots.states[:, :, 0], snapshots.inputs))

    def predict(model, literal):
        lift = observables.paper(4, literal=literal).lift
        one = jax.vmap(
            lambda m, x, u: models.rollout(m, lift(x), u, jnp.zeros((2, 2))), in_axes=(None, 0, 0)
        )
        return jax.jit(jax.vmap(one))(model, x0, inputs)

    short, literal = predict(fitted[0], literal=False), predict(fitted_literal[0], literal=True)
    # Both minimise the same residual: rounding 2e-16 times condition 1e3, 25 steps, states up to 4.
    np.testing.assert_allclose(literal, short, rtol=0, atol=2e-11)


@pytest.mark.parametrize("literal", [False, True])
def test_an_exactly_linear_system_is_recovered(fit_modes, dtype, literal):
    """States that follow x+ = A x + B u + c of a made-up system, no rigid body involved."""
    rng = np.random.default_rng(7)
    A = np.eye(6) + 0.05 * rng.normal(size=(6, 6))
    B, c = 0.1 * rng.normal(size=(6, 4)), 0.1 * rng.normal(size=6)
    inputs = rng.normal(size=(1, 40, 25, 4))
    states = [rng.normal(size=(1, 40, 6))]
    for t in range(25):
        states.append(states[-1] @ A.T + inputs[:, :, t] @ B.T + c)
    data = Snapshots(states=np.stack(states, 2), inputs=inputs, feet=np.zeros((1, 40, 2, 2)))
    model, report = fit_modes(literal=literal)(cast(data, dtype))
    K = np.asarray(model.A[0, STATE])
    # Rounding of the data times the condition; omega^4 reaches far here, hence the reserve.
    tolerance = np.finfo(dtype).eps * float(report.condition[0])
    assert tolerance < 1e-2
    np.testing.assert_allclose(K[:, STATE], A, rtol=0, atol=tolerance)
    np.testing.assert_allclose(model.B[0, STATE], B, rtol=0, atol=tolerance)
    np.testing.assert_allclose(K[:, 0], c, rtol=0, atol=tolerance)
    np.testing.assert_allclose(K[:, 7:], 0.0, rtol=0, atol=tolerance)


def test_flight_is_modelled_exactly(fitted):
    model = pick(fitted[0], Mode.FLIGHT)
    A = np.zeros((6, 15))
    A[:, STATE] = np.eye(6) + DT * np.eye(6, k=3)
    A[4, 0], A[1, 0] = -9.81 * DT, -9.81 * DT**2 / 2
    # Rounding 2e-16 times condition 1e3 and data of order one; per newton a hundredth of that.
    np.testing.assert_allclose(model.A[STATE], A, rtol=0, atol=2e-13)
    np.testing.assert_allclose(model.B[STATE], 0.0, rtol=0, atol=2e-15)


@pytest.mark.parametrize("mode", list(Mode))
def test_pitch_acceleration_is_modelled_exactly_for_fixed_contact_points(mode, fitted, body):
    """The moment is linear in the body-frame force: the omega row holds no error at all."""
    row = pick(fitted[0], mode).B[6]
    alpha, r = np.repeat(MODE_ALPHA[mode], 2), np.asarray(body.feet)
    arms = np.array([-r[0, 1], r[0, 0], -r[1, 1], r[1, 0]])
    # Rounding 2e-16 times condition 1e3 on values of 1e-3.
    np.testing.assert_allclose(row, DT * alpha * arms / body.inertia, rtol=0, atol=1e-15)


@pytest.mark.parametrize("mode", list(Mode))
def test_with_measured_feet_the_moment_row_is_the_lever_arm(mode, fitted_moving_feet, body):
    model = pick(fitted_moving_feet[0], mode)
    alpha = np.repeat(MODE_ALPHA[mode], 2)
    for seed in range(3):
        r = np.random.default_rng(seed).uniform(-0.3, 0.3, (2, 2))
        arms = np.array([-r[0, 1], r[0, 0], -r[1, 1], r[1, 0]])
        row = input_map(model, r)[6]
        # r x F is among the regressors, so it is exact: rounding as above.
        np.testing.assert_allclose(row, DT * alpha * arms / body.inertia, rtol=0, atol=1e-15)


def test_measured_feet_add_eight_columns_of_full_rank(fitted_moving_feet):
    np.testing.assert_array_equal(fitted_moving_feet[1].columns, 27)
    np.testing.assert_array_equal(fitted_moving_feet[1].rank, 27)


def test_with_fixed_contact_points_the_input_map_does_not_depend_on_them(fitted):
    np.testing.assert_array_equal(fitted[0].B_feet, 0.0)


def test_the_constant_observable_stays_one(fitted, fitted_moving_feet):
    for model in (fitted[0], fitted_moving_feet[0]):
        expected = np.zeros_like(model.A[:, 0])
        expected[:, 0] = 1.0
        # The increment of the constant is exactly zero in the data.
        np.testing.assert_array_equal(model.A[:, 0], expected)
        np.testing.assert_array_equal(model.B[:, 0], 0.0)


def test_the_reported_residual_is_the_one_step_error(fitted, snapshots):
    model, data = pick(fitted[0], Mode.TROT), pick(snapshots, Mode.TROT)
    states = np.asarray(data.states)
    z = lift_by_hand(states[:, :-1])
    predicted = z @ np.asarray(model.A)[STATE].T + np.asarray(data.inputs) @ model.B[STATE].T
    rms = np.sqrt(np.mean((predicted - states[:, 1:]) ** 2, axis=(0, 1)))
    reported = np.asarray(fitted[1].residual_rms[Mode.TROT])
    # Positions and velocities are bilinear in pitch and force, so their residual is real.
    assert (reported[[0, 1, 3, 4]] > 1e-9).all()
    # Rounding of states up to 3 in the subtraction above.
    np.testing.assert_allclose(reported, rms, rtol=1e-6, atol=1e-15)


def test_a_batched_fit_equals_single_fits(fitted, snapshots):
    single = jax.jit(lambda data: edmd.fit(observables.paper(4), data))
    for mode in (Mode.FRONT, Mode.TROT):
        model, report = single(pick(snapshots, mode))
        # LAPACK's blocked and batched kernels round differently: 2e-16 times condition 1e3.
        np.testing.assert_allclose(model.A, fitted[0].A[mode], rtol=0, atol=1e-11)
        np.testing.assert_allclose(model.B, fitted[0].B[mode], rtol=0, atol=1e-13)
        assert report.rank == fitted[1].rank[mode]


@pytest.mark.parametrize("when", [4, -1])  # the last state is a target only, no regressor
def test_data_that_is_not_finite_is_reported_and_spoils_its_own_mode_only(
    fit_modes, fitted, snapshots, when
):
    states = np.array(snapshots.states)
    states[Mode.REAR, 3, when, 5] = np.nan
    model, report = fit_modes()(snapshots._replace(states=states))
    expected = np.arange(len(Mode)) != Mode.REAR
    np.testing.assert_array_equal(report.finite, expected)
    np.testing.assert_array_equal(np.asarray(model.A)[expected], np.asarray(fitted[0].A)[expected])


def test_constant_data_is_reported_as_rank_one(fit_modes, snapshots):
    x = np.array([0.1, 0.3, 0.2, 0.5, 0.1, 1.0])
    data = snapshots._replace(
        states=np.broadcast_to(x, snapshots.states.shape),
        inputs=np.full(snapshots.inputs.shape, 20.0),
    )
    model, report = fit_modes()(data)
    np.testing.assert_array_equal(report.rank, 1)
    assert np.asarray(report.finite).all()
    # Nothing moved: the minimum-norm answer is no increment. Rounding of one row.
    np.testing.assert_allclose(
        model.A, np.broadcast_to(np.eye(15), (len(Mode), 15, 15)), rtol=0, atol=1e-12
    )


def test_every_figure_of_the_report_is_a_number_even_for_data_of_zeros(fit_modes, snapshots):
    data = jax.tree.map(np.zeros_like, snapshots)
    _, report = fit_modes()(data)
    assert np.asarray(report.finite).all()
    assert not np.isnan(np.asarray(report.condition)).any()
    assert not np.isnan(np.asarray(report.condition_full)).any()


def test_fit_modes_stacks_models_over_all_contact_modes_each_with_its_own_contact_points():
    few = DatasetSpec(rollouts=10, duration=0.01)
    bounding = ((0.07, -0.24), (-0.15, -0.25))
    own = ((0.2, -0.3), (-0.1, -0.3))
    feet = [bounding if mode in (Mode.FRONT, Mode.REAR) else own for mode in Mode]
    body = edmd.stack_bodies(10.0, 0.3, feet)
    model, report = jax.jit(edmd.fit_modes, static_argnames=("dictionary", "dataset"))(
        body, jax.random.key(0), dictionary=DictionarySpec(order=1), dataset=few
    )
    assert model.A.shape == (len(Mode), 9, 9)
    assert np.asarray(report.finite).all()
    for mode in Mode:
        own = bounding if mode in (Mode.FRONT, Mode.REAR) else ((0.2, -0.3), (-0.1, -0.3))
        (x_f, z_f), (x_r, z_r) = own
        alpha, arms = np.repeat(MODE_ALPHA[mode], 2), np.array([-z_f, x_f, -z_r, x_r])
        # Exact but for rounding, as above.
        np.testing.assert_allclose(model.B[mode, 6], DT * alpha * arms / 0.3, rtol=0, atol=1e-15)


def test_bodies_are_stacked_with_a_leading_axis():
    body = edmd.srb_params(BODY)
    np.testing.assert_array_equal(body.mass, np.full(len(Mode), 10.0))
    np.testing.assert_array_equal(body.inertia, np.full(len(Mode), 0.3))
    np.testing.assert_array_equal(body.feet, [((0.2, -0.3), (-0.1, -0.3))] * len(Mode))


def test_a_mode_is_fitted_to_the_same_data_in_any_list_of_modes():
    few, body = DatasetSpec(rollouts=40), edmd.srb_params(BODY)
    fit = jax.jit(edmd.fit_modes, static_argnames=("dataset", "modes"))
    key = jax.random.key(0)
    whole, _ = fit(body, key, dataset=few)
    chosen = (Mode.STAND, Mode.TROT)
    some, _ = fit(jax.tree.map(lambda a: a[:2], body), key, dataset=few, modes=chosen)
    for place, mode in enumerate(chosen):
        # Vectorised over another number of modes: rounding.
        np.testing.assert_allclose(some.B[place], whole.B[mode], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "size"),
    [
        ({}, 15),
        ({"dictionary": "paper_literal"}, 23),
        ({"order": 2}, 11),
        ({"constant_rotation": True}, 17),
    ],
)
def test_the_spec_names_the_dictionary(options, size):
    assert edmd.build_dictionary(DictionarySpec(**options)).size == size
