import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from kjax.config import NoiseConfig, RunConfig, SimConfig
from kjax.legs.kinematics import planar_state
from kjax.legs.posture import stand_pose
from kjax.robots import go1
from kjax.sim.noise import NOISE_DIM, add_noise
from kjax.sim.observe import build_observe, find_addresses
from kjax.sim.resolve import build_scene, noise_scale, resolve_scene
from kjax.sim.scene import build_spec
from kjax.types import JOINT_NAMES, Leg


@pytest.fixture(scope="module")
def model():
    return build_scene(RunConfig(sim=SimConfig(base="planar")))


@pytest.fixture(scope="module")
def data(model):
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    height, joints = stand_pose(go1.PARAMS, 0.27)
    data.qpos[1], data.qpos[3:] = height, joints.reshape(-1)
    free = find_addresses(go1.ROBOT, model).qpos[:, 1:].reshape(-1)
    data.qpos[free] += 0.2 * rng.standard_normal(8)
    data.qpos[:3] += 0.2 * rng.standard_normal(3)
    data.qvel[:3] = rng.standard_normal(3)
    data.qvel[free] = rng.standard_normal(8)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    return data


def observed(model, data):
    return build_observe(go1.ROBOT, model, 5.0)(
        jnp.asarray(data.qpos), jnp.asarray(data.qvel), jnp.asarray(data.sensordata)
    )


def test_mujocos_nose_down_hinge_becomes_nose_up_pitch(model, data):
    x = planar_state(go1.PARAMS, observed(model, data)).x
    nose = data.body("trunk").xmat.reshape(3, 3) @ np.array([1.0, 0.0, 0.0])
    assert float(x[2]) == pytest.approx(np.arctan2(nose[2], nose[0]), abs=1e-12)
    assert float(x[2]) == pytest.approx(-data.qpos[2], abs=1e-12)
    assert float(x[5]) == pytest.approx(-data.qvel[2], abs=1e-12)


def test_the_srb_state_is_mujocos_whole_body_centre_of_mass(model, data):
    x = np.asarray(planar_state(go1.PARAMS, observed(model, data)).x)
    trunk = model.body("trunk").id
    # 1e-12: the same closed form, up to rounding
    np.testing.assert_allclose(x[:2], data.subtree_com[trunk, ::2], atol=1e-12)
    np.testing.assert_allclose(x[3:5], data.subtree_linvel[trunk, ::2], atol=1e-12)


def test_feet_are_where_mujoco_has_them(model, data):
    feet = np.asarray(planar_state(go1.PARAMS, observed(model, data)).feet)
    for leg in Leg:
        np.testing.assert_allclose(feet[leg], data.geom(f"{leg.name}_foot").xpos[::2], atol=1e-12)


def test_joints_are_found_by_name_whatever_the_order_of_the_legs(model, data):
    observation = observed(model, data)
    for leg in Leg:
        for j, joint in enumerate(JOINT_NAMES):
            name = f"{leg.name}_{joint}"
            assert float(observation.joint_pos[leg, j]) == data.joint(name).qpos[0]
            assert float(observation.joint_vel[leg, j]) == data.joint(name).qvel[0]
            assert model.actuator(find_addresses(go1.ROBOT, model).actuator[leg, j]).name == name


def test_a_model_without_a_leg_is_refused_by_name():
    spec = build_spec(go1.ROBOT, resolve_scene(RunConfig())[0])
    spec.joint("FL_calf").name = "something"
    spec.actuator("FL_calf").target = "something"
    with pytest.raises(ValueError, match="FL_calf"):
        find_addresses(go1.ROBOT, spec.compile())


def test_contact_follows_the_force_threshold(model, data):
    observe = build_observe(go1.ROBOT, model, 5.0)
    forces = jnp.array([4.9, 5.1, 0.0, 80.0])
    contact = observe(jnp.asarray(data.qpos), jnp.asarray(data.qvel), forces).contact
    assert contact.tolist() == [False, True, False, True]


def test_no_noise_changes_nothing_and_noise_lands_where_it_should(model, data):
    clean = observed(model, data)
    same = add_noise(clean, jnp.zeros(NOISE_DIM))
    for a, b in zip(clean, same, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-15)
    noisy = add_noise(clean, jnp.arange(1, NOISE_DIM + 1) * 1e-3)
    before, after = (planar_state(go1.PARAMS, o) for o in (clean, noisy))
    np.testing.assert_allclose(after.base - before.base, [1e-3, 2e-3], atol=1e-12)
    # a first-order turn by 3 mrad is right to its cube
    assert float(after.x[2] - before.x[2]) == pytest.approx(3e-3, abs=1e-8)
    np.testing.assert_allclose(after.base_vel - before.base_vel, [4e-3, 5e-3], atol=1e-12)
    assert float(after.omega - before.omega) == pytest.approx(6e-3, abs=1e-12)
    np.testing.assert_allclose(
        (noisy.joint_pos - clean.joint_pos).reshape(-1), np.arange(7, 19) * 1e-3, atol=1e-12
    )


def test_noise_scale_follows_the_config():
    assert (noise_scale(NoiseConfig(enabled=False), "planar") == 0.0).all()
    scale = noise_scale(NoiseConfig(), "planar")
    assert scale.shape == (NOISE_DIM,)
    assert scale[2] == NoiseConfig().pitch


def test_the_same_mjcf_gives_a_free_base_with_the_same_robot():
    free = build_scene(RunConfig(sim=SimConfig(base="free")))
    planar = build_scene(RunConfig(sim=SimConfig(base="planar")))
    assert (free.nq, free.nv, free.nu) == (19, 18, 12)
    assert (planar.nq, planar.nv, planar.nu) == (15, 15, 12)
    np.testing.assert_array_equal(free.body_mass, planar.body_mass)
    np.testing.assert_array_equal(free.body_inertia, planar.body_inertia)


def test_both_bases_show_the_controller_the_same_robot(model, data):
    free_model = build_scene(RunConfig(sim=SimConfig(base="free")))
    free = mujoco.MjData(free_model)
    half = 0.5 * data.qpos[2]
    free.qpos[:7] = [data.qpos[0], 0, data.qpos[1], np.cos(half), 0, np.sin(half), 0]
    free.qvel[:6] = [data.qvel[0], 0, data.qvel[1], 0, data.qvel[2], 0]
    free.qpos[7:], free.qvel[6:] = data.qpos[3:], data.qvel[3:]
    mujoco.mj_forward(free_model, free)
    ours, theirs = observed(model, data), observed(free_model, free)
    for a, b in zip(ours[:-1], theirs[:-1], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_feet_only_contacts_leave_the_feet_and_nothing_else():
    model = build_scene(RunConfig(sim=SimConfig(contacts="feet")))
    solid = [model.geom(i).name for i in range(model.ngeom) if model.geom_conaffinity[i]]
    assert sorted(solid) == ["FL_foot", "FR_foot", "RL_foot", "RR_foot"]
