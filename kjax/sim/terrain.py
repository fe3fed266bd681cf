"""Obstacle fields as data.

A kind fixes how many boxes and capsules the scene holds, a seed fixes where they lie: the scene is
compiled once per kind, and ``place`` moves its obstacles.
"""

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from kjax.types import RobotParams

_BOX, _CAPSULE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
PREFIX = "obstacle_"
_ROWS = 6  # tiles beside each other
_PLATFORM = 5.0  # m, half-length of what a slope downwards starts from and ends at
_ACROSS = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])  # turns a capsule's axis along y


@dataclass(frozen=True, kw_only=True)
class Field:
    """An obstacle field, measured from where the robot starts.

    Attributes:
      kind: see ``generate``.
      seed: of where the obstacles lie.
      count: number of obstacles, steps or patches.
      start: where the field begins [m].
      end: its far end [m].
      height_min: lowest obstacle, or rise of a step [m].
      height_max: highest obstacle, or rise of a step [m].
      width: of what reaches across both tracks [m].
      slope: inclination of a slope; below 0 it leads down first, or rises to the right [deg].
      patch_friction: sliding friction of a foot on a patch [-].
      friction: that on all else [-].
      track: half the distance between the left and the right feet [m].
    """

    kind: str
    seed: int
    count: int
    start: float
    end: float
    height_min: float
    height_max: float
    width: float
    slope: float
    patch_friction: float
    friction: float
    track: float


class Terrain(NamedTuple):
    """Obstacles of one field (n of them).

    Attributes:
      pos: (n, 3) centres, world [m].
      quat: (n, 4) orientations (w, x, y, z) [-].
      size: (n, 3) MuJoCo geom sizes: half-lengths, or radius and half-length [m].
      friction: (n,) sliding friction of a foot on it [-].
    """

    pos: np.ndarray
    quat: np.ndarray
    size: np.ndarray
    friction: np.ndarray


def track_of(robot: RobotParams) -> float:
    """Half the distance between the left and the right feet of a standing robot, to 1 mm [m]."""
    return round(float(abs(robot.hip_pos[1, 1] + robot.abduction_offset[1])), 3)


def shapes(kind: str, count: int) -> list[mujoco.mjtGeom]:
    """Geom type of every obstacle of a kind of field; the same for all its seeds."""
    if kind == "flat":
        return []
    if kind == "slope":
        return [_BOX] * 4
    if kind == "cross_slope":
        return [_BOX] * 3
    if kind == "tiles":
        return [_BOX] * (count * _ROWS)
    if kind == "paper":
        return [_CAPSULE if i % 3 == 2 else _BOX for i in range(count)]
    return [_BOX] * count


def generate(field: Field) -> Terrain:
    """The obstacles of a field, from where the robot starts.

    Kinds: ``paper`` (blocks, cubes and capsules alternating, on the left track, the right one or
    both), ``blocks`` (random blocks on both tracks), ``steps`` (a flight of steps up, then down),
    ``slope`` (up, level, down; or down, level, up), ``cross_slope`` (ground that rises to the left
    or right of the way), ``tiles`` (square ones of random heights, six rows of them),
    ``patches`` (level, slippery plates).
    """
    rng = np.random.default_rng([field.seed, 7])
    make = {
        "flat": _none,
        "paper": _paper,
        "blocks": _blocks,
        "steps": _steps,
        "slope": _slope,
        "cross_slope": _cross_slope,
        "tiles": _tiles,
        "patches": _patches,
    }[field.kind]
    pos, quat, size = make(field, rng)
    slippery = field.kind == "patches"
    mu = np.full(len(pos), field.patch_friction if slippery else field.friction)
    return Terrain(pos=pos, quat=quat, size=size, friction=mu)


def place_at(terrain: Terrain, start: np.ndarray, heading: float) -> Terrain:
    """Obstacles given from the robot's start, in the world.

    Args:
      terrain: from where the robot starts, along its heading.
      start: (3,) the start, on the floor, world [m].
      heading: of the robot there [rad].
    """
    c, s = np.cos(heading), np.sin(heading)
    pos = terrain.pos @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    w, x, y, z = terrain.quat.T
    h_c, h_s = np.cos(heading / 2), np.sin(heading / 2)
    quat = np.stack(
        [h_c * w - h_s * z, h_c * x - h_s * y, h_c * y + h_s * x, h_c * z + h_s * w], axis=-1
    )
    return terrain._replace(pos=pos + start, quat=quat)


