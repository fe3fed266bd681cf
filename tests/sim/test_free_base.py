"""The free robot in C MuJoCo and on MJX: start, noise, metrics, a short walk, a shove."""

import dataclasses

import jax
import mujoco
import numpy as np
import pytest

from kjax.config import RunConfig, SimConfig, load_config
from kjax.legs.posture import stand_pose
from kjax.robots import go1
from kjax.sim import free_base
from kjax.sim.engines import mjx as mjx_engine
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.metrics import foot_slip, metrics, reference_velocity
from kjax.sim.noise import FREE_NOISE_DIM, add_noise, sensor_noise
from kjax.sim.observe import build_observe
from kjax.sim.resolve import (
    batch_spec,
    build_scene,
    resolve_episode,
    resolve_episodes,
    resolve_goal,
    resolve_scene,
    start_state,
)
from kjax.sim.trajectory import Trajectory

FREE = {"sim.base": "free", "sim.contacts": "feet"}
PER_TICK, TICKS = 5, 60


@pytest.fixture(scope="module")
def config():
    walk = {"duration": 1.5, "command.times": [0.0, 0.5], "command.v_x": [0.0, 0.2]}
    return load_config(RunConfig, None, FREE | walk)


@pytest.fixture(scope="module")
def episode(config):
    return resolve_episode(config)


@pytest.fixture(scope="module")
def simulation(episode):
    return MujocoEngine(episode.spec)


@pytest.fixture(scope="module")
def model(simulation):
    return simulation.model


