"""A ``Robot`` read from an MJCF: masses, lengths, signs and limits from the compiled model.

The legs' convention is that of ``kjax.legs.kinematics``. Each joint's sign and zero follow from
where its axis and its anchor lie in the trunk's axes, whatever frames the MJCF was written in.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from kjax.legs.posture import stand_pose
from kjax.robots.robot import JointNames, LegNames, Robot
from kjax.sim.robot_limits import joint_inertia, joint_ranges, knees, torque_limits
from kjax.sim.robot_structure import Structure, at_zero, branch, find_structure, find_trunk
from kjax.types import JOINT_NAMES, Leg, RobotParams

STAND = 0.27 / 0.426  # height of the centre of mass in the nominal stance, leg lengths
ALIKE = 0.02  # largest relative difference of legs' lengths and masses
STRAIGHT = 0.02  # rad, that joint axes may lie off the trunk's


class LegGeometry(NamedTuple):
    """One leg in the trunk's axes, in the model's zero configuration.

    Attributes:
      hip: (3,) on the abduction axis, beside the thigh joint [m].
      offset: from there to the foot's plane, left positive [m].
      lengths: (2,) of thigh and calf [m].
      angles: (3,) ours, were the knee to point back [rad].
      sign: (3,) 1 or -1, likewise [-].
    """

    hip: np.ndarray
    offset: float
    lengths: np.ndarray
    angles: np.ndarray
    sign: np.ndarray


def read_robot(
    source: str | Path | mujoco.MjSpec | mujoco.MjModel,
    *,
    name: str = "",
    trunk: str | None = None,
    feet: Sequence[str] | None = None,
    torque_limit: Sequence[float] | None = None,
    stand_height: float | None = None,
) -> Robot:
    """A robot from its MJCF or URDF.

    Legs, feet and trunk are found by structure. What else hangs on the trunk counts as a part of
    it. The scene brings base, motors and touch sensors of its own.

    Args:
      source: path of the MJCF or URDF, an MjSpec, or a compiled MjModel, of which the parameters
        are read: no scene can be built from it.
      name: as in ``robot = ...`` of a config; the path, or the model's name, where not given.
      trunk: name of the trunk's body, where it is not the one that moves freely.
      feet: names of the feet's geoms (FR, FL, RR, RL), where they are no spheres.
      torque_limit: of abduction, thigh and calf, where the model has none [N m].
      stand_height: of the centre of mass in the nominal stance; 0.634 leg lengths where not given
        [m].

    Raises:
      ValueError: in one sentence, for what the model lacks, or legs of another kind.
    """
    if isinstance(source, mujoco.MjModel):
        spec, called = None, name or "of an MjModel"
    else:
        spec = load_spec(source)
        called = name or (spec.modelname if isinstance(source, mujoco.MjSpec) else str(source))
    try:
        model, posed = _compiled(source, trunk) if spec is None else _free(spec, trunk)
        found = find_structure(model, trunk, feet)
        return _read(source, called, model, found, posed, torque_limit, stand_height)
    except ValueError as error:
        raise ValueError(f"robot '{called}': {error}") from None


def _free(spec: mujoco.MjSpec, trunk: str | None) -> tuple[mujoco.MjModel, dict[str, float]]:
    """The compiled model, its trunk on a free joint; and joints' angles in its first keyframe."""
    model = spec.compile()
    posed = _posed(model)
    body = model.body(find_trunk(model, trunk))
    if not body.name:
        raise ValueError("the trunk's body has no name in the MJCF")
    own = spec.body(body.name)
    for joint in list(own.joints):
        spec.delete(joint)
    for key in list(spec.keys):
        spec.delete(key)
    own.add_freejoint()
    return spec.compile(), posed


def _compiled(model: mujoco.MjModel, trunk: str | None) -> tuple[mujoco.MjModel, dict[str, float]]:
    """The same of a model that is compiled already."""
    body = find_trunk(model, trunk)
    joint = model.body_jntadr[body]
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError("the trunk of a compiled MjModel must move freely")
    return model, _posed(model)


def _posed(model: mujoco.MjModel) -> dict[str, float]:
    """Angles of joints in the first keyframe, by name."""
    joints = range(model.njnt if model.nkey else 0)
    return {model.joint(j).name: float(model.key_qpos[0, model.jnt_qposadr[j]]) for j in joints}


def load_spec(source: str | Path | mujoco.MjSpec | None) -> mujoco.MjSpec:
    """The MjSpec of a file, or a copy of one that is given."""
    if source is None:
        raise ValueError(
            "robot: read from a compiled MjModel, of which no scene can be built; give the "
            "path of its MJCF, or its MjSpec"
        )
    if isinstance(source, mujoco.MjSpec):
        return source.copy()
    path = Path(source)
    if not path.is_file():
        raise ValueError(f"robot '{path}': there is no such file")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ValueError(f"robot '{path}': MuJoCo cannot read it: {error}") from None
    # Of a URDF MuJoCo would make the trunk, which has no joint there, a part of the world.
    spec.compiler.fusestatic = False
    return spec


