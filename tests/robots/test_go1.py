"""Every constant of the Go1 against the compiled MJCF, and the nominal stance."""

import re

import mujoco
import numpy as np
import pytest

from kjax.config import LmpcConfig, SrbConfig
from kjax.controllers.rigid_body import own_body
from kjax.legs.posture import stand_pose
from kjax.robots import go1
from kjax.types import GRAVITY, JOINT_NAMES, Leg

LINKS = ("hip", "thigh", "calf")


@pytest.fixture(scope="module")
def model():
    """The MJCF alone: its trunk is welded to the world."""
    return mujoco.MjModel.from_xml_string(go1.MJCF.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def standing(planar_go1, leg_joints):
    """MuJoCo in ``stand_pose(0.27)``."""
    data = mujoco.MjData(planar_go1)
    height, joint_pos = stand_pose(go1.PARAMS, 0.27)
    data.joint("root_z").qpos = height
    data.qpos[planar_go1.jnt_qposadr[leg_joints]] = joint_pos
    mujoco.mj_forward(planar_go1, data)
    return data


def test_masses_are_those_of_the_model(model):
    assert model.body("trunk").mass[0] == go1.PARAMS.trunk_mass
    for leg in Leg:
        masses = [model.body(f"{leg.name}_{link}").mass[0] for link in LINKS]
        np.testing.assert_array_equal(masses, go1.PARAMS.link_mass)
    # Rounding of a sum of 13 masses.
    np.testing.assert_allclose(go1.PARAMS.mass, model.body_mass.sum(), rtol=1e-15)


def test_centres_of_mass_are_those_of_the_model(model):
    np.testing.assert_array_equal(model.body("trunk").ipos, go1.PARAMS.trunk_com)
    for leg in Leg:
        for i, link in enumerate(LINKS):
            wanted = model.body(f"{leg.name}_{link}").ipos
            np.testing.assert_array_equal(go1.PARAMS.link_com[leg, i], wanted)


def test_hips_offsets_and_link_lengths_are_those_of_the_model(model):
    for leg in Leg:
        np.testing.assert_array_equal(model.body(f"{leg.name}_hip").pos, go1.PARAMS.hip_pos[leg])
        thigh = model.body(f"{leg.name}_thigh").pos
        np.testing.assert_array_equal(thigh, [0.0, go1.PARAMS.abduction_offset[leg], 0.0])
        calf = model.body(f"{leg.name}_calf").pos
        np.testing.assert_array_equal(calf, [0.0, 0.0, -go1.PARAMS.thigh_length])
        foot = model.geom(f"{leg.name}_foot")
        np.testing.assert_array_equal(foot.pos, [0.0, 0.0, -go1.PARAMS.calf_length])
        assert foot.bodyid[0] == model.body(f"{leg.name}_calf").id
        assert foot.size[0] == go1.PARAMS.foot_radius
        assert foot.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
        np.testing.assert_array_equal(model.site(f"{leg.name}_foot").pos, foot.pos)


def test_legs_are_named_by_where_they_are(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for leg in Leg:
        x, y, _ = data.geom(f"{leg.name}_foot").xpos
        assert (x > 0) == (leg.name[0] == "F")
        assert (y > 0) == (leg.name[1] == "L")


def test_torque_limits_and_motors_are_those_of_the_model(model):
    for leg in Leg:
        for joint, limit in zip(JOINT_NAMES, go1.PARAMS.torque_limit, strict=True):
            motor = model.actuator(f"{leg.name}_{joint}")
            np.testing.assert_array_equal(motor.ctrlrange, [-limit, limit])
            assert motor.trnid[0] == model.joint(f"{leg.name}_{joint}").id
            # A plain motor: one newton metre per unit of control.
            np.testing.assert_array_equal(motor.gear, [1, 0, 0, 0, 0, 0])
            assert motor.gainprm[0] == 1.0
            np.testing.assert_array_equal(motor.biasprm, 0.0)
    assert model.nu == 12


def test_joints_turn_about_the_axes_that_the_kinematics_assume(model):
    axes = {"abduction": [1, 0, 0], "thigh": [0, 1, 0], "calf": [0, 1, 0]}
    for leg in Leg:
        for joint in JOINT_NAMES:
            np.testing.assert_array_equal(model.joint(f"{leg.name}_{joint}").axis, axes[joint])


def test_joint_ranges_stay_inside_the_models(model):
    for leg in Leg:
        for joint, (low, high) in zip(JOINT_NAMES, go1.PARAMS.joint_range, strict=True):
            least, most = model.joint(f"{leg.name}_{joint}").range
            # Within the mechanical limits, by a small margin.
            assert least < low < least + 0.025
            assert most - 0.025 < high < most


def test_link_inertias_are_those_of_the_model(model):
    """About the pitch axis, with the leg's frame for the link's: the inertial axes are tilted."""
    for leg in Leg:
        for link, own in zip(("thigh", "calf"), go1.PARAMS.link_inertia, strict=True):
            body = model.body(f"{leg.name}_{link}")
            R = np.zeros(9)
            mujoco.mju_quat2Mat(R, body.iquat)
            R = R.reshape(3, 3)
            assert (R @ np.diag(body.inertia) @ R.T)[1, 1] == pytest.approx(own, rel=2e-3)


def test_the_composite_inertia_is_that_of_the_nominal_stance(planar_go1, standing):
    com = standing.subtree_com[planar_go1.body("trunk").id]
    total = np.zeros((3, 3))
    for i in range(1, planar_go1.nbody):
        R = standing.ximat[i].reshape(3, 3)
        arm = standing.xipos[i] - com
        total += R @ np.diag(planar_go1.body_inertia[i]) @ R.T
        total += planar_go1.body_mass[i] * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    # The constants are given to a mg m^2.
    np.testing.assert_allclose(go1.PARAMS.inertia, total, rtol=0, atol=1e-6)
    assert go1.PARAMS.pitch_inertia == go1.PARAMS.inertia[1, 1]


def test_standing_puts_the_feet_on_the_ground_below_the_hips(planar_go1, standing):
    for leg in Leg:
        foot = standing.geom(f"{leg.name}_foot").xpos
        hip = standing.body(f"{leg.name}_thigh").xpos
        # The pose is solved to 1e-12 m.
        np.testing.assert_allclose(foot[:2], hip[:2], rtol=0, atol=1e-12)
        np.testing.assert_allclose(foot[2], go1.FOOT_RADIUS, rtol=0, atol=1e-11)


@pytest.mark.parametrize("height", [0.13, 0.2, 0.27, 0.32, 0.37])
def test_standing_has_the_centre_of_mass_at_the_height_asked_for(planar_go1, leg_joints, height):
    data = mujoco.MjData(planar_go1)
    trunk_height, joint_pos = stand_pose(go1.PARAMS, height)
    data.joint("root_z").qpos = trunk_height
    data.qpos[planar_go1.jnt_qposadr[leg_joints]] = joint_pos
    mujoco.mj_forward(planar_go1, data)
    com = data.subtree_com[planar_go1.body("trunk").id, 2]
    np.testing.assert_allclose(com, height, rtol=0, atol=1e-11)  # the pose is solved to 1e-12 m
    foot = data.geom("FR_foot").xpos[2]
    np.testing.assert_allclose(foot, go1.FOOT_RADIUS, rtol=0, atol=1e-11)
    low, high = planar_go1.jnt_range[leg_joints[0]].T
    assert (low <= joint_pos).all()
    assert (joint_pos <= high).all()


@pytest.mark.parametrize("height", [-0.1, 0.0, 0.05, 0.42, 1.0, float("nan")])
def test_a_height_that_the_legs_cannot_reach_is_refused_by_name(height):
    with pytest.raises(ValueError, match="com_height"):
        stand_pose(go1.PARAMS, height)


def test_a_refused_height_is_told_the_range_that_works():
    with pytest.raises(ValueError, match="com_height") as refusal:
        stand_pose(go1.PARAMS, 1.0)
    low, high = (float(n) for n in re.findall(r"0\.\d+", str(refusal.value))[:2])
    # The message gives centimetres and says "about": half of one.
    stand_pose(go1.PARAMS, low + 0.005)
    stand_pose(go1.PARAMS, high - 0.005)


def test_the_default_rigid_body_is_the_go1():
    body = own_body(SrbConfig(), go1.PARAMS)
    assert body.mass == go1.PARAMS.mass
    assert body.inertia == go1.PARAMS.pitch_inertia
    own = own_body(SrbConfig(mass=9.0, feet_rear=(-0.2, -0.25)), go1.PARAMS)
    assert (own.mass, own.inertia) == (9.0, body.inertia)
    np.testing.assert_array_equal(own.feet, [body.feet[0], (-0.2, -0.25)])


def test_the_default_contact_points_lie_below_the_hips(planar_go1, standing):
    """The soles of MuJoCo's feet, seen from its centre of mass."""
    com = standing.subtree_com[planar_go1.body("trunk").id]
    body = own_body(SrbConfig(), go1.PARAMS)
    for point, leg in zip(body.feet, ("FR", "RR"), strict=True):
        sole = standing.geom(f"{leg}_foot").xpos - com - [0.0, 0.0, go1.FOOT_RADIUS]
        # The pose is solved to 1e-12 m.
        np.testing.assert_allclose(point, sole[[0, 2]], rtol=0, atol=1e-10)


def test_gravity_is_the_models(model):
    np.testing.assert_array_equal(model.opt.gravity, [0.0, 0.0, -GRAVITY])


def test_the_robot_can_stand_at_the_default_height_within_its_torque_limits():
    _, joints = stand_pose(go1.PARAMS, 0.426 * LmpcConfig().body_height)
    # Feet lie below the hips: the lever of a quarter of the weight is the knee's way back.
    knee = go1.PARAMS.mass * GRAVITY / 4 * go1.THIGH_LENGTH * np.sin(joints[0, 1])
    assert 0.0 < knee < 0.5 * go1.PARAMS.torque_limit[2]


def test_the_model_needs_no_mesh_or_texture_file(model):
    assert model.nmesh == 0
    assert model.ntex == 0