def add_obstacles(spec: mujoco.MjSpec, kind: str, count: int) -> None:
    """Add the obstacles of a kind of field to a scene that is not compiled yet.

    They lie out of reach until ``place`` moves them.
    """
    for i, shape in enumerate(shapes(kind, count)):
        spec.worldbody.add_geom(
            name=f"{PREFIX}{i}",
            type=shape,
            pos=[0.0, 0.0, -100.0],
            size=[0.1, 0.1, 0.1],
            friction=[1.0, 0.02, 0.01],
            priority=2 if kind == "patches" else 0,  # feet have 1 and overrule the ground
            contype=1,
            conaffinity=0,
            rgba=[0.55, 0.42, 0.30, 1.0],
        )


def place(model: mujoco.MjModel, terrain: Terrain) -> None:
    """Move the obstacles of a compiled scene to another field of the same kind.

    Raises:
      ValueError: if the scene holds another number of obstacles.
    """
    ids = [i for i in range(model.ngeom) if model.geom(i).name.startswith(PREFIX)]
    if len(ids) != len(terrain.pos):
        raise ValueError(f"terrain has {len(terrain.pos)} obstacles, the scene holds {len(ids)}")
    model.geom_pos[ids], model.geom_quat[ids] = terrain.pos, terrain.quat
    model.geom_size[ids], model.geom_friction[ids, 0] = terrain.size, terrain.friction
    for i, size in zip(ids, terrain.size, strict=True):
        box = model.geom_type[i] == _BOX
        model.geom_rbound[i] = np.linalg.norm(size) if box else size[:2].sum()
        half = size if box else np.array([size[0], size[0], size[0] + size[1]])
        model.geom_aabb[i] = np.r_[np.zeros(3), half]
    mujoco.mj_setConst(model, mujoco.MjData(model))


_Boxes = tuple[np.ndarray, np.ndarray, np.ndarray]  # centres, orientations, sizes


def _none(field: Field, rng: np.random.Generator) -> _Boxes:
    return np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3))


def _paper(field: Field, rng: np.random.Generator) -> _Boxes:
    pos, quat, size = [], [], []
    for i, x in enumerate(_spread(field, rng)):
        h = rng.uniform(field.height_min, field.height_max)
        side = rng.integers(-1, 2)  # right track, both, left track
        yaw = rng.uniform(-1.0, 1.0)
        y, q = float(side * field.track), _ACROSS
        if i % 3 == 0:  # block
            half = [rng.uniform(0.06, 0.12), 0.12 if side else field.width / 2, h / 2]
            q = _yaw(0.4 * yaw if side else 0.0)
        elif i % 3 == 1:  # cube, always under one track
            half, y, q = [h / 2] * 3, float((side or 1) * field.track), _yaw(0.7 * yaw)
        else:  # capsule, lying across
            half = [h / 2, 0.15 if side else field.width / 2, 0.0]
        pos.append([x, y, h / 2])
        quat.append(q)
        size.append(half)
    return np.array(pos), np.array(quat), np.array(size)


def _blocks(field: Field, rng: np.random.Generator) -> _Boxes:
    x = _spread(field, rng)
    h = rng.uniform(field.height_min, field.height_max, field.count)
    side = rng.integers(-1, 2, field.count)
    length = rng.uniform(0.05, 0.15, field.count)
    size = np.stack([length, np.where(side == 0, field.width / 2, 0.12), h / 2], axis=-1)
    yaw = np.where(side == 0, 0.0, rng.uniform(-0.4, 0.4, field.count))
    pos = np.stack([x, side * field.track, h / 2], axis=-1)
    return pos, np.array([_yaw(a) for a in yaw]), size


def _steps(field: Field, rng: np.random.Generator) -> _Boxes:
    count = field.count
    rise = rng.uniform(field.height_min, field.height_max, count)
    up = (count + 1) // 2
    level = np.cumsum(np.where(np.arange(count) < up, rise, -rise))
    level = np.maximum(level, 0.005)
    tread = (field.end - field.start) / count
    x = field.start + tread * (np.arange(count) + 0.5)
    pos = np.stack([x, np.zeros(count), level / 2], axis=-1)
    size = np.stack(
        [np.full(count, tread / 2), np.full(count, field.width / 2), level / 2], axis=-1
    )
    return pos, np.tile(_yaw(0.0), (count, 1)), size


