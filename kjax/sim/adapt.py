"""Make a robot's own MJCF fit for kjax's scenes: base, motors, touch sensors are the scene's.

Masses, shapes, joint dampings, armatures, friction losses and contact settings stay as they are,
but for two: the feet's friction is that of ``sim.friction``, in all directions, and what touched
something touches the scene's ground and obstacles.
"""

import mujoco
import numpy as np

from kjax.robots.robot import Robot
from kjax.sim.robot_structure import find_structure

_FREE = mujoco.mjtJoint.mjJNT_FREE
_WORLD = 1  # contype of the ground and the obstacles
_WIDER = 1.3  # radius of a touch sensor's site over its foot's


def adapt(robot: Robot, spec: mujoco.MjSpec) -> None:
    """Change the MjSpec of a robot that was read, in place.

    Taken out: what is not the robot, its free joint, actuators, sensors, keyframes, and joints that
    are no leg's, which stay at their zero. Put in: a motor for each joint of a leg, one newton
    metre per unit, and a touch sensor for each foot.
    """
    _name_feet(robot, spec)
    own = {name for leg in robot.joints for name in leg}
    for joint in list(spec.joints):
        if joint.type == _FREE or joint.name not in own:
            spec.delete(joint)
    for group in (spec.actuators, spec.sensors, spec.keys, spec.equalities, spec.tendons):
        for one in list(group):
            spec.delete(one)
    trunk = spec.body(robot.trunk)
    world = spec.worldbody
    for one in [*world.geoms, *world.lights, *world.cameras, *world.sites]:
        spec.delete(one)
    for body in list(world.bodies):
        if body.name != robot.trunk:
            spec.delete(body)
    trunk.pos, trunk.quat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    for geom in spec.geoms:
        if (geom.contype or geom.conaffinity) and not geom.conaffinity & _WORLD:
            geom.contype, geom.conaffinity = 0, _WORLD
    for name, touch in zip(robot.feet, robot.touch, strict=True):
        foot = spec.geom(name)
        foot.priority, foot.condim = max(foot.priority, 1), max(foot.condim, 3)
        foot.parent.add_site(
            name=touch, type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=foot.pos,
            size=[_WIDER * foot.size[0], 0.0, 0.0], group=4,
        )  # fmt: skip
        spec.add_sensor(
            name=touch, type=mujoco.mjtSensor.mjSENS_TOUCH, objname=touch,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
        )  # fmt: skip
    limits = np.asarray(robot.params.torque_limit)
    for joints, motors in zip(robot.joints, robot.motors, strict=True):
        for joint, motor, limit in zip(joints, motors, limits, strict=True):
            actuator = spec.add_actuator(
                name=motor, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT,
                ctrllimited=1, ctrlrange=[-limit, limit],
            )  # fmt: skip
            actuator.set_to_motor()


def _name_feet(robot: Robot, spec: mujoco.MjSpec) -> None:
    """Give the feet's geoms the names that the record says, where the MJCF has none."""
    if all(spec.geom(name) is not None for name in robot.feet):
        return
    found = find_structure(spec.compile(), robot.trunk)
    for index, name in zip(found.feet, robot.feet, strict=True):
        next(geom for geom in spec.geoms if geom.id == index).name = name
