"""The PD loops that a real motor is sent give the torque that a simulator applies."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from kjax import RunConfig, build_controller, load_config
from kjax.controllers.params import condense
from kjax.controllers.resolve import resolve
from kjax.legs.posture import stand_pose
from kjax.robots import go1
from kjax.types import Observation

JOINTS = stand_pose(go1.PARAMS, 0.27)[1]


def sample(rng, base):
    free = base == "free"
    quat = np.zeros(4)
    turns = 0.1 * rng.normal(size=3) * [free, 1, free]
    mujoco.mju_euler2Quat(quat, turns, "xyz")
    return Observation(
        base_pos=jnp.zeros(3),
        base_quat=jnp.asarray(quat),
        base_vel=jnp.asarray(0.2 * rng.normal(size=3) * [1, free, 1]),
        base_ang_vel=jnp.asarray(0.5 * rng.normal(size=3) * [free, 1, free]),
        joint_pos=jnp.asarray(JOINTS + 0.1 * rng.normal(size=(4, 3)) * [free, 1, 1]),
        joint_vel=jnp.asarray(1.0 * rng.normal(size=(4, 3)) * [free, 1, 1]),
        contact=jnp.asarray(rng.random(4) < 0.7),
    )


@pytest.mark.parametrize("base", ["planar", "free"])
def test_the_loops_give_the_torque_for_the_sample_that_they_were_made_from(base):
    config = load_config(RunConfig, None, {"sim.base": base})
    spec, params = resolve(config, go1.PARAMS)
    controller, tables = build_controller(spec), condense(spec, params)
    plan, act = jax.jit(controller.plan), jax.jit(controller.act)
    rng = np.random.default_rng(0)
    state = controller.init(tables, sample(rng, base))
    gains = np.zeros((0, 2))
    for _ in range(20):
        seen = sample(rng, base)
        state, _ = plan(tables, state, seen)
        standing = np.asarray(state.stance)
        state, joints = act(tables, state, seen)
        torque, q, dq, kp, kd, feedforward = map(np.asarray, joints)
        loops = feedforward + kp * (q - seen.joint_pos) + kd * (dq - seen.joint_vel)
        np.testing.assert_allclose(loops, torque, rtol=0, atol=1e-10)
        assert (np.abs(torque) <= go1.PARAMS.torque_limit).all()
        # Legs in the air follow angles with the configured gains, legs that stand press.
        leg = config.leg
        moment = float(go1.PARAMS.mass) * 9.81 * 0.426  # m g L
        stiffness = moment * np.array([leg.abduction_kp, leg.swing_kp, leg.swing_kp])
        damping = moment * (0.426 / 9.81) ** 0.5 * np.array([leg.abduction_kd, *[leg.swing_kd] * 2])
        np.testing.assert_allclose(kp[~standing], np.tile(stiffness, (2, 1)), rtol=1e-14)
        np.testing.assert_allclose(kd[~standing], np.tile(damping, (2, 1)), rtol=1e-14)
        np.testing.assert_array_equal([kp[standing, 1:], kd[standing, 1:]], 0.0)
        free = np.abs(torque) < np.asarray(go1.PARAMS.torque_limit) - 1e-9
        np.testing.assert_allclose(feedforward[~standing][free[~standing]], 0.0, atol=1e-12)
        gains = np.concatenate([gains, np.stack([kp[standing, 0], kd[standing, 0]], -1)])
    # The abduction joints of stance legs: held on the planar base, loose feet's on the free one.
    held = gains[:, 0] > 0
    assert held.all() if base == "planar" else 0 < held.sum() < len(held)