def ground_level(field: Field) -> float:
    """Height of the plane that the obstacles lie on, from where the robot starts [m]."""
    if field.kind == "cross_slope":
        return -0.5 * field.width * abs(np.tan(np.radians(field.slope)))
    if field.kind != "slope" or field.slope > 0:
        return 0.0
    return (field.end - field.start) / 3.0 * np.tan(np.radians(field.slope))


def _slope(field: Field, rng: np.random.Generator) -> _Boxes:
    """Up, level, down; or, with a negative slope, down from a platform and up to another one."""
    angle = np.radians(field.slope)
    third = (field.end - field.start) / 3.0
    top, thick = third * np.tan(angle), 0.05
    ramp = 0.5 * third / np.cos(angle)
    pos, quat, size = [], [], []

    def add(centre: float, height: float, tilt: float, half: float) -> None:
        normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
        pos.append(np.array([centre, 0.0, height]) - thick * normal)
        quat.append([np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0])
        size.append([half, field.width / 2, thick])

    first, last = field.start + 0.5 * third, field.end - 0.5 * third
    add(first, top / 2, -angle, ramp)
    add(last, top / 2, angle, ramp)
    if angle > 0:
        add(0.5 * (first + last), top, 0.0, third / 2)
        add(0.5 * (first + last), top - 3 * thick, 0.0, third / 2)  # inside: both kinds have four
    else:
        add(field.start - _PLATFORM, 0.0, 0.0, _PLATFORM)
        add(field.end + _PLATFORM, 0.0, 0.0, _PLATFORM)
    return np.array(pos), np.array(quat), np.array(size)


def _cross_slope(field: Field, rng: np.random.Generator) -> _Boxes:
    """Ground that is tilted about the way, between two level platforms."""
    angle, thick = np.radians(field.slope), 0.05
    middle, half = 0.5 * (field.start + field.end), 0.5 * (field.end - field.start)
    normal = np.array([0.0, -np.sin(angle), np.cos(angle)])
    pos = np.array(
        [
            np.array([middle, 0.0, 0.0]) - thick * normal,
            [field.start - _PLATFORM, 0.0, -thick],
            [field.end + _PLATFORM, 0.0, -thick],
        ]
    )
    tilted = [np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0]
    across = field.width / 2
    size = [[half, across / np.cos(angle), thick], *[[_PLATFORM, across, thick]] * 2]
    return pos, np.array([tilted, _yaw(0.0), _yaw(0.0)]), np.array(size)


def _tiles(field: Field, rng: np.random.Generator) -> _Boxes:
    """A height field of one height per tile."""
    length, across = (field.end - field.start) / field.count, field.width / _ROWS
    row, column = np.divmod(np.arange(field.count * _ROWS), _ROWS)
    h = rng.uniform(field.height_min, field.height_max, field.count * _ROWS)
    x = field.start + length * (row + 0.5)
    y = across * (column + 0.5) - field.width / 2
    pos = np.stack([x, y, h / 2], axis=-1)
    size = np.stack([np.full_like(h, length / 2), np.full_like(h, across / 2), h / 2], axis=-1)
    return pos, np.tile(_yaw(0.0), (len(h), 1)), size


def _patches(field: Field, rng: np.random.Generator) -> _Boxes:
    x = _spread(field, rng)
    half = 0.4 * (field.end - field.start) / field.count
    thick = 0.001
    pos = np.stack([x, np.zeros(field.count), np.full(field.count, thick / 2)], axis=-1)
    size = np.tile([half, field.width / 2, thick / 2], (field.count, 1))
    return pos, np.tile(_yaw(0.0), (field.count, 1)), size


def _spread(field: Field, rng: np.random.Generator) -> np.ndarray:
    """Obstacle centres along the path: evenly from start to end, jittered by up to 4 cm."""
    x = np.linspace(field.start, field.end, field.count)
    return x + rng.uniform(-0.04, 0.04, field.count)


def _yaw(angle: float) -> np.ndarray:
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
