"""A batch of configs as data: what is compiled once, and what differs between its robots.

Two configs may share a compiled batch if their ``batch_part`` is the same: what is left out there
(weights, bounds, timing, terrain, command, pushes, noise, friction, ...) travels as arrays with a
leading axis B.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from kjax.config import (
    CommandConfig,
    GaitConfig,
    LateralConfig,
    LegConfig,
    NoiseConfig,
    PushConfig,
    RunConfig,
    SimConfig,
    SrbConfig,
    TerrainConfig,
)
from kjax.params import ControllerParams, build_params
from kjax.robots import go1
from kjax.sim.episode import origin
from kjax.sim.excitation import force_deviation, without_size
from kjax.sim.observe import noise_scale
from kjax.sim.push import impulses
from kjax.types import Command
from kjax.walkable import build_gaits, cycle_nodes

# Numbers that reach the compiled functions through ``ControllerParams`` only.
_LMPC = (
    "state_weights", "input_weight", "input_reference", "force_x_max", "force_z_min",
    "force_z_max", "height", "command_slew", "integral_gains", "integral_limits",
    "position_slack",
)  # fmt: skip
_BOUND = (
    "front_stance", "first_flight", "rear_stance", "second_flight", "ramp_start", "feet_front",
    "feet_rear", "reference", "force_edge", "height", "state_weights", "input_weight",
    "force_x_max",
    "force_z_min", "force_z_max", "velocity_gain", "apex",
)  # fmt: skip
_MULTIPHASE = (
    "state_weights", "input_weight", "force_x_max", "force_z_min", "force_z_max", "friction",
    "torque_fraction", "inertia_scale", "velocity_time", "height_time",
)  # fmt: skip


class Case(NamedTuple):
    """What one robot of a batch meets, besides its controller and its scene.

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


class BatchPart(NamedTuple):
    """What the robots of one compiled batch have in common.

    Attributes:
      config: theirs, without what may differ.
      nodes: length of a multi-phase horizon, which follows from the gaits' timing; 0 without one.
    """

    config: RunConfig
    nodes: int


@lru_cache(maxsize=8192)
def batch_part(config: RunConfig) -> BatchPart:
    """What a config must share with others to walk in one compiled batch with them."""
    gait, bound, terrain = config.gait, config.bound, config.terrain
    plain_gait = GaitConfig(
        names=("trot",),
        times=(0.0,),
        trot_flight=min(gait.trot_flight, config.lmpc.control_dt),  # whether, not how long
        landing_time=min(gait.landing_time, config.lmpc.control_dt),
    )
    nodes = int(cycle_nodes(build_gaits(config), config).sum(axis=1).max())
    plain = replace(
        config,
        seed=0,
        duration=1.0,
        command=CommandConfig(times=(0.0,), velocities=(0.0,)),
        gait=plain_gait,
        noise=NoiseConfig(enabled=config.noise.enabled, force=without_size(config.noise)),
        push=PushConfig(),
        srb=SrbConfig(),
        leg=LegConfig(act_dt=config.leg.act_dt),
        lateral=LateralConfig(),
        lmpc=_defaults(config.lmpc, _LMPC),
        bound=_defaults(bound, _BOUND),
        multiphase=_defaults(config.multiphase, _MULTIPHASE),
        terrain=TerrainConfig(kind=terrain.kind, count=terrain.count),
        sim=replace(
            config.sim,
            friction=SimConfig().friction,
            payload=0.0,
            delay=0.0,
            start=(0.0, 0.0),
            heading=0.0,
            floor=0.0,
        ),
    )
    return BatchPart(plain, nodes)


def _defaults(section: Any, names: tuple[str, ...]) -> Any:
    plain = type(section)()
    return replace(section, **{name: getattr(plain, name) for name in names})


def stack_cases(configs: Sequence[RunConfig]) -> Case:
    """Cases (B, ...) of configs; shorter lists of pushes are filled up with none."""
    count = max(len(config.push.times) for config in configs)

    def one(config: RunConfig) -> Case:
        dt, push = config.sim.sim_dt, config.push
        steps = round(push.duration / dt)
        rows = np.zeros((count, 3))
        for row, forward, lateral in zip(rows, *impulses(push), strict=False):
            row[:2] = np.array([forward, lateral]) / (steps * dt)
        begin, length = np.zeros(count, np.int32), np.zeros(count, np.int32)
        begin[: len(push.times)] = [round(time / dt) for time in push.times]
        length[: len(push.times)] = steps
        return Case(
            seed=np.int32(config.seed),
            noise_scale=noise_scale(config.noise, config.sim.base).astype(np.float32),
            force_noise=np.float32(force_deviation(config.noise)),
            push_begin=begin,
            push_steps=length,
            push_force=rows,
            delay=np.int32(round(config.sim.delay / dt)),
            origin=origin(config.sim),
        )

    return jax.tree.map(lambda *leaves: np.stack(leaves), *map(one, configs))


