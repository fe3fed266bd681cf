"""An episode as data: who walks under which controller, in which world, from where, for how long.

Engines take nothing else. ``kjax.sim.resolve`` makes an episode from a config; one changed by hand
or by an optimiser walks as well.
"""

import hashlib
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from kjax.controllers.params import ControllerParams
from kjax.moved import moved_names
from kjax.sim.observe import Addresses
from kjax.sim.terrain import Terrain
from kjax.spec import ControllerSpec
from kjax.types import Command


@dataclass(frozen=True, kw_only=True)
class SceneSpec:
    """What shapes the program of a closed loop besides its controller.

    Attributes:
      robot: its name, see ``kjax.robots``.
      base: "planar" or "free".
      sim_dt: physics step [s].
      cone: of the contact solver, "pyramidal" or "elliptic".
      contacts: bodies that touch the ground: "all" or "feet".
      joint_damping: of all joints; the robot's own if ``None`` [N m s/rad].
      joint_armature: likewise [kg m^2].
      contact_threshold: foot force above which the contact sensor fires [N].
      terrain: kind of the terrain, see ``sim.terrain``.
      obstacles: ``count`` of the terrain's config.
      noise: whether sensors are noisy.
      force_noise: whether planned forces are perturbed.
    """

    robot: str
    base: str
    sim_dt: float
    cone: str
    contacts: str
    joint_damping: float | None
    joint_armature: float | None
    contact_threshold: float
    terrain: str = "flat"
    obstacles: int = 0
    noise: bool = False
    force_noise: bool = False


@dataclass(frozen=True, kw_only=True)
class BatchSpec:
    """What the robots of one compiled batch have in common: controller and scene."""

    controller: ControllerSpec
    scene: SceneSpec

    @property
    def per_tick(self) -> int:
        """Physics steps of a control tick."""
        return round(self.controller.control_dt / self.scene.sim_dt)

    @property
    def per_act(self) -> int:
        """Physics steps between two calls of ``act``."""
        return round(self.controller.act_dt / self.scene.sim_dt)


class EpisodeParams(NamedTuple):
    """What a robot meets in an episode; a leading axis (B) makes a batch of them.

    Attributes:
      seed: of the noise.
      noise_scale: (n,) standard deviation of each entry of the noise vector.
      force_noise: standard deviation of what is added to planned forces [N].
      push_begin: (P,) physics step at which each push begins.
      push_steps: (P,) number of steps it lasts; 0 for none.
      push_force: (P, 3) force on the trunk meanwhile, world [N].
      delay: physics steps from a torque's computation to its effect.
      origin: (3,) where the robot starts, on the floor, world [m].
    """

    seed: Any
    noise_scale: Any
    force_noise: Any
    push_begin: Any
    push_steps: Any
    push_force: Any
    delay: Any
    origin: Any


class World(NamedTuple):
    """What ``scene.apply_world`` changes in a compiled scene.

    Attributes:
      obstacles: where they lie, world.
      ground: height of the plane that they lie on, world [m].
      friction: sliding friction of the feet [-].
      payload: mass on the trunk that the controller does not know of [kg].
    """

    obstacles: Terrain
    ground: float
    friction: float
    payload: float

    def key(self) -> Hashable:
        """Equal for worlds that are equal to the last bit."""
        return tuple(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(self))


class Start(NamedTuple):
    """Where a robot starts.

    Attributes:
      pose: (3,) or (7,) of the trunk, as in qpos: x, z, MuJoCo's angle about +y; or position and
        quaternion (w, x, y, z) [m, rad, -].
      rates: (3,) or (6,) of the trunk, as in qvel [m/s, rad/s].
      joints: (4, 3) joint angles, leg order [rad].
    """

    pose: np.ndarray
    rates: np.ndarray
    joints: np.ndarray