def moved(model, seed):
    """Random posture and motion, everything derived."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    data.qpos[:3] = [0.3, -0.2, 0.4]
    mujoco.mju_euler2Quat(data.qpos[3:7], rng.uniform(-0.5, 0.5, 3), "zyx")
    data.qpos[7:] = (stand_pose(go1.PARAMS, 0.27)[1] + 0.3 * rng.standard_normal((4, 3))).reshape(
        -1
    )
    data.qvel[:] = rng.standard_normal(18)
    mujoco.mj_forward(model, data)
    return data


def test_it_starts_in_the_planar_robot_s_state(config, model):
    qpos, qvel = start_state(config, model)
    planar = dataclasses.replace(config, sim=dataclasses.replace(config.sim, base="planar"))
    flat_model = build_scene(planar, visual=False)
    flat, flat_vel = start_state(planar, flat_model)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    roll, pitch, yaw = free_base.attitude(qpos)
    assert (float(roll), float(yaw)) == (0.0, 0.0)
    assert float(pitch) == pytest.approx(-flat[2], abs=1e-12)
    np.testing.assert_array_equal(data.body("trunk").xpos, [flat[0], 0.0, flat[1]])
    np.testing.assert_array_equal(qvel[[0, 2, 4]], flat_vel[:3])
    feet = [data.geom(f"{leg}_foot").xpos[2] for leg in ("FR", "FL", "RR", "RL")]
    # The lower pair stands on the ground, as on the planar base.
    assert min(feet) == pytest.approx(go1.FOOT_RADIUS, abs=0.002)
    with pytest.raises(ValueError, match="nq 15"):
        start_state(config, build_scene(RunConfig(sim=SimConfig(base="planar")), visual=False))


def test_the_attitude_is_mujocos(model):
    for seed in range(5):
        data = moved(model, seed)
        R = data.body("trunk").xmat.reshape(3, 3)
        roll, pitch, yaw = free_base.attitude(data.qpos)
        # Roll, then pitch about the old y, then yaw: Rz Ry Rx.
        quat, again = np.zeros(4), np.zeros(9)
        mujoco.mju_euler2Quat(quat, np.array([yaw, -pitch, roll]), "zyx")
        mujoco.mju_quat2Mat(again, quat)
        np.testing.assert_allclose(again.reshape(3, 3), R, atol=1e-12)
    assert free_base.attitude(np.array([[1.0, 0.3, -0.2] + [0.0] * 12]))[1] == [0.2]


def test_the_sole_slides_at_mujocos_speed_of_that_point(model):
    for seed in range(3):
        data = moved(model, seed)
        ours = free_base.sliding_speed(
            go1.PARAMS,
            data.qpos[None, 3:7],
            data.qvel[None, :6],
            data.qpos[None, 7:].reshape(1, 4, 3),
            data.qvel[None, 6:].reshape(1, 4, 3),
        )[0]
        for leg, name in enumerate(("FR", "FL", "RR", "RL")):
            sole = data.geom(f"{name}_foot").xpos - [0.0, 0.0, go1.FOOT_RADIUS]
            J = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, J, None, sole, model.body(f"{name}_calf").id)
            assert ours[leg] == pytest.approx(np.hypot(*(J @ data.qvel)[:2]), abs=1e-12)


def test_noise_of_the_trunk_is_three_dimensional(model):
    observe, add = jax.jit(build_observe(go1.ROBOT, model, 5.0)), jax.jit(add_noise)
    data = moved(model, 0)
    clean = jax.tree.map(np.asarray, observe(data.qpos, data.qvel, data.sensordata))
    same = add(clean, np.zeros(FREE_NOISE_DIM))
    for a, b in zip(clean, same, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-15)
    noisy = jax.tree.map(np.asarray, add(clean, np.arange(1, FREE_NOISE_DIM + 1) * 1e-3))
    np.testing.assert_allclose(noisy.base_pos - clean.base_pos, [1e-3, 31e-3, 2e-3], atol=1e-12)
    np.testing.assert_allclose(noisy.base_vel - clean.base_vel, [4e-3, 34e-3, 5e-3], atol=1e-12)
    rates = noisy.base_ang_vel - clean.base_ang_vel
    np.testing.assert_allclose(rates, [35e-3, -6e-3, 36e-3], atol=1e-12)
    angle, back = np.zeros(3), np.zeros(4)
    mujoco.mju_negQuat(back, np.asarray(clean.base_quat))
    mujoco.mju_mulQuat(back, back, np.asarray(noisy.base_quat))
    mujoco.mju_quat2Vel(angle, back, 1.0)
    # A first-order turn by 46 mrad is right to its cube over 12.
    np.testing.assert_allclose(angle, [32e-3, -3e-3, 33e-3], atol=1e-5)
    assert np.linalg.norm(noisy.base_quat) == pytest.approx(1.0, abs=1e-12)


def test_the_sagittal_noise_is_the_planar_robot_s(config):
    planar = dataclasses.replace(config, sim=dataclasses.replace(config.sim, base="planar"))
    (_, params), (_, flat) = resolve_scene(config), resolve_scene(planar)
    noise = sensor_noise(params, "free", 2000)
    assert noise.shape == (2000, FREE_NOISE_DIM)
    np.testing.assert_array_equal(noise[:, :30], sensor_noise(flat, "planar", 2000))
    scale = [0.001, 0.003, 0.003, 0.02, 0.05, 0.05]
    # 6 %: four standard errors of a standard deviation of 2000 samples
    np.testing.assert_allclose(noise[:, 30:].std(axis=0), scale, rtol=0.06)
    assert np.abs(np.corrcoef(noise.T) - np.eye(FREE_NOISE_DIM)).max() < 0.1


def test_metrics_measure_yaw_and_drift_from_the_first_heading():
    steps, first = 3, 3.0  # rad; the yaw passes pi
    qpos = np.zeros((steps, 19))
    for i, (roll, yaw) in enumerate(((0.0, 0.0), (0.02, 0.2), (-0.1, -0.1))):
        mujoco.mju_euler2Quat(qpos[i, 3:7], np.array([first + yaw, 0.0, roll]), "zyx")
    ahead, left = (
        np.array([np.cos(first), np.sin(first)]),
        np.array([-np.sin(first), np.cos(first)]),
    )
    qpos[:, :2] = [np.zeros(2), ahead + 0.3 * left, 2 * ahead - 0.1 * left]
    qpos[:, :2] += [5.0, -3.0]
    qvel, rotation = np.zeros((steps, 18)), np.zeros(9)
    for i, yaw in enumerate((0.0, 0.2, -0.1)):
        c, s = np.cos(first + yaw), np.sin(first + yaw)
        qvel[i, :2] = 0.5 * np.array([c, s]) + 0.2 * np.array([-s, c])
        mujoco.mju_quat2Mat(rotation, qpos[i, 3:7])
        qvel[i, 3:6] = rotation.reshape(3, 3).T @ [0.1, -0.2, 0.7]  # in the trunk's axes
    wanted = np.tile([0.1, 0.4], (steps, 1))
    result = free_base.metrics(qpos, qvel, wanted, np.ones(steps, bool))
    assert result["velocity_y_rmse_mps"] == pytest.approx(0.1)
    assert result["yaw_rate_rmse_radps"] == pytest.approx(0.3)
    assert result["roll_p95_deg"] == pytest.approx(np.degrees(0.02 + 0.9 * 0.08))
    assert result["roll_max_deg"] == pytest.approx(np.degrees(0.1))
    assert result["yaw_max_deg"] == pytest.approx(np.degrees(0.2))
    assert result["lateral_drift_m"] == pytest.approx(0.3)
    planar = np.zeros((steps, 15))
    assert free_base.metrics(planar, planar, wanted, np.ones(steps, bool)) == {}


def test_a_path_is_compared_with_the_command_at_its_rates():
    goal = resolve_goal(
        load_config(
            RunConfig, None,
            {
                "controller": "spatial", "sim.base": "free",
                "command.times": [0.0, 1.0, 2.0], "command.v_x": [0.0, 0.5, 0.5],
                "command.yaw_rate": [0.0, 0.0, 0.8],
                "lmpc.command_slew": 2.0, "spatial.yaw_slew": 4.0,
            },
        )
    )  # fmt: skip
    time = np.arange(0.0, 4.0, 0.001)
    wanted = reference_velocity(time, goal)
    speed = np.interp(time, [1.0, 1.25], [0.0, 0.5])
    np.testing.assert_allclose(wanted[:, 0], speed, atol=1e-9)
    assert not wanted[:, 1].any()
    turning = np.interp(time, [2.0, 2.2], [0.0, 0.8])
    np.testing.assert_allclose(wanted[:, 2], turning, atol=1e-9)
    qpos, first = np.zeros((len(time), 19)), 2.0
    heading = first + np.append(0.0, np.cumsum(turning[:-1])) * 0.001
    late = 0.1 * (time > 3.0)  # rad, and it is 30 mm to the left of where it should be
    for row, yaw in zip(qpos, heading + late, strict=True):
        mujoco.mju_euler2Quat(row[3:7], np.array([yaw, 0.0, 0.0]), "zyx")
    steps = 0.001 * speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    qpos[1:, :2] = np.cumsum(steps, axis=0)[:-1]
    qpos[-1, :2] += 0.03 * np.array([-np.sin(heading[-1]), np.cos(heading[-1])])
    result = free_base.path_errors(qpos, wanted, 0.001)
    assert result["path_error_max_m"] == pytest.approx(0.03, abs=1e-9)
    assert result["heading_error_max_deg"] == pytest.approx(np.degrees(0.1), abs=1e-6)
    assert free_base.path_errors(np.zeros((3, 15)), wanted[:3], 0.001) == {}


@pytest.fixture(scope="module")
def shoved(simulation, episode):
    """A trot that gets 0.3 m/s to the left at 0.4 s."""

    def push(done, total, data):
        if done == 400:
            data.qvel[1] += 0.3

    return simulate(simulation, episode, on_tick=push)


def test_it_trots_at_the_commanded_speed_and_takes_a_shove(shoved, episode):
    result = metrics(shoved, episode.goal)
    assert not result["fell"]
    assert result["qp_unsolved"] == 0
    assert np.mean(shoved.x[-500:, 3]) == pytest.approx(0.2, abs=0.03)
    sideways = shoved.qvel[:, 1]
    assert sideways[405:420].max() > 0.25
    # Half of it is left after 12.7 kg / (30 N s/m) ln 2 = 0.3 s by the regulator alone.
    assert abs(sideways[-300:].mean()) < 0.05
    roll, pitch, yaw = (np.degrees(a) for a in free_base.attitude(shoved.qpos))
    assert 1.0 < np.abs(roll).max() < 12.0
    assert np.abs(roll[-200:]).max() < 4.0
    assert np.abs(yaw).max() < 10.0
    assert np.abs(pitch).max() < 5.0


def test_its_feet_plant_and_contacts_follow_the_schedule(shoved, config):
    late = shoved.time > 0.3
    agreement = (shoved.foot_force[late] > 5.0) == shoved.stance[late]
    # touchdown is a few ms early or late in each phase of 250 ms; the shove costs some more
    assert agreement.mean() > 0.93
    assert 0.0 < foot_slip(shoved, go1.ROBOT, 5.0) < 0.01


def test_the_same_drag_is_the_same_slip_on_both_bases():
    """A foot dragged straight ahead, legs still: its path."""
    steps = 101
    run = {f.name: np.zeros(0) for f in dataclasses.fields(Trajectory)}
    force, stance = np.zeros((steps, 4)), np.zeros((steps, 4), bool)
    force[:, 0], stance[:, 0] = 50.0, True
    run |= {"foot_force": force, "stance": stance}
    qpos, qvel = np.zeros((steps, 19)), np.zeros((steps, 18))
    qpos[:, 3], qvel[:, 0] = 1.0, 0.1
    assert foot_slip(
        Trajectory(**run | {"dt": 1e-3, "qpos": qpos, "qvel": qvel}), go1.ROBOT, 5.0
    ) == pytest.approx(0.01, abs=1e-12)


@pytest.mark.slow
def test_three_tenths_of_a_second_on_mjx_agree_with_c():
    box = {"lmpc.friction": np.inf, "lmpc.torque_fraction": np.inf}
    walk = {"command.times": [0.0, 0.1], "command.v_x": [0.0, 0.2]}
    keys = FREE | box | walk | {"duration": TICKS * PER_TICK * 1e-3}
    short = load_config(RunConfig, None, keys)
    episode = resolve_episode(short)
    device = mjx_engine.MjxEngine(batch_spec(short), dtype=np.float64)
    on_mjx = device.run(resolve_episodes([short])).trajectory(0)
    same = MujocoEngine(episode.spec)
    same.model = device.model
    in_c = simulate(same, episode)
    assert (on_mjx.plan_status == 0).all()
    # 1e-7: equal algorithms in double precision; contacts amplify the order of sums.
    np.testing.assert_allclose(on_mjx.qpos, in_c.qpos[::PER_TICK], atol=1e-7)
    np.testing.assert_allclose(on_mjx.torque, in_c.torque[::PER_TICK], atol=1e-3)
