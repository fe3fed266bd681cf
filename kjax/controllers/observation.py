"""What of an observation can be believed: inside ``jit`` as a flag, at the edge as an error.

``is_valid`` is traced and looks for values that no walking robot produces. ``check_observation``
is for the host and for the first sample, of a robot that stands: a convention that differs from
ours shows there, in feet that are not under their hips or joints that bend the other way.
"""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from kjax.legs import kinematics, spatial
from kjax.legs.posture import standing
from kjax.types import Leg, Observation, RobotParams

# Far beyond what a legged robot does and far below what overflows in float32: a number outside is
# a fault of the sensor or of the unit.
MAX_SPEED = 50.0  # m/s, of the trunk
MAX_TURN_RATE = 200.0  # rad/s, of the trunk
MAX_JOINT_ANGLE = 4.0 * np.pi  # rad
MAX_JOINT_RATE = 1000.0  # rad/s
# The length of the quaternion does not matter, but it must have a direction.
QUATERNION_NORM = (1e-3, 1e3)

SHAPES: dict[str, tuple[int, ...]] = {
    "base_pos": (3,),
    "base_quat": (4,),
    "base_vel": (3,),
    "base_ang_vel": (3,),
    "joint_pos": (4, 3),
    "joint_vel": (4, 3),
    "contact": (4,),
}

# Of the leg's length: a standing or lying robot's feet are nearer to the thigh along the ground,
# and a foot that is this much above another is surely higher.
_FOOT_FROM_HIP, _SMALL = 0.47, 0.07


def cast(observation: Observation, dtype: Any) -> Observation:
    """Observation with floats of ``dtype`` and bool contacts; a flag that is no number is off."""
    floats = Observation(*(jnp.asarray(leaf, dtype) for leaf in observation))
    return floats._replace(contact=(floats.contact != 0) & ~jnp.isnan(floats.contact))


def is_valid(observation: Observation) -> Bool[Array, ""]:
    """Whether every number is finite and one that a walking robot can have.

    The trunk's position is not looked at: the controller does not read it.
    """
    norm = jnp.sqrt(jnp.sum(observation.base_quat**2))
    low, high = QUATERNION_NORM

    def within(values: Array, limit: float) -> Array:
        return (jnp.abs(values) <= limit).all()  # not for NaN

    return (
        (norm >= low)
        & (norm <= high)
        & within(observation.base_vel, MAX_SPEED)
        & within(observation.base_ang_vel, MAX_TURN_RATE)
        & within(observation.joint_pos, MAX_JOINT_ANGLE)
        & within(observation.joint_vel, MAX_JOINT_RATE)
    )


def or_neutral(observation: Observation, valid: Bool[Array, ""]) -> Observation:
    """The observation, or a robot that stands still where it is not valid, so that no NaN spreads.

    The trunk's position is left at zero: the controller does not read it.
    """
    neutral = standing()._replace(contact=observation.contact)
    seen = observation._replace(base_pos=jnp.zeros_like(observation.base_pos))
    return jax.tree.map(
        lambda there, safe: jnp.where(valid, there, safe.astype(there.dtype)), seen, neutral
    )


def check_shapes(observation: Observation) -> None:
    """Raise a ValueError for a field of the wrong shape or type."""
    for name, wanted in SHAPES.items():
        try:
            value = np.asarray(getattr(observation, name))
        except Exception as error:
            raise ValueError(f"observation.{name}: got no array ({error})") from None
        if value.shape != wanted:
            hint = ": legs FR, FL, RR, RL by joints" if value.shape == (12,) else ""
            raise ValueError(f"observation.{name}: got shape {value.shape}, wanted {wanted}{hint}")
        if value.dtype.kind not in "fiub":
            raise ValueError(f"observation.{name}: got type {value.dtype}, wanted a numeric type")


def check_observation(robot: RobotParams, observation: Observation) -> None:
    """Look at the first sample, of a robot that stands or lies, on the host.

    Args:
      robot: geometry.
      observation: arrays that can be read, not inside ``jit``.

    Raises:
      ValueError: for a wrong shape or type, a number that is not finite or out of any robot's
        range, and for what follows from another convention than ours (units, order and signs of
        joints, order of the quaternion), with the likely cause.

    Warns:
      UserWarning: for a quaternion that reads as a heading of 180 degrees, and as no turn at all
        in the order (x, y, z, w).
    """
    check_shapes(observation)
    values = {name: np.asarray(getattr(observation, name), float) for name in SHAPES}
    for name, value in values.items():
        if not np.isfinite(value).all():
            raise ValueError(f"observation.{name}: got {value.tolist()}, wanted finite values")
    if not np.isin(values["contact"], (0, 1)).all():
        raise ValueError(
            f"observation.contact: got {values['contact'].tolist()}, wanted whether each foot "
            "touches; compare forces with a threshold"
        )
    quat, joints = values["base_quat"], values["joint_pos"]
    _check_quaternion(quat)
    _check_rates(values)
    _check_joints(robot, joints)
    with jax.ensure_compile_time_eval():  # also where the caller traces, with constants
        foot, rotation = jax.device_get(_standing_feet(robot, joints, quat))
        _check_feet(robot, foot, rotation, values["contact"] > 0)


