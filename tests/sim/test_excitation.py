"""Random forces on top of the planned ones: alike on all engines, nothing where they are off."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.config import RunConfig, load_config
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.excitation import perturb
from kjax.sim.noise import force_noise, force_row
from kjax.sim.resolve import batch_spec, resolve_episode, resolve_episodes, resolve_scene

SHORT = {
    "sim.base": "planar",
    "duration": 0.3,
    "sim.contacts": "feet",
    "noise.force": 12.0,
    "seed": 5,
}
BOX = {"lmpc.friction": np.inf, "lmpc.torque_fraction": np.inf}


def config(**keys):
    return load_config(RunConfig, None, SHORT | BOX | keys)


def test_standing_legs_of_an_end_get_the_same_and_none_is_pulled_down(dtype):
    force = jnp.asarray([[1, 5, 60], [2, 5, 50], [3, 5, 4], [4, 5, 0]], dtype)
    stance = jnp.asarray([True, False, True, False])
    noise = jnp.asarray([3.0, -7.0, -5.0, -9.0])
    got = jax.jit(perturb)(force, stance, noise)
    assert got.dtype == dtype
    np.testing.assert_allclose(got, [[4, 5, 53], [2, 5, 50], [-2, 5, 0], [4, 5, 0]])
    np.testing.assert_array_equal(perturb(force, stance, jnp.zeros(4)), force)


def added(config, ticks):
    """Forces that an episode adds at its control ticks of five steps."""
    return force_noise(resolve_scene(config)[1], 5, ticks)


def test_noise_depends_on_the_seed_and_the_tick_and_has_the_size_asked_for():
    one = added(config(), 2000)
    assert one.std(axis=0) == pytest.approx(12.0, rel=0.05)  # 3 sigma of 2,000 draws
    assert np.abs(np.corrcoef(one.T) - np.eye(4)).max() < 0.08
    np.testing.assert_array_equal(one[:60], added(config(), 60))
    row = force_row(jnp.asarray(5), jnp.asarray(35))  # tick 7 of 5 steps
    np.testing.assert_allclose(one[7], 12.0 * np.asarray(row), rtol=1e-6)
    assert np.abs(added(config(seed=6), 60) - one[:60]).max() > 1.0


def test_only_whether_forces_are_perturbed_is_compiled_in():
    off = {"noise.force": 0.0}
    none = {"noise.enabled": False}
    assert batch_spec(config()) == batch_spec(config(**{"noise.force": 3.0}))
    assert batch_spec(config()) != batch_spec(config(**off))
    assert batch_spec(config(**none)) == batch_spec(config(**off, **none))


@pytest.mark.slow
def test_both_loops_press_the_same_forces():
    two = [config(), config(**{"noise.force": 6.0, "seed": 9})]
    run = BatchEngine(batch_spec(two[0]), dtype=np.float64, threads=1).run(resolve_episodes(two))
    simulation, calm = (
        MujocoEngine(batch_spec(two[0])),
        MujocoEngine(batch_spec(config(**{"noise.force": 0.0}))),
    )
    for robot, own in enumerate(two):
        alone = simulate(simulation, resolve_episode(own))
        # 1e-2 N: equal forces, but the plans of two engines differ by their rounding
        np.testing.assert_allclose(run.log.force[:, robot], alone.force[::5], atol=1e-2)
        np.testing.assert_array_equal(simulate(simulation, resolve_episode(own)).force, alone.force)
        plain = simulate(calm, resolve_episode(config(**{"noise.force": 0.0, "seed": own.seed})))
        (noise,) = added(own, 1)
        wanted = perturb(plain.force[0], plain.stance[0], jnp.asarray(noise))
        np.testing.assert_allclose(alone.force[0], wanted, atol=1e-5)
        assert np.abs(alone.x - plain.x).max() > 1e-4


@pytest.mark.slow
def test_noise_that_is_off_changes_nothing():
    base = load_config(RunConfig, None, BOX | {"duration": 0.2, "noise.enabled": False})
    noisy = dataclasses.replace(base, noise=dataclasses.replace(base.noise, force=9.0))
    simulation = MujocoEngine(batch_spec(base))
    jax.tree.map(
        np.testing.assert_array_equal,
        simulate(simulation, resolve_episode(noisy)).qpos,
        simulate(simulation, resolve_episode(base)).qpos,
    )
