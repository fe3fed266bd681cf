"""The wrench that a rigid body misses: its features, and its file."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.dynamics import rotations
from kjax.dynamics.srb_spatial import BodyState
from kjax.prediction import residual_wrench, storage
from kjax.prediction.residual_wrench import FEATURES, SHAPE, ResidualWrench

WEIGHTS = ResidualWrench(jnp.asarray(np.random.default_rng(0).normal(size=SHAPE)))
wrench = jax.jit(residual_wrench.wrench)


def state(yaw=0.0):
    about_z = rotations.exp(jnp.array([0.0, 0.0, yaw]))
    tilted = rotations.exp(jnp.array([0.1, -0.2, 0.0]))
    v = about_z @ jnp.array([0.5, 0.1, -0.2])
    return BodyState(jnp.array([3.0, 1.0, 0.27]), about_z @ tilted, v, jnp.zeros(3)), about_z


FORCE = jnp.zeros((4, 3)).at[0].set(jnp.array([5.0, -3.0, 60.0]))
RATE = jnp.array([0.3, -0.5, 0.9])


def test_features_are_what_their_names_say():
    own, _ = state()
    phi = dict(zip(FEATURES, residual_wrench.features(own, RATE, FORCE, 0.25), strict=True))
    axes = np.asarray(residual_wrench.heading_axes(own.R))
    assert phi["1"] == 1.0
    assert phi["height"] == pytest.approx(0.27)
    assert phi["v_x"] == pytest.approx((axes.T @ np.asarray(own.v))[0])
    assert phi["F_FR_z"] == pytest.approx(60.0)
    assert phi["F_RL_z"] == 0.0
    assert phi["cos"] == pytest.approx(0.0, abs=1e-7)
    assert phi["sin"] == pytest.approx(1.0)
    assert phi["cos2"] == pytest.approx(-1.0)
    assert phi["sin omega_z"] == pytest.approx(0.9)


def test_the_wrench_turns_with_the_robot():
    (own, _), (turned, about_z) = state(), state(2.0)
    found = np.asarray(wrench(WEIGHTS, own, RATE, FORCE, 0.3))
    other = np.asarray(wrench(WEIGHTS, turned, about_z @ RATE, FORCE @ about_z.T, 0.3))
    np.testing.assert_allclose(other, found @ np.asarray(about_z).T, rtol=1e-4, atol=1e-4)


def test_each_set_of_standing_legs_has_weights_of_its_own():
    sets = jnp.array([[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 1, 0], [1, 1, 1, 1]], bool)
    assert residual_wrench.pattern(sets).tolist() == [0, 1, 6, 15]


def test_a_file_gives_back_what_was_saved(tmp_path):
    path = residual_wrench.save(tmp_path / "own", WEIGHTS)
    assert path.name == "own.npz"
    np.testing.assert_array_equal(residual_wrench.load(tmp_path / "own").W, WEIGHTS.W)
    assert [one.name for one in tmp_path.iterdir()] == ["own.npz"]


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"family": np.array("residual"), "W": np.zeros(SHAPE)}, "holds residual, wanted a"),
        ({"W": np.zeros(SHAPE)}, "holds no model"),
        ({"family": np.array("residual_wrench")}, "lacks 'W'"),
        ({"family": np.array("residual_wrench"), "W": np.zeros((16, 6, 22))}, "shape"),
        ({"family": np.array("residual_wrench"), "W": np.zeros((4, 6, 32))}, "4 sets of standing"),
        ({"family": np.array("residual_wrench"), "W": np.full(SHAPE, np.nan)}, "not finite"),
    ],
)
def test_a_file_that_holds_something_else_is_named(tmp_path, arrays, said):
    path = storage.write(tmp_path / "bad.npz", arrays)
    with pytest.raises(ValueError, match=said) as caught:
        residual_wrench.load(path)
    assert "bad.npz" in str(caught.value)