def _read(
    source: Any,
    name: str,
    model: mujoco.MjModel,
    found: Structure,
    posed: dict[str, float],
    torque_limit: Sequence[float] | None,
    stand_height: float | None,
) -> Robot:
    """Seven arguments: what was compiled, what was found in it, and what is given besides."""
    data = at_zero(model)
    R, origin = data.xmat[found.trunk].reshape(3, 3), data.xpos[found.trunk]
    legs = [
        _geometry(model, data, joints, foot, R, origin)
        for joints, foot in zip(found.joints, found.feet, strict=True)
    ]
    sign = np.array([leg.sign for leg in legs])
    angles = np.array([leg.angles for leg in legs])
    knee = knees(model, found, sign, angles, posed)
    sign, angles = ((a * np.stack([np.ones(4), knee, knee], axis=1)) for a in (sign, angles))
    zero = model.qpos0[model.jnt_qposadr[found.joints]] - sign * angles
    lengths = _alike("thigh and calf lengths", np.array([leg.lengths for leg in legs]))
    groups = [_links(model, joints) for joints in found.joints]
    mass = _alike(
        "masses of hip, thigh and calf",
        np.array([[model.body_mass[bodies].sum() for bodies in leg] for leg in groups]),
    )
    frames = [_frames(leg) for leg in legs]
    link_com = np.array(
        [
            [
                frame.T @ (R.T @ (_com(model, data, bodies) - origin) - place)
                for bodies, (frame, place) in zip(group, own, strict=True)
            ]
            for group, own in zip(groups, frames, strict=True)
        ]
    )
    pitch = np.array(
        [
            [
                (R @ frame)[:, 1] @ _inertia(model, data, bodies) @ (R @ frame)[:, 1]
                for bodies, (frame, _) in zip(group[1:], own[1:], strict=True)
            ]
            for group, own in zip(groups, frames, strict=True)
        ]
    )
    # The plane of a leg whose knee points ahead is looked at from the other side.
    link_com[:, 1:, 0] *= knee[:, None]
    of_legs = {b for leg in groups for bodies in leg for b in bodies}
    rest = [b for b in branch(model, found.trunk) if b not in of_legs]
    ranges = joint_ranges(model, found, sign, zero)
    values: dict[str, Any] = dict(
        mass=np.asarray(model.body_mass[rest].sum() + 4 * mass.sum()),
        inertia=np.eye(3),
        trunk_mass=np.asarray(model.body_mass[rest].sum()),
        trunk_com=R.T @ (_com(model, data, rest) - origin),
        link_mass=mass,
        link_com=link_com,
        hip_pos=np.array([leg.hip for leg in legs]),
        abduction_offset=np.array([leg.offset for leg in legs]),
        thigh_length=np.asarray(lengths[0]),
        calf_length=np.asarray(lengths[1]),
        foot_radius=np.asarray(model.geom_size[found.feet, 0].mean()),
        torque_limit=torque_limits(model, found, torque_limit),
        joint_range=ranges,
        link_inertia=pitch.mean(axis=0),
        stand_height=np.asarray(STAND * lengths.sum() if stand_height is None else stand_height),
        knee=knee,
    )
    params = RobotParams(**values)
    height = float(params.stand_height)

    def standing(height: float) -> np.ndarray:
        qpos = model.qpos0.copy()
        qpos[model.jnt_qposadr[found.joints]] = zero + sign * stand_pose(params, height)[1]
        return qpos

    data.qpos[:] = standing(height)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    inertia = R.T @ _inertia(model, data, branch(model, found.trunk)) @ R
    return Robot(
        name=name,
        params=RobotParams(
            **values
            | {
                "inertia": 0.5 * (inertia + inertia.T),
                "joint_inertia": joint_inertia(model, found, standing, height),
            }
        ),
        mjcf=_kept(source),
        trunk=model.body(found.trunk).name,
        joints=_names(model, found.joints),
        motors=_MOTORS,
        feet=foot_names(model, found),
        touch=_TOUCH,
        joint_sign=sign,
        joint_zero=zero,
        trunk_link_mass=float(model.body_mass[found.trunk]),
        is_read=True,
    )


_MOTORS: JointNames = tuple(
    (f"{leg.name}_abduction", f"{leg.name}_thigh", f"{leg.name}_calf") for leg in Leg
)
_TOUCH: LegNames = ("FR_touch", "FL_touch", "RR_touch", "RL_touch")


def _kept(source: Any) -> Any:
    """What scenes are built from."""
    if isinstance(source, mujoco.MjModel):
        return None
    return source if isinstance(source, mujoco.MjSpec) else Path(source).resolve()


def _names(model: mujoco.MjModel, joints: np.ndarray) -> JointNames:
    names: Any = tuple(tuple(model.joint(int(j)).name for j in row) for row in joints)
    for row, leg in zip(names, Leg, strict=True):
        for one, kind in zip(row, JOINT_NAMES, strict=True):
            if not one:
                raise ValueError(f"the {kind} joint of leg {leg.name} has no name in the MJCF")
    own: JointNames = names
    return own


