"""What the robots of a batch share: tables with an axis where they differ, and compiled scenes."""

from collections.abc import Hashable, Sequence
from copy import copy
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from kjax.controllers.params import Tables, condense
from kjax.robots import Robot
from kjax.sim.episode import Episode
from kjax.sim.scene import apply_world
from kjax.types import Command


def stack_tables(episodes: Sequence[Episode], dtype: Any) -> tuple[Tables, Any]:
    """What the controller's functions take, of a batch, and which leaves have its leading axis.

    Episodes with one ``controller_key`` share one set of tables; leaves that are the same for all
    robots stay single. Command and requests of gaits always have the axis.

    Args:
      episodes: of the robots, with one ``spec``.
      dtype: floating type.

    Returns:
      The tables, and for each leaf 0 or ``None``: ``vmap``'s ``in_axes``.
    """
    built: dict[Hashable, Tables] = {}
    for one in episodes:
        if one.controller_key not in built:
            tables = condense(one.spec.controller, one.controller, dtype=dtype)
            built[one.controller_key] = jax.device_get(tables)
    names = list(built)
    which = np.array([names.index(one.controller_key) for one in episodes])
    pieces = max(len(one.controller.command.times) for one in episodes)
    requests = max(len(one.controller.gait_times) for one in episodes)
    own: list[tuple[np.ndarray, ...]] = []
    for one in episodes:
        asked = one.controller
        gaits, command = np.asarray(asked.gaits), asked.command
        own.append(
            (
                _filled(command.times, pieces, np.inf).astype(dtype),
                _filled(command.values, pieces, command.values[-1]).astype(dtype),
                _filled(asked.gait_times, requests, np.inf).astype(dtype),
                _filled(gaits, requests, gaits[-1]).astype(np.int32),
            )
        )
    times, values, gait_times, gaits = map(np.stack, zip(*own, strict=True))

    def with_asked(tables: Tables, *fields: Any) -> Any:
        asked = dict(zip(("command", "gait_times", "gaits"), fields, strict=True))
        return tables._replace(params=tables.params._replace(**asked))

    def stack(*leaves: Any) -> Any:
        same = all(np.array_equal(leaf, leaves[0]) for leaf in leaves[1:])
        return leaves[0] if same else np.stack(leaves)[which]

    shared = [with_asked(tables, 0, 0, 0) for tables in built.values()]
    axes = jax.tree.map(
        lambda *leaves: None if np.ndim(stack(*leaves)) == np.ndim(leaves[0]) else 0, *shared
    )
    commands = Command(times, values)  # type: ignore[arg-type]
    stacked = with_asked(jax.tree.map(stack, *shared), commands, gait_times, gaits)
    own_axes = with_asked(axes, Command(0, 0), 0, 0)  # type: ignore[arg-type]
    return jax.tree.map(jnp.asarray, stacked), own_axes


def rows_of(tables: Tables, axes: Any, rows: slice) -> Tables:
    """Tables of some robots of a batch."""
    return jax.tree.map(
        lambda axis, leaf: leaf if axis is None else jnp.asarray(leaf[rows]),
        axes,
        tables,
        is_leaf=lambda a: a is None,
    )


def scene_models(
    robot: Robot, model: mujoco.MjModel, episodes: Sequence[Episode]
) -> list[mujoco.MjModel]:
    """A copy of the scene for each episode's world; equal ones once."""
    made: dict[Hashable, mujoco.MjModel] = {}
    out = []
    for episode in episodes:
        key = episode.world.key()
        if key not in made:
            made[key] = copy(model)
            apply_world(robot, made[key], episode.world)
        out.append(made[key])
    return out


def _filled(values: Any, count: int, rest: Any) -> np.ndarray:
    """Values, filled up to ``count`` of them."""
    values = np.asarray(values, float)
    more = np.broadcast_to(np.asarray(rest, float), (count - len(values), *values.shape[1:]))
    return np.concatenate([values, more])