def _check_quaternion(quat: np.ndarray) -> None:
    norm = float(np.linalg.norm(quat))
    if not 0.9 < norm < 1.1:
        raise ValueError(
            f"observation.base_quat: got {_short(quat)} of length {norm:.3g}, wanted a unit "
            "quaternion (w, x, y, z)"
        )
    w, x, y, z = quat / norm
    tilt = np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))
    other = np.degrees(np.arccos(np.clip(1.0 - 2.0 * (w * w + x * x), -1.0, 1.0)))
    if tilt > 60.0:
        cause = "is it in the order (x, y, z, w)?" if other < 30.0 else "does the robot lie on it?"
        raise ValueError(
            f"observation.base_quat: {_short(quat)} as (w, x, y, z) tilts the trunk by "
            f"{tilt:.0f} degrees; {cause}"
        )
    if abs(w) < 0.02 and abs(z) > 0.999:
        warnings.warn(
            f"observation.base_quat: {_short(quat)} as (w, x, y, z) is a heading of 180 degrees; "
            "if the robot does not face backwards, it is in the order (x, y, z, w)",
            stacklevel=4,
        )


def _check_rates(values: dict[str, np.ndarray]) -> None:
    for name, limit, unit in (
        ("base_vel", MAX_SPEED, "m/s"),
        ("base_ang_vel", MAX_TURN_RATE, "rad/s"),
        ("joint_vel", MAX_JOINT_RATE, "rad/s"),
    ):
        largest = np.abs(values[name]).max()
        if largest > limit:
            raise ValueError(
                f"observation.{name}: got {largest:.3g}, more than {limit:g} {unit}; is it in "
                "another unit?"
            )


def _check_joints(robot: RobotParams, joints: np.ndarray) -> None:
    largest = np.abs(joints).max()
    if largest > 2.0 * np.pi:
        raise ValueError(
            f"observation.joint_pos: got an angle of {largest:.4g}, wanted radians; is it in "
            "degrees?"
        )
    low, high = np.asarray(robot.joint_range)[2] + [-0.2, 0.2]
    calf = joints[:, 2]
    if (calf > 0).all() and ((-calf > low) & (-calf < high)).all():
        raise ValueError(
            f"observation.joint_pos: the calf angles are {_short(calf)}; ours are negative (knees "
            "point back): do the joints have the other sign?"
        )
    wrong = ~((calf > low) & (calf < high))
    if wrong.any():
        leg = Leg(int(np.argmax(wrong)))
        raise ValueError(
            f"observation.joint_pos: {leg.name}'s calf angle is {calf[leg]:.3g} rad, wanted "
            f"{low:.2f} to {high:.2f}; are the joints in the order abduction, thigh, calf, with 0 "
            "straight down?"
        )


@jax.jit
def _standing_feet(robot: RobotParams, joints: Array, quat: Array) -> tuple[Array, Array]:
    """Feet (4, 3) from their hips, trunk axes [m], and the trunk's rotation (3, 3)."""
    trig = kinematics.leg_trig(joints)
    return spatial.foot_position(robot, spatial.hip_trig(joints), trig), spatial.rotation_matrix(
        quat
    )


def _check_feet(
    robot: RobotParams, foot: np.ndarray, rotation: np.ndarray, contact: np.ndarray
) -> None:
    side = np.asarray(robot.abduction_offset)
    away = np.hypot(foot[:, 0], foot[:, 1] - side)
    length = float(robot.thigh_length + robot.calf_length)
    if away.max() > _FOOT_FROM_HIP * length:
        leg = Leg(int(np.argmax(away)))
        raise ValueError(
            f"observation.joint_pos: {leg.name}'s foot is {away[leg]:.2f} m beside its hip, wanted "
            "a robot that stands; do abduction or thigh have the other sign, or are joints or "
            "legs in another order (FR, FL, RR, RL by abduction, thigh, calf)?"
        )
    height = ((foot + np.asarray(robot.hip_pos)) @ rotation.T)[:, 2]
    if contact.any() and not contact.all():
        high, low = height[contact].max(), height[~contact].min()
        if high > low + _SMALL * length:
            flagged = Leg(int(np.flatnonzero(contact)[np.argmax(height[contact])]))
            raise ValueError(
                f"observation.contact: {flagged.name} is in contact {high - low:.2f} m above a "
                "foot that is not; are legs or flags in another order than FR, FL, RR, RL?"
            )


def _short(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"
