"""The ground's slope from footholds, against planes that are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.legs import ground

RADIUS = 0.023
start_slope, next_slope = jax.jit(ground.start_slope), jax.jit(ground.next_slope)
HOLDS = np.array([[0.21, -0.12, 0.0], [0.17, 0.14, 0.0], [-0.2, -0.15, 0.0], [-0.16, 0.11, 0.0]])


def on(slope, height=-0.3):
    """Footholds on a plane."""
    return HOLDS + [0, 0, 1] * (height + HOLDS[:, :2] @ slope)[:, None]


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.3, -0.1), (-0.2, 0.36)])
def test_footholds_on_a_plane_tell_its_slope(slope):
    known = start_slope(jnp.asarray(RADIUS), jnp.asarray(on((0.0, 0.0))))
    seen = next_slope(known, jnp.asarray(on(slope)), jnp.ones(4, bool), jnp.asarray(1.0))
    np.testing.assert_allclose(seen.slope, slope, rtol=2e-3, atol=1e-12)
    # A tenth of the way with each call.
    part = next_slope(known, jnp.asarray(on(slope)), jnp.ones(4, bool), jnp.asarray(0.1))
    np.testing.assert_allclose(part.slope, 0.1 * seen.slope, rtol=1e-12, atol=1e-15)


def test_feet_in_the_air_are_remembered_where_they_stood():
    known = start_slope(jnp.asarray(RADIUS), jnp.asarray(on((0.2, 0.0))))
    lifted = jnp.asarray(on((0.2, 0.0))).at[0, 2].add(0.1)
    seen = next_slope(known, lifted, jnp.array([False, True, True, True]), jnp.asarray(1.0))
    np.testing.assert_allclose(seen.holds[0], known.holds[0])
    motion = jnp.array([0.1, -0.2, 0.05])
    later = ground.moved(known, motion)
    np.testing.assert_allclose(later.holds, known.holds - motion)


def test_a_foot_touches_a_slope_along_its_normal():
    slope = jnp.array([0.3, -0.2])
    axes = np.asarray(ground.upright(slope))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    for along in ([1.0, 0.0], [0.0, 1.0]):  # the plane's directions are across its normal
        assert axes[:, 2] @ [*along, np.asarray(slope) @ along] == pytest.approx(0.0, abs=1e-15)
    feet = jnp.asarray(on(np.asarray(slope)))
    touching = np.asarray(ground.soles(jnp.asarray(RADIUS), feet, slope))
    np.testing.assert_allclose(np.linalg.norm(touching - feet, axis=1), RADIUS)
    np.testing.assert_allclose((touching - np.asarray(feet)) @ axes[:, 2], -RADIUS)


def test_parallel_feet_that_say_nothing_of_a_direction_tell_no_slope_there():
    line = HOLDS * [1.0, 0.0, 0.0] + [0.0, 0.0, 0.05] * np.array([[1], [-1], [1], [-1]])
    known = start_slope(jnp.asarray(RADIUS), jnp.asarray(HOLDS))
    seen = next_slope(known, jnp.asarray(line), jnp.ones(4, bool), jnp.asarray(1.0))
    assert np.abs(seen.slope).max() <= ground.STEEPEST
    assert seen.slope[1] == pytest.approx(0.0, abs=1e-9)
