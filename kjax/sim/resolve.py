"""From a config to the world that a robot walks in: its spec (static) and its parameters (data).

Two configs may share a compiled batch if their ``batch_spec`` is the same: what is not in there
(weights, bounds, timing, terrain, command, pushes, noise, friction, ...) travels as arrays with a
leading axis B.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from kjax.config import (
    RunConfig,
)
from kjax.controllers.params import Tables, condense
from kjax.controllers.resolve import build_command, controller_key, controller_spec, resolve
from kjax.sim.episode import origin
from kjax.sim.excitation import force_deviation
from kjax.sim.noise import noise_scale
from kjax.sim.push import impulses
from kjax.spec import ControllerSpec
from kjax.types import Command


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


@dataclass(frozen=True, kw_only=True)
class SceneSpec:
    """What shapes the program of a closed loop besides its controller.

    Attributes:
      robot: who walks.
      base: "planar" or "free".
      sim_dt: physics step [s].
      cone: of the contact solver.
      contacts: bodies that touch the ground: "all" or "feet".
      joint_damping: [N m s/rad].
      joint_armature: [kg m^2].
      contact_threshold: foot force above which the contact sensor fires [N].
      terrain: kind of the terrain.
      obstacles: their number.
      noise: whether sensors are noisy.
      force_noise: whether planned forces are perturbed.
    """

    robot: str
    base: str
    sim_dt: float
    cone: str
    contacts: str
    joint_damping: float
    joint_armature: float
    contact_threshold: float
    terrain: str
    obstacles: int
    noise: bool
    force_noise: bool


@dataclass(frozen=True, kw_only=True)
class BatchSpec:
    """What the robots of one compiled batch have in common."""

    controller: ControllerSpec
    scene: SceneSpec


def resolve_scene(
    config: RunConfig, *, pushes: int | None = None
) -> tuple[SceneSpec, EpisodeParams]:
    """Spec and parameters of the world that a robot walks in.

    Args:
      config: of the run.
      pushes: length of the list of pushes, filled up with none; as many as there are if ``None``.
    """
    sim, terrain, noise, push = config.sim, config.terrain, config.noise, config.push
    spec = SceneSpec(
        robot=config.robot,
        base=sim.base,
        sim_dt=sim.sim_dt,
        cone=sim.cone,
        contacts=sim.contacts,
        joint_damping=sim.joint_damping,
        joint_armature=sim.joint_armature,
        contact_threshold=sim.contact_threshold,
        terrain=terrain.kind,
        obstacles=terrain.count,
        noise=noise.enabled,
        force_noise=force_deviation(noise) > 0,
    )
    steps = round(push.duration / sim.sim_dt)
    count = len(push.times) if pushes is None else pushes
    force, begin, length = (
        np.zeros((count, 3)),
        np.zeros(count, np.int32),
        np.zeros(count, np.int32),
    )
    for row, forward, lateral in zip(force, *impulses(push), strict=False):
        row[:2] = np.array([forward, lateral]) / (steps * sim.sim_dt)
    begin[: len(push.times)] = [round(time / sim.sim_dt) for time in push.times]
    length[: len(push.times)] = steps
    return spec, EpisodeParams(
        seed=np.int32(config.seed),
        noise_scale=noise_scale(noise, sim.base).astype(np.float32),
        force_noise=np.float32(force_deviation(noise)),
        push_begin=begin,
        push_steps=length,
        push_force=force,
        delay=np.int32(round(sim.delay / sim.sim_dt)),
        origin=origin(sim),
    )


def batch_spec(config: RunConfig) -> BatchSpec:
    """Spec of a config: those with an equal one may walk in one compiled batch."""
    # What a file holds may have changed since.
    return _batch_spec.__wrapped__(config) if config.koopman.file else _batch_spec(config)


@lru_cache(maxsize=8192)
def _batch_spec(config: RunConfig) -> BatchSpec:
    return BatchSpec(controller=controller_spec(config), scene=resolve_scene(config)[0])


def stack_episodes(configs: Sequence[RunConfig]) -> EpisodeParams:
    """Parameters (B, ...) of the episodes; shorter lists of pushes are filled up with none."""
    count = max(len(config.push.times) for config in configs)
    episodes = [resolve_scene(config, pushes=count)[1] for config in configs]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *episodes)


def push_at(episode: EpisodeParams, step: Any, count: int = 1, xp: Any = np) -> Any:
    """Mean force (..., 3) on the trunk over ``count`` physics steps from ``step`` on [N]."""
    first = xp.maximum(episode.push_begin, step)
    last = xp.minimum(episode.push_begin + episode.push_steps, step + count)
    part = xp.maximum(last - first, 0) / count
    return (part[..., None] * episode.push_force).sum(axis=-2)


def stack_tables(configs: Sequence[RunConfig], dtype: Any) -> tuple[Tables, Any]:
    """What the controller's functions take, of a batch, and which leaves have its leading axis.

    Configs that differ in nothing that the parameters come from share one fit; leaves that are the
    same for all robots stay single. Command and requests of gaits always have the axis.

    Args:
      configs: of the robots, with one ``batch_spec``.
      dtype: floating type.

    Returns:
      The tables, and for each leaf 0 or ``None``: ``vmap``'s ``in_axes``.
    """
    built: dict[Hashable, Tables] = {}
    kinds = [controller_key(config) for config in configs]
    for kind, config in zip(kinds, configs, strict=True):
        if kind not in built:
            spec, params = resolve(config)
            built[kind] = jax.device_get(condense(spec, params, dtype=dtype))
    names = list(built)
    which = np.array([names.index(kind) for kind in kinds])
    pieces = max(len(config.command.times) for config in configs)
    requests = max(len(config.gait.times) for config in configs)
    own: list[tuple[np.ndarray, ...]] = []
    for kind, config in zip(kinds, configs, strict=True):
        gaits, command = built[kind].params.gaits, build_command(config.command)
        own.append(
            (
                _filled(command.times, pieces, np.inf).astype(dtype),
                _filled(command.values, pieces, command.values[-1]).astype(dtype),
                _filled(config.gait.times, requests, np.inf).astype(dtype),
                _filled(gaits, requests, gaits[-1]).astype(np.int32),
            )
        )
    times, values, gait_times, gait_names = map(np.stack, zip(*own, strict=True))

    def hollow(tables: Tables, *fields: Any) -> Any:
        new = dict(zip(("command", "gait_times", "gaits"), fields, strict=True))
        return tables._replace(params=tables.params._replace(**new))

    def stack(*leaves: Any) -> Any:
        same = all(np.array_equal(leaf, leaves[0]) for leaf in leaves[1:])
        return leaves[0] if same else np.stack(leaves)[which]

    shared = [hollow(tables, 0, 0, 0) for tables in built.values()]
    axes = jax.tree.map(
        lambda *leaves: None if np.ndim(stack(*leaves)) == np.ndim(leaves[0]) else 0, *shared
    )
    commands = Command(times, values)  # type: ignore[arg-type]
    stacked = hollow(jax.tree.map(stack, *shared), commands, gait_times, gait_names)
    own_axes = hollow(axes, Command(0, 0), 0, 0)  # type: ignore[arg-type]
    return jax.tree.map(jnp.asarray, stacked), own_axes


def _filled(values: Any, count: int, rest: Any) -> np.ndarray:
    """Values, filled up to ``count`` of them."""
    values = np.asarray(values, float)
    more = np.broadcast_to(np.asarray(rest, float), (count - len(values), *values.shape[1:]))
    return np.concatenate([values, more])
