"""The Go1 with rear knees that point ahead, as ANYmal's do; for tests."""

from pathlib import Path

import mujoco

from kjax.robots import Robot, go1


def _spec():
    spec = mujoco.MjSpec.from_file(str(Path(str(go1.MJCF))))
    for joint in spec.joints:
        if joint.name[0] == "R" and joint.name.endswith(("thigh", "calf")):
            low, high = joint.range
            joint.range = [-high, -low]
    return spec


ROBOT = Robot.from_mjcf(_spec(), name="mirrored_robot:ROBOT")
