"""The same controller in C MuJoCo and inside a scan on MJX: the engines must agree."""

import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from kjax import RunConfig, build_controller, build_params, load_config
from kjax.robots import go1
from kjax.sim import mjx_loop
from kjax.sim.episode import initial_state, sensor_noise
from kjax.sim.mujoco_loop import build_simulation, simulate
from kjax.sim.observe import add_noise, build_observe

TICKS, PER_TICK = 60, 5


@pytest.fixture(scope="module")
def config():
    chosen = {"duration": 0.3, "sim.contacts": "feet", "push.times": [0.1], "push.forward": 2.0}
    return load_config(RunConfig, None, chosen)


@pytest.fixture(scope="module")
def both(config):
    controller, params = build_controller(config), build_params(config, go1.PARAMS)
    simulation = mjx_loop.build_mjx(config, controller)
    observe = build_observe(simulation.model, config.sim.contact_threshold)
    noise = sensor_noise(config, TICKS * PER_TICK)

    @jax.jit
    def run(qpos, qvel, noise):
        data = simulation.reset(qpos, qvel)
        seen = add_noise(observe(data.qpos, data.qvel, data.sensordata), noise[0, 0])
        return simulation.run(params, controller.init(params, seen), data, noise)

    start = initial_state(config, simulation.model.nq, simulation.model.nv)
    _, _, log = run(*start, noise.reshape(TICKS, PER_TICK, -1))
    in_c = simulate(build_simulation(config)._replace(model=simulation.model))
    return jax.device_get(log), in_c


@pytest.mark.slow
def test_three_tenths_of_a_second_of_trot_agree(both):
    log, in_c = both
    # Past the first swap of the diagonals at 0.25 s. 1e-9: equal algorithms in double precision;
    # what differs is the order of sums, which contacts amplify (1e-15 measured).
    np.testing.assert_allclose(log.qpos.reshape(-1, 15), in_c.qpos, atol=1e-9)
    np.testing.assert_allclose(log.qvel.reshape(-1, 15), in_c.qvel, atol=1e-7)
    np.testing.assert_allclose(log.torque.reshape(-1, 4, 3), in_c.torque, atol=1e-6)


@pytest.mark.slow
def test_both_were_pushed(both):
    log, in_c = both
    for speed in (log.qvel.reshape(-1, 15)[:, 0], in_c.qvel[:, 0]):
        # 2 N s on 12.7 kg, of which the stance legs take back a part while it acts
        assert 0.05 < speed[200] - speed[100] < 2.0 / 12.743


@pytest.mark.slow
def test_the_run_walks_and_swaps_its_diagonals(both):
    log, in_c = both
    assert (log.info.status == 0).all()
    assert in_c.stance[0].tolist() == [True, False, False, True]
    assert in_c.stance[-1].tolist() == [False, True, True, False]


@pytest.mark.slow
def test_one_step_of_the_pinned_pair_of_engines_agrees(config):
    """Guards the pair of mujoco and mujoco-mjx that the constraints file pins."""
    model = mjx_loop.build_model(config)
    qpos, qvel = initial_state(config, model.nq, model.nv)
    qpos[1] -= 0.003  # feet in the ground: contact forces at work
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_step(model, data)
    device = mjx.put_model(model)
    start = mjx.make_data(device)
    start = start.replace(qpos=start.qpos.at[:].set(qpos), qvel=start.qvel.at[:].set(qvel))
    stepped = jax.jit(mjx.step)(device, start)
    np.testing.assert_allclose(stepped.qpos, data.qpos, atol=1e-12)
    # 1e-9: the contact solver's own tolerance
    np.testing.assert_allclose(stepped.qvel, data.qvel, atol=1e-9)


def test_mjx_refuses_what_it_cannot_simulate():
    with pytest.raises(ValueError, match=r"sim\.contacts"):
        mjx_loop.build_model(RunConfig())
