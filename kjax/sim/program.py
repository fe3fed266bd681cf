"""A controller's calls on flat vectors, for one robot that a loop in Python drives."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from kjax.controllers.params import Tables, condense, with_params
from kjax.robots import Robot
from kjax.sim.closed_loop import LoopState, Noise, Sensed, TickLog, build_closed_loop
from kjax.sim.episode import Episode
from kjax.sim.noise import noise_dim
from kjax.types import Command


class Requests(NamedTuple):
    """What is asked of the controller in one episode; data, so that no episode recompiles.

    Attributes:
      gait_times: (K,) when each gait is asked for [s].
      command: what is asked over time.
      origin: (3,) where the robot starts, on the floor, world [m].
    """

    gait_times: Any
    command: Command
    origin: Any


class _Carried(NamedTuple):
    """What goes from call to call."""

    loop: LoopState
    requests: Requests


class Program(NamedTuple):
    """The compiled calls of one controller, on flat vectors.

    Passing pytrees costs 2 us per leaf and call, more than the controller itself. So the calls take
    one vector of sensor values (qpos, qvel, sensordata, and the noise on sensors and forces), and
    keep the controller's state and the episode's requests in another.

    Attributes:
      tables: of the controller; compiled in.
      init: (sensed, requests) -> state.
      plan: (state, sensed) -> (state, log).
      act: (state, sensed) -> (state, torque (12,) in actuator order).
      unpack_log: log vectors (P, n) -> ``TickLog`` of arrays with a leading axis P.
    """

    tables: Tables
    init: Callable[[ArrayLike, Requests], Array]
    plan: Callable[[ArrayLike, ArrayLike], tuple[Array, Array]]
    act: Callable[[ArrayLike, ArrayLike], tuple[Array, Array]]
    unpack_log: Callable[[np.ndarray], TickLog]


def requests(episode: Episode) -> Requests:
    """What an episode asks of the controller."""
    asked = episode.controller
    return Requests(asked.gait_times, asked.command, episode.params.origin)


def build_program(
    episode: Episode, robot: Robot, model: mujoco.MjModel, *, held: bool, dtype: Any = None
) -> Program:
    """The compiled calls for an episode, and for others that differ in what is data.

    Args:
      episode: whose controller it is.
      robot: who walks.
      model: of the scene.
      held: whether ``act`` is called once per control tick.
      dtype: floating type; JAX's default if ``None``.
    """
    spec, scene = episode.spec, episode.spec.scene
    tables = condense(spec.controller, episode.controller, dtype=dtype)
    loop = build_closed_loop(robot, spec, model, held=held)
    kind = tables.params.position_slack.dtype
    parts = [model.nq, model.nv, model.nsensordata]
    parts += [noise_dim(scene.base) * scene.noise, 4 * scene.force_noise]
    cuts = np.cumsum(parts[:-1])

    def split(sensed: Array) -> tuple[Noise, Sensed]:
        qpos, qvel, sensordata, sensors, force = jnp.split(sensed, cuts)
        return Noise(sensors, force), Sensed(qpos, qvel, sensordata)

    def pack(tree: _Carried | TickLog) -> Array:
        return _pack(tree, kind)

    def with_requests(wanted: Requests) -> Tables:
        return with_params(tables, gait_times=wanted.gait_times, command=wanted.command)

    def begin(sensed: Array, wanted: Requests) -> _Carried:
        wanted = jax.tree.map(lambda leaf: jnp.asarray(leaf, kind), wanted)
        return _Carried(loop.init(with_requests(wanted), *split(sensed)), wanted)

    def plan_log(carried: _Carried, sensed: Array) -> tuple[_Carried, TickLog]:
        wanted = carried.requests
        state, log = loop.plan(with_requests(wanted), wanted.origin, carried.loop, *split(sensed))
        return _Carried(state, wanted), log

    def init(sensed: Array, wanted: Requests) -> Array:
        return pack(begin(sensed, wanted))

    def plan(flat: Array, sensed: Array) -> tuple[Array, Array]:
        carried, log = plan_log(_unpack(flat, state_like), sensed)
        return pack(carried), pack(log)

    def act(flat: Array, sensed: Array) -> tuple[Array, Array]:
        carried = _unpack(flat, state_like)
        state, torque = loop.act(with_requests(carried.requests), carried.loop, *split(sensed))
        return pack(_Carried(state, carried.requests)), torque

    example = jax.ShapeDtypeStruct((sum(parts),), kind)
    wanted = requests(episode)
    state_like = jax.eval_shape(begin, example, wanted)
    _, log_like = jax.eval_shape(plan_log, state_like, example)
    program = Program(
        tables=tables,
        init=jax.jit(init),
        plan=jax.jit(plan),
        act=jax.jit(act),
        unpack_log=lambda flat: jax.device_get(jax.vmap(lambda one: _unpack(one, log_like))(flat)),
    )
    # Compile here, so that the loop's first tick is like its others; the results are dropped.
    sensed = np.zeros(example.shape)
    state = program.init(sensed, wanted)
    jax.block_until_ready((program.plan(state, sensed), program.act(state, sensed)))
    return program


def _pack(tree: Any, kind: Any) -> Array:
    """All leaves of a tree in one vector."""
    return jnp.concatenate([jnp.ravel(a).astype(kind) for a in jax.tree.leaves(tree)])


def _unpack(flat: Array, like: Any) -> Any:
    """The tree that ``_pack`` made a vector of; shapes and types as in ``like``."""
    leaves, shape = jax.tree.flatten(like)
    pieces = jnp.split(flat, np.cumsum([leaf.size for leaf in leaves])[:-1])
    return jax.tree.unflatten(
        shape,
        [
            piece.reshape(leaf.shape).astype(leaf.dtype)
            for piece, leaf in zip(pieces, leaves, strict=True)
        ],
    )