def push_at(case: Case, step: Any, count: int = 1, xp: Any = np) -> Any:
    """Mean force (..., 3) on the trunk over ``count`` physics steps from ``step`` on [N]."""
    first = xp.maximum(case.push_begin, step)
    last = xp.minimum(case.push_begin + case.push_steps, step + count)
    part = xp.maximum(last - first, 0) / count
    return (part[..., None] * case.push_force).sum(axis=-2)


def stack_params(configs: Sequence[RunConfig], dtype: Any) -> tuple[ControllerParams, Any]:
    """Controller parameters of a batch, and which leaves have its leading axis.

    Configs that differ in nothing that the parameters come from share one fit; leaves that are the
    same for all robots stay single. Command and requests of gaits always have the axis.

    Args:
      configs: of the robots, with one ``batch_part``.
      dtype: floating type.

    Returns:
      The parameters, and for each leaf 0 or ``None``: ``vmap``'s ``in_axes``.
    """
    built: dict[RunConfig, ControllerParams] = {}
    kinds = [_params_part(config) for config in configs]
    for kind, config in zip(kinds, configs, strict=True):
        if kind not in built:
            built[kind] = jax.device_get(build_params(config, go1.PARAMS, dtype=dtype))
    names = list(built)
    which = np.array([names.index(kind) for kind in kinds])
    pieces = max(len(config.command.times) for config in configs)
    requests = max(len(config.gait.times) for config in configs)
    own: list[tuple[np.ndarray, ...]] = []
    for kind, config in zip(kinds, configs, strict=True):
        gaits, command = built[kind].gaits, config.command
        own.append(
            (
                _filled(command.times, pieces, np.inf).astype(dtype),
                _filled(command.velocities, pieces, command.velocities[-1]).astype(dtype),
                _filled(config.gait.times, requests, np.inf).astype(dtype),
                _filled(gaits, requests, gaits[-1]).astype(np.int32),
            )
        )
    times, velocities, gait_times, gait_names = map(np.stack, zip(*own, strict=True))

    def hollow(params: ControllerParams, *fields: Any) -> Any:
        return params._replace(**dict(zip(("command", "gait_times", "gaits"), fields, strict=True)))

    def stack(*leaves: Any) -> Any:
        same = all(np.array_equal(leaf, leaves[0]) for leaf in leaves[1:])
        return leaves[0] if same else np.stack(leaves)[which]

    shared = [hollow(params, 0, 0, 0) for params in built.values()]
    axes = jax.tree.map(
        lambda *leaves: None if np.ndim(stack(*leaves)) == np.ndim(leaves[0]) else 0, *shared
    )
    commands = Command(times, velocities)  # type: ignore[arg-type]
    stacked = hollow(jax.tree.map(stack, *shared), commands, gait_times, gait_names)
    own_axes = hollow(axes, Command(0, 0), 0, 0)  # type: ignore[arg-type]
    return jax.tree.map(jnp.asarray, stacked), own_axes


@lru_cache(maxsize=8192)
def _params_part(config: RunConfig) -> RunConfig:
    """What controller parameters come from, but for command and times of requests."""
    return replace(
        config,
        seed=0,
        duration=1.0,
        command=CommandConfig(times=(0.0,), velocities=(0.0,)),
        gait=replace(config.gait, times=tuple(map(float, range(len(config.gait.times))))),
        noise=NoiseConfig(),
        push=PushConfig(),
        terrain=TerrainConfig(),
        sim=SimConfig(base=config.sim.base, sim_dt=config.sim.sim_dt),
    )


def _filled(values: Any, count: int, rest: Any) -> np.ndarray:
    """Values, filled up to ``count`` of them."""
    values = np.asarray(values, float)
    return np.concatenate([values, np.full(count - len(values), float(rest))])


def check_engine(config: RunConfig, *, engine: str = "c", torques: str = "every_step") -> None:
    """Raise a ValueError that says why an engine cannot walk a config, if it cannot.

    Args:
      config: of a robot.
      engine: ``"c"`` or ``"mjx"``.
      torques: ``"every_step"`` or ``"held"``.
    """
    held, delay = torques == "held", config.sim.delay
    name, tick = (
        ("lmpc.control_dt", config.lmpc.control_dt) if held else ("leg.act_dt", config.leg.act_dt)
    )
    if abs(delay / tick - round(delay / tick)) > 1e-6:
        raise ValueError(
            f"with torques = '{torques}' sim.delay must be a multiple of {name} {tick} s, got "
            f"{delay} s"
        )
    if engine == "mjx" and (config.sim.contacts != "feet" or config.sim.cone != "pyramidal"):
        raise ValueError(
            "MJX needs sim.contacts = 'feet' and sim.cone = 'pyramidal', got "
            f"'{config.sim.contacts}' and '{config.sim.cone}'"
        )
