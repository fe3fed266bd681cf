"""Models of the body in three dimensions: the data is physics, and the errors are what they are."""

import jax.numpy as jnp
import numpy as np
import pytest

from kjax.studies.spatial_models import models, study

LEGS = models.LEGS["trot"]


@pytest.fixture(scope="module")
def body():
    return models.rigid_body()


@pytest.fixture(scope="module")
def data(body):
    return models.draw(body, [0, 1], LEGS, 30, models.NODES, anywhere=False)


@pytest.fixture(scope="module")
def errors():
    return models.predicted(0, "trot", 600, 30)


def test_the_data_is_a_rigid_body_under_its_forces(body, data):
    m, h = float(body.mass), models.NODE
    v, total = np.asarray(data.states.v), np.asarray(data.force).sum(axis=2)
    np.testing.assert_allclose(np.diff(v, axis=1), h * (total / m + [0, 0, -9.81]), atol=1e-12)
    assert not np.asarray(data.force)[:, :, [1, 2]].any()  # legs in the air
    assert np.abs(data.omega).max() < 4.5
    R = np.asarray(data.states.R)
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape),
                               atol=1e-12)  # fmt: skip
    # I_w omega is what the momentum is.
    inertia = R @ np.asarray(body.inertia) @ np.swapaxes(R, -1, -2)
    L = np.einsum("nkij,nkj->nki", inertia, np.asarray(data.omega))
    np.testing.assert_allclose(L, data.states.L, atol=1e-12)


def test_about_the_forces_that_come_the_momentum_model_is_the_truth(body, data):
    start = type(data.states)(*(a[:, 0] for a in data.states))
    R, omega = models._by_response(body, "momentum", start, data.feet, data.force, data.force)
    # One step of the attitude per node, ten in the data.
    np.testing.assert_allclose(R, data.states.R[:, 1:], atol=2e-5)
    np.testing.assert_allclose(omega, data.omega[:, 1:], atol=2e-4)


def test_the_order_of_the_models_and_growth_with_time(errors):
    attitude = {name: np.array(found)[:, 0] for name, found in errors.items()}
    assert list(attitude) == list(models.TITLES)
    for found in attitude.values():
        assert (np.diff(found) > 0).all()
    last = {name: found[-1] for name, found in attitude.items()}
    assert last["momentum_plan"] < last["momentum"] < last["present"] < last["hold"]
    assert last["bilinear"] < last["edmd_wrench"] < last["edmd_forces"]
    # Holding the state misses the turn itself, of 1.7 rad/s a component on average.
    assert 15 < last["hold"] < 45


def test_edmd_finds_a_linear_system_that_is_one(body):
    """Forces at the feet's own place and no turn: what remains, p and v, is linear."""
    data = models.draw(body, [1, 1], LEGS, 20, models.NODES, anywhere=False)
    steps = models.draw(body, [1, 2], LEGS, 400, 1, anywhere=True)
    found = np.asarray(models._edmd(data, steps, "edmd_forces", LEGS))
    np.testing.assert_allclose(found[..., 1:4], data.states.p[:, 1:], atol=1e-9)
    np.testing.assert_allclose(found[..., 4:7], data.states.v[:, 1:], atol=1e-9)


def test_table_and_figure_are_of_the_record(tmp_path, errors):
    kept = {mode: {name: [found] for name, found in errors.items()} for mode in models.LEGS}
    record = {"quick": False, "models": study.summary(kept)}
    text = study.table(record)
    attitude, rate = errors["momentum"][-1]
    assert f"{attitude:.2g} / {rate:.2g}" in text
    study.figure(record, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5000
    assert jnp.isfinite(jnp.asarray(errors["bilinear"])).all()
