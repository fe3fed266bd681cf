"""Trunk, legs and feet of a quadruped, found in a compiled model by its structure.

A leg is a branch of the trunk with exactly three hinges, one after the other: abduction, thigh,
calf. What else hangs on the trunk, a payload, an arm, belongs to it. A foot is the sphere that
touches the ground at the end of a leg.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np

from kjax.types import Leg

_HINGE, _FREE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE
_SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE


class Structure(NamedTuple):
    """Ids in a model; legs in the order of ``Leg``.

    Attributes:
      trunk: body.
      joints: (4, 3) abduction, thigh and calf joint of each leg.
      feet: (4,) geoms.
      extra_joints: of the trunk's own branches, which the scene holds still.
    """

    trunk: int
    joints: np.ndarray
    feet: np.ndarray
    extra_joints: tuple[int, ...]


def find_structure(
    model: mujoco.MjModel, trunk: str | None = None, feet: Sequence[str] | None = None
) -> Structure:
    """Trunk, legs and feet of a model.

    Args:
      model: of one quadruped.
      trunk: name of its trunk's body, where it is not the one that moves freely.
      feet: names of the feet's geoms (FR, FL, RR, RL), where they are no spheres.

    Raises:
      ValueError: in one sentence, for what cannot be found.
    """
    body = find_trunk(model, trunk)
    legs, extra = _legs(model, body)
    if len(legs) != 4:
        found = "; ".join(", ".join(_name(model, "joint", j) for j in one) for one in legs)
        raise ValueError(
            f"wanted four legs of three hinges each on the trunk '{_name(model, 'body', body)}', "
            f"found {len(legs)}{': ' + found if found else ''}; trunk= names another body"
        )
    data = at_zero(model)
    order = _by_place(model, data, body, legs)
    joints = np.array([legs[i] for i in order])
    if feet is None:
        soles = np.array([_foot(model, data, one) for one in joints])
    else:
        if len(feet) != 4:
            raise ValueError(f"feet must name four geoms (FR, FL, RR, RL), got {list(feet)}")
        soles = np.array([_named(model, "geom", one) for one in feet])
    return Structure(body, joints, soles, tuple(extra))


def at_zero(model: mujoco.MjModel) -> mujoco.MjData:
    """The model as the MJCF has it, all joints at 0."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def find_trunk(model: mujoco.MjModel, name: str | None = None) -> int:
    """The body of that name, or with a free joint, or the heaviest that hangs on the world."""
    if name is not None:
        return _named(model, "body", name)
    free = [int(model.jnt_bodyid[j]) for j in range(model.njnt) if model.jnt_type[j] == _FREE]
    if len(free) > 1:
        names = ", ".join(_name(model, "body", b) for b in free)
        raise ValueError(f"several bodies move freely ({names}): trunk= names the robot's")
    if free:
        return free[0]
    roots = [b for b in range(1, model.nbody) if model.body_parentid[b] == 0]
    if not roots:
        raise ValueError("the model has no body")
    return max(roots, key=lambda b: model.body_subtreemass[b])


def _legs(model: mujoco.MjModel, trunk: int) -> tuple[list[list[int]], list[int]]:
    """Joints of each leg, and those of all other branches."""
    rigid, legs, extra = {trunk}, [], []
    for body in range(trunk + 1, model.nbody):
        if model.body_parentid[body] not in rigid:
            continue
        if model.body_jntnum[body] == 0:
            rigid.add(body)  # a part of the trunk
            continue
        bodies = branch(model, body)
        joints = [j for b in bodies for j in _joints_of(model, b)]
        chain = all(
            model.jnt_bodyid[then] in branch(model, int(model.jnt_bodyid[now]))
            for now, then in pairwise(joints)
        )
        is_leg = len(joints) == 3 and chain and all(model.jnt_type[j] == _HINGE for j in joints)
        if is_leg:
            legs.append(joints)
        else:
            extra += joints
    return legs, extra


def branch(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and all that hang on it."""
    out = [body]
    for b in range(body + 1, model.nbody):
        if model.body_parentid[b] in out:
            out.append(b)
    return out


def _joints_of(model: mujoco.MjModel, body: int) -> range:
    first = int(model.body_jntadr[body])
    return range(first, first + int(model.body_jntnum[body]))


def _by_place(
    model: mujoco.MjModel, data: mujoco.MjData, trunk: int, legs: list[list[int]]
) -> list[int]:
    """Index of the front right, front left, rear right and rear left leg."""
    R, origin = data.xmat[trunk].reshape(3, 3), data.xpos[trunk]
    hips = np.array([R.T @ (data.xanchor[one[1]] - origin) for one in legs])
    middle = hips.mean(axis=0)
    order = []
    for leg in Leg:
        fore, left = leg.name[0] == "F", leg.name[1] == "L"
        here = [
            i
            for i, hip in enumerate(hips - middle)
            if (hip[0] > 0) == fore and (hip[1] > 0) == left
        ]
        if len(here) != 1:
            places = ", ".join(f"({x:.3f}, {y:.3f})" for x, y, _ in hips)
            raise ValueError(
                f"wanted one leg {'ahead' if fore else 'behind'} on the "
                f"{'left' if left else 'right'}, x of the trunk ahead and y to the left; the thigh "
                f"joints lie at {places} m"
            )
        order.append(here[0])
    return order


def _foot(model: mujoco.MjModel, data: mujoco.MjData, joints: np.ndarray) -> int:
    """The sphere furthest from the calf joint that can touch something."""
    bodies = branch(model, int(model.jnt_bodyid[joints[2]]))
    spheres = [
        g
        for g in range(model.ngeom)
        if model.geom_bodyid[g] in bodies
        and model.geom_type[g] == _SPHERE
        and (model.geom_contype[g] or model.geom_conaffinity[g])
    ]
    if not spheres:
        raise ValueError(
            f"the leg of joint '{_name(model, 'joint', joints[2])}' has no sphere that touches the "
            "ground: feet= names the feet's geoms (FR, FL, RR, RL)"
        )
    knee = data.xanchor[joints[2]]
    return max(spheres, key=lambda g: float(np.linalg.norm(data.geom_xpos[g] - knee)))


def _name(model: mujoco.MjModel, kind: str, index: int) -> str:
    return str(getattr(model, kind)(int(index)).name) or f"{kind} {index}"


def _named(model: mujoco.MjModel, kind: str, name: str) -> int:
    number = {"body": model.nbody, "geom": model.ngeom}[kind]
    names = [getattr(model, kind)(i).name for i in range(number)]
    if name not in names:
        raise ValueError(
            f"the model has no {kind} named '{name}', there are {', '.join(n for n in names if n)}"
        )
    return names.index(name)