class Goal(NamedTuple):
    """What was asked in an episode: what ``metrics`` measure it against.

    Attributes:
      scene: that the robot walks in.
      duration: [s].
      command: what is asked over time.
      gait_times: (K,) when each gait is asked for [s].
      heights: (G,) of the centre of mass in each gait, above the ground [m].
      slews: (2,) rates at which the references of velocity and yaw rate follow the command
        [m/s^2, rad/s^2].
      field: (2,) where the obstacles begin and end, from the robot's start [m].
    """

    scene: SceneSpec
    duration: float
    command: Command
    gait_times: np.ndarray
    heights: np.ndarray
    slews: np.ndarray
    field: tuple[float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Episode:
    """One closed loop to walk.

    Attributes:
      spec: of controller and scene; episodes with an equal one may share a compiled batch.
      controller: parameters of the controller.
      params: what the robot meets.
      world: that it walks in.
      start: where it starts.
      goal: what was asked.
    """

    spec: BatchSpec
    controller: ControllerParams
    params: EpisodeParams
    world: World
    start: Start
    goal: Goal

    @cached_property
    def controller_key(self) -> str:
        """Hash of the controller's parameters, but for the command and the times of gaits.

        Episodes with one key share a compiled controller.
        """
        rest = self.controller._replace(command=None, gait_times=None)  # type: ignore[arg-type]
        leaves, tree = jax.tree.flatten(rest)
        digest = hashlib.sha256(str(tree).encode())
        for leaf in leaves:
            digest.update(_leaf_digest(leaf))
        return digest.hexdigest()

    @property
    def ticks(self) -> int:
        """Control ticks."""
        return -(-round(self.goal.duration / self.spec.scene.sim_dt) // self.spec.per_tick)


_kept_digests: dict[int, tuple[np.ndarray, bytes]] = {}


def _leaf_digest(leaf: Any) -> bytes:
    """Hash of an array's type, shape and content; kept for arrays that nobody can change."""
    kept = _kept_digests.get(id(leaf))
    if kept is not None and kept[0] is leaf:
        return kept[1]
    array = np.asarray(leaf)
    content = hashlib.sha256(f"{array.dtype} {array.shape}".encode() + array.tobytes()).digest()
    fixed = isinstance(leaf, np.ndarray) and not leaf.flags.writeable
    if fixed and not (isinstance(leaf.base, np.ndarray) and leaf.base.flags.writeable):
        if len(_kept_digests) >= 4096:
            _kept_digests.clear()
        _kept_digests[id(leaf)] = (leaf, content)
    return content


def initial_state(
    start: Start, model: mujoco.MjModel, at: Addresses
) -> tuple[np.ndarray, np.ndarray]:
    """Qpos (nq,) and qvel (nv,) of a start; ValueError for a model with another base."""
    qpos, qvel = np.zeros(model.nq), np.zeros(model.nv)
    if (len(start.pose) + 12, len(start.rates) + 12) != (model.nq, model.nv):
        raise ValueError(
            f"start.pose has {len(start.pose)} and start.rates {len(start.rates)} entries, which "
            f"with 12 joints is no state of a model of nq {model.nq} and nv {model.nv}"
        )
    qpos[: len(start.pose)], qvel[: len(start.rates)] = start.pose, start.rates
    at.set_joints(qpos, start.joints)
    return qpos, qvel


def push_at(params: EpisodeParams, step: Any, count: int = 1, xp: Any = np) -> Any:
    """Mean force (..., 3) on the trunk over ``count`` physics steps from ``step`` on [N]."""
    first = xp.maximum(params.push_begin, step)
    last = xp.minimum(params.push_begin + params.push_steps, step + count)
    part = xp.maximum(last - first, 0) / count
    return (part[..., None] * params.push_force).sum(axis=-2)


def stack_params(episodes: Sequence[Episode]) -> EpisodeParams:
    """What a batch meets, (B, ...); shorter lists of pushes are filled up with none."""
    count = max(len(episode.params.push_begin) for episode in episodes)

    def filled(params: EpisodeParams) -> EpisodeParams:
        more = count - len(params.push_begin)
        lists = {
            name: np.concatenate(
                [row := getattr(params, name), np.zeros((more, *row.shape[1:]), row.dtype)]
            )
            for name in ("push_begin", "push_steps", "push_force")
        }
        return params._replace(**lists)

    return jax.tree.map(lambda *leaves: np.stack(leaves), *(filled(one.params) for one in episodes))


__getattr__ = moved_names(__name__)
