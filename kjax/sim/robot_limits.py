"""What the joints of a robot can: which way knees bend, ranges, torques, inertias."""

from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from kjax.sim.robot_structure import Structure

FOLDED = (1.0, 0.7)  # of the nominal height: standing, and a leg at the apex of its swing
BOTH = 1.0  # rad to each side: a calf that may bend both ways
KNEE = 0.1  # rad, that a knee which points ahead is bent by at least
MARGIN = 0.015  # rad, that joints keep from their mechanical ends
FREE_RANGE = ((-0.8, 0.8), (-1.5, 3.5), (-2.7, -0.5))  # rad, of joints without limits


def knees(
    model: mujoco.MjModel,
    found: Structure,
    sign: np.ndarray,
    angles: np.ndarray,
    posed: dict[str, float],
) -> np.ndarray:
    """1 for knees that point back, -1 for those that point ahead (4,).

    The range of the calf's angle tells; where it allows both, the first keyframe, or the model's
    zero configuration. A leg that is straight there has its knee back.

    Args:
      model: with the legs.
      found: in it.
      sign: (4, 3) of the joints.
      angles: (4, 3) where the model's are 0, were the knees to point back [rad].
      posed: angles of joints in a keyframe, by name [rad].
    """
    out = np.ones(4)
    for leg, joint in enumerate(found.joints[:, 2]):
        at_zero = model.qpos0[model.jnt_qposadr[joint]]

        def ours(value: float, leg: int = leg, at_zero: float = at_zero) -> float:
            return float(angles[leg, 2] + sign[leg, 2] * (value - at_zero))

        low, high = sorted(ours(end) for end in model.jnt_range[joint])
        if model.jnt_limited[joint] and low < high and not low < -BOTH < BOTH < high:
            bend = 0.5 * (low + high)
        else:
            bend = ours(posed.get(model.joint(int(joint)).name, at_zero))
        bend = (bend + np.pi) % (2 * np.pi) - np.pi
        out[leg] = -1.0 if bend > KNEE else 1.0
    return out


def joint_ranges(
    model: mujoco.MjModel, found: Structure, sign: np.ndarray, zero: np.ndarray
) -> np.ndarray:
    """Angles (3, 2) that all legs reach, ours, a margin inside their interval."""
    out, known = np.array(FREE_RANGE), np.zeros(3, bool)
    for kind in range(3):
        for leg, joint in enumerate(found.joints[:, kind]):
            low, high = model.jnt_range[joint]
            if not model.jnt_limited[joint] or high <= low:
                continue
            interval = np.sort(sign[leg, kind] * (np.array([low, high]) - zero[leg, kind]))
            both = kind == 2 and interval[0] < -BOTH < BOTH < interval[1]
            if both or np.ptp(interval) > 2 * np.pi:
                continue  # it bends both ways, or turns all round
            # A turn more or less is the same angle.
            interval -= 2 * np.pi * np.round(interval.mean() / (2 * np.pi))
            interval += [MARGIN, -MARGIN]
            if known[kind]:
                low, high = out[kind]
                interval = np.array([max(interval[0], low), min(interval[1], high)])
            out[kind], known[kind] = interval, True
    if out[2, 0] > 0 or out[2, 1] > 0.3 or out[2, 0] > -1.0:
        raise ValueError(
            f"the calf joints bend from {out[2, 0]:.2f} to {out[2, 1]:.2f} rad from the straight "
            "leg, wanted knees that bend to one side by more than 1 rad"
        )
    if (out[:, 0] >= out[:, 1]).any():
        raise ValueError(f"the legs' joint ranges have nothing in common: {out.tolist()}")
    return out


def torque_limits(
    model: mujoco.MjModel, found: Structure, given: Sequence[float] | None
) -> np.ndarray:
    """Least of what motors, servos and joints of all legs allow (3,) [N m]."""
    if given is not None:
        limit = np.asarray(given, float)
        if limit.shape != (3,) or not (limit > 0).all():
            raise ValueError(
                f"torque_limit must be three positive values (abduction, thigh, calf), got {given}"
            )
        return limit
    limits = np.full(model.njnt, np.inf)
    for joint in range(model.njnt):
        if model.jnt_actfrclimited[joint]:
            limits[joint] = np.abs(model.jnt_actfrcrange[joint]).min()
    for motor in range(model.nu):
        if model.actuator_trntype[motor] != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        joint, gear = model.actuator_trnid[motor, 0], abs(model.actuator_gear[motor, 0])
        most = np.inf
        if model.actuator_forcelimited[motor]:
            most = np.abs(model.actuator_forcerange[motor]).min() * gear
        is_motor = not model.actuator_biasprm[motor, :3].any()
        if is_motor and model.actuator_ctrllimited[motor]:
            gain = abs(model.actuator_gainprm[motor, 0])
            most = min(most, np.abs(model.actuator_ctrlrange[motor]).min() * gain * gear)
        limits[joint] = min(limits[joint], most)
    limit = limits[found.joints].min(axis=0)
    if not np.isfinite(limit).all():
        raise ValueError("the model limits no torques: torque_limit=(abduction, thigh, calf) [N m]")
    return limit


def joint_inertia(
    model: mujoco.MjModel,
    found: Structure,
    poses: Callable[[float], np.ndarray],
    height: float,
) -> np.ndarray:
    """Least inertia (3,) that a torque meets, legs stretched to folded, trunk free [kg m^2].

    Args:
      model: whose trunk moves freely.
      found: in it.
      poses: positions (nq,) that stand at a height [m].
      height: of the nominal stance [m].
    """
    data, least = mujoco.MjData(model), np.full(3, np.inf)
    own = model.jnt_dofadr[found.joints]
    for share in FOLDED:
        try:
            data.qpos[:] = poses(share * height)
        except ValueError:
            continue  # the knees do not bend so far
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        least = np.minimum(least, (1.0 / np.diag(np.linalg.inv(full))[own]).min(axis=0))
    return least