def foot_names(model: mujoco.MjModel, found: Structure) -> LegNames:
    """Names of the feet's geoms; those without one get one in the scene."""
    names = [
        model.geom(int(geom)).name or f"{leg.name}_foot"
        for leg, geom in zip(Leg, found.feet, strict=True)
    ]
    return (names[0], names[1], names[2], names[3])


def _geometry(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    joints: np.ndarray,
    foot: int,
    R: np.ndarray,
    origin: np.ndarray,
) -> LegGeometry:
    """A leg, from the axes and anchors of its joints in the model's zero configuration."""
    axes = data.xaxis[joints] @ R
    hip, thigh, knee = (data.xanchor[joints] - origin) @ R
    sole = R.T @ (data.geom_xpos[foot] - origin)
    name = model.joint(int(joints[0])).name
    if abs(axes[0, 0]) < np.cos(STRAIGHT):
        raise ValueError(
            f"joint '{name}' turns about {_text(axes[0])}, wanted the trunk's x axis: abduction, "
            "thigh and calf, from the trunk on"
        )
    if abs(axes[1] @ axes[0]) > STRAIGHT or abs(axes[1] @ axes[2]) < np.cos(STRAIGHT):
        raise ValueError(
            f"the leg of joint '{name}' has its thigh about {_text(axes[1])} and its calf about "
            f"{_text(axes[2])}, wanted both about one axis across the abduction's"
        )
    if abs(axes[1, 1]) < 0.1:
        raise ValueError(f"the leg of joint '{name}' sticks out to the side where its angle is 0")
    s0, s1 = np.sign(axes[0, 0]), np.sign(axes[1, 1])
    s2 = s1 * np.sign(axes[1] @ axes[2])
    turned = np.arctan2(s1 * axes[1, 2], s1 * axes[1, 1])
    c, s = np.cos(turned), np.sin(turned)
    in_plane = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
    place = np.array([thigh[0], hip[1], hip[2]])
    lift = (in_plane @ (thigh - place))[2]
    u, w = in_plane @ (knee - thigh), in_plane @ (sole - knee)
    lengths = np.array([np.hypot(u[0], u[2]), np.hypot(w[0], w[2])])
    if abs(lift) > ALIKE * lengths.sum():
        raise ValueError(
            f"the thigh joint of '{name}' lies {1e3 * lift:.1f} mm above its abduction axis, "
            "wanted both level"
        )
    q1, q12 = np.arctan2(-u[0], -u[2]), np.arctan2(-w[0], -w[2])
    q2 = (q12 - q1 + np.pi) % (2 * np.pi) - np.pi
    return LegGeometry(
        hip=place,
        offset=float((in_plane @ (sole - place))[1]),
        lengths=lengths,
        angles=np.array([turned, q1, q2]),
        sign=np.array([s0, s1, s2]),
    )


def _frames(leg: LegGeometry) -> list[tuple[np.ndarray, np.ndarray]]:
    """Axes and origin of hip, thigh and calf in the trunk's axes."""
    q0, q1, q2 = leg.angles
    X = _about_x(q0)
    thigh, calf = X @ _about_y(q1), X @ _about_y(q1 + q2)
    beside = leg.hip + X @ [0.0, leg.offset, 0.0]
    return [
        (X, leg.hip), (thigh, beside), (calf, beside - leg.lengths[0] * thigh[:, 2]),
    ]  # fmt: skip


def _about_x(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _about_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _links(model: mujoco.MjModel, joints: np.ndarray) -> list[list[int]]:
    """Bodies that move with hip, thigh and calf."""
    below = [branch(model, int(model.jnt_bodyid[j])) for j in joints]
    return [
        [b for b in below[0] if b not in below[1]],
        [b for b in below[1] if b not in below[2]],
        below[2],
    ]


def _com(model: mujoco.MjModel, data: mujoco.MjData, bodies: list[int]) -> np.ndarray:
    """Centre of mass of some bodies, world [m]."""
    mass = model.body_mass[bodies]
    return mass @ data.xipos[bodies] / mass.sum()


def _inertia(model: mujoco.MjModel, data: mujoco.MjData, bodies: list[int]) -> np.ndarray:
    """Of some bodies about their centre of mass, world axes [kg m^2]."""
    com, total = _com(model, data, bodies), np.zeros((3, 3))
    for body in bodies:
        R, arm = data.ximat[body].reshape(3, 3), data.xipos[body] - com
        total += R @ np.diag(model.body_inertia[body]) @ R.T
        total += model.body_mass[body] * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return total


def _alike(what: str, values: np.ndarray) -> np.ndarray:
    """Mean over the legs, refused where they differ."""
    mean = values.mean(axis=0)
    if (np.abs(values - mean[None]) > ALIKE * mean.sum()).any():
        rows = "; ".join(_text(row) for row in values)
        raise ValueError(f"{what} must be alike in all legs, got {rows}")
    return mean


def _text(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in values) + ")"
