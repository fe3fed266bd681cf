import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from kjax import RunConfig, load_config
from kjax.sim.engines import mjx as mjx_engine
from kjax.sim.resolve import resolve_scene, start_state
from kjax.sim.sensitivity import build_sensitivity

CONFIG = load_config(
    RunConfig, None, {"sim.base": "planar", "sim.contacts": "feet", "noise.enabled": False}
)


@pytest.fixture(scope="module")
def model():
    made = mjx_engine.build_model(resolve_scene(CONFIG)[0])
    # C's own differences need a solver that has converged.
    made.opt.iterations, made.opt.ls_iterations, made.opt.tolerance = 100, 100, 0.0
    return made


@pytest.fixture(scope="module")
def standing(model):
    """The robot on its feet, legs loaded: (qpos, qvel, ctrl)."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start_state(CONFIG, model)
    names = [model.actuator(i).name for i in range(model.nu)]
    joints = [model.actuator_trnid[i, 0] for i in range(len(names))]
    goal = data.qpos[[model.jnt_qposadr[j] for j in joints]].copy()
    for _ in range(400):
        q = data.qpos[[model.jnt_qposadr[j] for j in joints]]
        v = data.qvel[[model.jnt_dofadr[j] for j in joints]]
        data.ctrl[:] = 120.0 * (goal - q) - 3.0 * v
        mujoco.mj_step(model, data)
    assert data.ncon >= 4
    return data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()


@pytest.mark.slow
def test_forward_derivatives_through_contact_are_c_mujocos(model, standing):
    steps = 3
    ours = jax.jit(build_sensitivity(model, steps))(*map(jnp.asarray, standing))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = standing
    n, nu = 2 * model.nv, model.nu
    by_state, by_control = np.eye(n), np.zeros((n, nu))
    for _ in range(steps):
        A, B = np.zeros((n, n)), np.zeros((n, nu))
        mujoco.mj_forward(model, data)
        mujoco.mjd_transitionFD(model, data, 1e-6, True, A, B, None, None)
        by_state, by_control = A @ by_state, A @ by_control + B
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(ours.y, np.concatenate([data.qpos, data.qvel]), atol=1e-7)
    # Differences of 1e-6 of states that are exact to 1e-13 in contacts of 1e5 N/m.
    for own, wanted in ((ours.by_state, by_state), (ours.by_control, by_control)):
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(np.asarray(own) / scale, wanted / scale, atol=2e-4)


@pytest.mark.slow
def test_reverse_mode_is_what_mjx_cannot(model, standing):
    own = mjx.put_model(model)

    def height(ctrl):
        data = mjx.make_data(own).replace(qpos=jnp.asarray(standing[0]), ctrl=ctrl)
        return mjx.step(own, data).qpos[1]

    with pytest.raises(ValueError, match=r"[Rr]everse-mode"):
        jax.jit(jax.grad(height)).lower(jnp.asarray(standing[2]))


def test_a_model_whose_derivative_would_be_wrong_is_refused(model):
    free = load_config(RunConfig, None, {"sim.contacts": "feet", "sim.base": "free"})
    with pytest.raises(ValueError, match="no free or ball joint"):
        build_sensitivity(mjx_engine.build_model(resolve_scene(free)[0]), 1)
    with pytest.raises(ValueError, match="steps must be at least 1"):
        build_sensitivity(model, 0)
    elliptic = mjx_engine.build_model(resolve_scene(CONFIG)[0])
    elliptic.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    with pytest.raises(ValueError, match="pyramidal"):
        build_sensitivity(elliptic, 1)
