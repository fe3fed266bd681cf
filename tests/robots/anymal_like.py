"""A quadruped written as ANYmal C is in MuJoCo Menagerie: turned frames, hind knees ahead.

The places, frames, masses and limits of its links are that model's figures (anybotics_anymal_c); it
has no shapes but its feet, and inertias of its own.
"""

import mujoco

from kjax.robots import Robot

# Leg: place and frame of the hip, axis of its joints, range of the abduction, side of the thigh.
_LEGS = {
    "LF": ((0.2999, 0.104, 0.0), (0.258819, 0.965926, 0.0, 0.0), (1, 1), (-0.72, 0.49), -1),
    "RF": ((0.2999, -0.104, 0.0), (0.258819, -0.965926, 0.0, 0.0), (1, -1), (-0.49, 0.72), 1),
    "LH": ((-0.2999, 0.104, 0.0), (0.0, 0.0, 0.965926, -0.258819), (-1, 1), (-0.72, 0.49), 1),
    "RH": ((-0.2999, -0.104, 0.0), (0.0, 0.0, -0.965926, -0.258819), (-1, -1), (-0.49, 0.72), -1),
}
_THIGH = {
    "LF": (0.183013, -0.683013, 0.683013, 0.183013),
    "RF": (0.183013, 0.683013, 0.683013, -0.183013),
    "LH": (0.183013, 0.683013, 0.683013, -0.183013),
    "RH": (-0.183013, 0.683013, -0.683013, -0.183013),
}
# Bent as ANYmal stands: knees of the front legs back, of the hind legs ahead.
_STANDING = {"LF": (0.4, -0.8), "RF": (0.4, -0.8), "LH": (-0.4, 0.8), "RH": (-0.4, 0.8)}


def spec() -> mujoco.MjSpec:
    """The model, open to edits."""
    out = mujoco.MjSpec()
    out.compiler.degree = False
    base = out.worldbody.add_body(
        name="base", pos=[0, 0, 0.62], quat=[0, 0, 0, 1], mass=19.2035,
        ipos=[0.0025, 0, 0.0502071], inertia=[0.217374, 0.639559, 0.624031], explicitinertial=1,
    )  # fmt: skip
    base.add_freejoint()
    for leg, (place, frame, (roll, pitch), limits, side) in _LEGS.items():
        hip = base.add_body(
            name=f"{leg}_HIP", pos=place, quat=frame, mass=2.781, explicitinertial=1,
            ipos=[0.0567, 0.015294 * side, -0.008298], inertia=[0.005, 0.005, 0.004],
        )  # fmt: skip
        thigh = hip.add_body(
            name=f"{leg}_THIGH", pos=[0.0599, 0.0725816 * side, -0.041905], quat=_THIGH[leg],
            mass=3.071, explicitinertial=1, ipos=[0.0308147, 0, -0.245696],
            inertia=[0.030, 0.030, 0.004],
        )  # fmt: skip
        shank = thigh.add_body(
            name=f"{leg}_SHANK", pos=[0.1003, 0, -0.285], mass=0.58842, explicitinertial=1,
            ipos=[0.005462, 0.0612528 * side, -0.0806598], inertia=[0.010, 0.009, 0.002],
        )  # fmt: skip
        for body, name, axis, ends in (
            (hip, "HAA", roll, limits), (thigh, "HFE", pitch, (-9.42478, 9.42478)),
            (shank, "KFE", pitch, (-9.42478, 9.42478)),
        ):  # fmt: skip
            body.add_joint(
                name=f"{leg}_{name}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[axis, 0, 0],
                range=ends, limited=1, damping=[1.0, 0.0, 0.0], frictionloss=0.1,
            )  # fmt: skip
            servo = out.add_actuator(
                name=f"{leg}_{name}", target=f"{leg}_{name}", forcelimited=1,
                forcerange=[-80, 80], trntype=mujoco.mjtTrn.mjTRN_JOINT,
            )  # fmt: skip
            servo.set_to_position(kp=100.0)
        shank.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.03, 0, 0], mass=0.0,
            pos=[0.01305, 0.08795 * side, -0.31547 - 0.02325],
        )  # fmt: skip
    qpos = [0, 0, 0.62, 0, 0, 0, 1]
    for leg in _LEGS:
        qpos += [0.0, *_STANDING[leg]]
    out.add_key(name="standing", qpos=qpos)
    return out


ROBOT = Robot.from_mjcf(spec(), name="anymal_like:ROBOT")
