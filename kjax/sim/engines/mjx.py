"""Many robots on MJX: physics, phase clock, QP and legs of a whole batch in one compiled program.

Outer scan over control ticks, inner scan over physics steps, so that a plan is computed where it
is due and nowhere else, also under ``vmap``. What differs between the robots' models (terrain,
friction, masses) is batched; everything else is held once.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from kjax.controllers.params import Tables
from kjax.robots import get_robot
from kjax.sim.batching import scene_models, stack_tables
from kjax.sim.closed_loop import LoopState, Sensed, TickLog, build_closed_loop, delayed_torque
from kjax.sim.engines.contract import (
    OnProgress,
    Torques,
    check_delay,
    require_one_batch,
    require_options,
)
from kjax.sim.episode import (
    BatchSpec,
    Episode,
    EpisodeParams,
    SceneSpec,
    initial_state,
    push_at,
    stack_params,
)
from kjax.sim.mjx_import import mjx, mjx_step
from kjax.sim.observe import find_addresses
from kjax.sim.recording import Recording, recording_of_ticks
from kjax.sim.scene import build_spec
from kjax.sim.tick_stats import TickStats, Window

_PIECE = 50  # control ticks of one compiled call; between two of them Ctrl-C and progress


class MjxTick(NamedTuple):
    """What is recorded of a control tick, at its beginning, the torque in its first step, and more.

    ``stats``: of its physics steps.
    """

    qpos: Float[Array, "nq"]
    qvel: Float[Array, "nv"]
    torque: Float[Array, "12"]
    log: TickLog
    stats: TickStats


class MjxState(NamedTuple):
    """What is carried: MJX's data, the robot's state, torques under way (D, nu), steps done."""

    data: Any
    walk: LoopState
    under_way: Float[Array, "D nu"]
    step: Array


def build_model(scene: SceneSpec) -> mujoco.MjModel:
    """The scene with the options that MJX needs: few solver iterations, feet-only contacts."""
    _check_scene(scene)
    spec = build_spec(get_robot(scene.robot), scene, visual=False)
    spec.option.iterations = 6
    spec.option.ls_iterations = 8
    return spec.compile()


class MjxEngine:
    """MJX for batches of episodes with one spec; the same calls as ``BatchEngine``.

    Compiles once per number of robots and kind of difference between them. A batch whose number of
    robots is a multiple of the number of local devices is sharded over them.

    Attributes:
      spec: what all episodes have in common.
      model: the C model that MJX's was made from.
      torques: see ``engines.mujoco_batch.BatchEngine``.
      traces: how often the program has been traced.
    """

    def __init__(
        self,
        spec: BatchSpec,
        *,
        torques: Torques = "every_step",
        threads: int | None = None,
        dtype: Any = np.float32,
        impl: str | None = None,
    ):
        """Scene and functions; nothing is compiled yet.

        Args:
          spec: of the episodes to come.
          torques: ``"every_step"`` or ``"held"``.
          threads: of no effect: XLA has its own.
          dtype: floating type of controller and physics; float64 needs ``jax_enable_x64``.
          impl: implementation of MJX, e.g. ``"warp"`` on an NVIDIA GPU; its own choice if ``None``.
        """
        require_options(spec, torques)
        self.spec, self.torques, self.dtype = spec, torques, np.dtype(dtype)
        self.model = build_model(spec.scene)
        self.traces = 0
        self._mjx = self._cast(mjx.put_model(self.model, impl=impl))
        self._impl = impl
        self._robot = get_robot(spec.scene.robot)
        self._at = find_addresses(self._robot, self.model)
        self._loop = build_closed_loop(self._robot, spec, self.model, held=torques == "held")
        self._per_tick = spec.per_tick
        # Physics steps that share a torque.
        self._unit = spec.per_tick if torques == "held" else spec.per_act
        self._calls: dict[Any, tuple[Callable[..., Any], Callable[..., Any]]] = {}

    def run(self, episodes: Sequence[Episode], on_progress: OnProgress | None = None) -> Recording:
        """Closed loops of all episodes, each until its end or its fall.

        On Ctrl-C what was walked is returned, marked as interrupted.

        Raises:
          ValueError: for an episode with another spec, or other durations.
        """
        require_one_batch(self.spec, episodes, self.torques)
        tables, axes = stack_tables(episodes, self.dtype)
        models = scene_models(self._robot, self.model, episodes)
        params, (own, own_axes) = stack_params(episodes), self._differences(models)
        sensed, warm = self._start(episodes, models)
        delays = 1 + int(params.delay.max()) // self._unit
        ticks = episodes[0].ticks
        begin_call, run_call = self._compiled(axes, own_axes, delays)
        place = _sharding(len(episodes))
        if place:
            params, sensed, warm = jax.device_put((params, sensed, warm), place)
            tables, own = _spread(tables, axes, place), _spread(own, own_axes, place)
        begin, pieces, interrupted = time.perf_counter(), [], False
        state = begin_call(tables, params, sensed, warm)
        try:
            for done in range(0, ticks, _PIECE):
                count = min(_PIECE, ticks - done)
                # The last piece may be shorter than it is computed: one program for all.
                state, piece = run_call(tables, own, params, state)
                pieces.append(jax.device_get(jax.tree.map(lambda a, n=count: a[:n], piece)))
                if on_progress is not None:
                    on_progress((done + count) * len(episodes), ticks * len(episodes))
                if not pieces[-1].log.alive[-1].any():
                    break
        except KeyboardInterrupt:
            interrupted = True
            if not pieces:
                raise
        record = jax.tree.map(lambda *parts: np.concatenate(parts), *pieces)
        alive = np.asarray(record.log.alive)
        fell = ~alive[-1]
        legs, sign = self._at.actuator.reshape(-1), self._at.sign.reshape(-1)
        return recording_of_ticks(
            episodes,
            self.spec.controller.control_dt,
            ticks=np.where(fell, 1 + np.argmin(alive, axis=0), len(alive)),
            fell=fell,
            qpos=record.qpos,
            qvel=record.qvel,
            torque=sign * record.torque[..., legs],
            log=record.log,
            stats=record.stats,
            wall_time=time.perf_counter() - begin,
            interrupted=interrupted,
        )

    def _start(
        self, episodes: Sequence[Episode], models: Sequence[mujoco.MjModel]
    ) -> tuple[Sensed, Array]:
        """What the robots are at first, and the solver's start: by C, which need not compile."""
        rows = []
        for episode, model in zip(episodes, models, strict=True):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = initial_state(episode.start, model, self._at)
            mujoco.mj_forward(model, data)
            rows.append((data.qpos, data.qvel, data.sensordata, data.qacc_warmstart))
        *sensed, warm = (jnp.asarray(np.stack(a), self.dtype) for a in zip(*rows, strict=True))
        return Sensed(*sensed), warm

    def _differences(
        self, models: Sequence[mujoco.MjModel]
    ) -> tuple[dict[str, Any], dict[str, int | None]]:
        """Fields of MJX's model that are not the scene's: stacked, or single where all agree.

        Returns:
          The fields, and for each its axis of robots, 0 or ``None``.
        """
        own: dict[str, Any] = {}
        axes: dict[str, int | None] = {}
        for name in _MODEL_FIELDS:
            values = [getattr(model, name) for model in models]
            if not all(np.array_equal(value, values[0]) for value in values):
                own[name], axes[name] = jnp.asarray(np.stack(values), self.dtype), 0
            elif not np.array_equal(values[0], getattr(self.model, name)):
                own[name], axes[name] = jnp.asarray(values[0], self.dtype), None
        return own, axes

    def _cast(self, tree: Any) -> Any:
        def leaf(a: Any) -> Any:
            if isinstance(a, jax.Array) and jnp.issubdtype(a.dtype, jnp.floating):
                return a.astype(self.dtype)
            return a

        return jax.tree.map(leaf, tree)

    @staticmethod
    def check(spec: BatchSpec, params: EpisodeParams, torques: Torques) -> None:
        """Raise a ValueError that says why this engine cannot walk an episode, if it cannot."""
        check_delay(spec, params, torques)
        _check_scene(spec.scene)

    def _compiled(
        self, axes: Any, own_axes: dict[str, int | None], delays: int
    ) -> tuple[Callable[..., Any], Callable[..., Any]]:
        """Jitted functions of a batch: begin, and walk a piece."""
        leaves, tree = jax.tree.flatten(axes, is_leaf=lambda a: a is None)
        key = (tuple(leaves), tree, tuple(own_axes.items()), delays)
        if key not in self._calls:

            def begin(tables: Any, params: EpisodeParams, sensed: Sensed, warm: Array) -> MjxState:
                return self._begin(tables, params, sensed, warm, delays)

            def piece(tables: Any, own: Any, params: EpisodeParams, state: MjxState) -> Any:
                self.traces += 1
                return self._run_piece(tables, own, params, state)

            self._calls[key] = (
                jax.jit(jax.vmap(begin, (axes, 0, 0, 0))),
                jax.jit(jax.vmap(piece, (axes, own_axes, 0, 0), out_axes=(0, 1)), donate_argnums=3),
            )
        return self._calls[key]

    def _begin(
        self, tables: Tables, params: EpisodeParams, sensed: Sensed, warm: Array, delays: int
    ) -> MjxState:
        data = self._cast(mjx.make_data(self._mjx, **_impl_argument(self._impl)))
        # Through .at[], since a replaced host array has another layout and compiles twice.
        data = data.replace(
            qpos=data.qpos.at[:].set(sensed.qpos),
            qvel=data.qvel.at[:].set(sensed.qvel),
            sensordata=data.sensordata.at[:].set(sensed.sensordata),
            qacc_warmstart=data.qacc_warmstart.at[:].set(warm),
        )
        return MjxState(
            data=data,
            walk=self._loop.init(
                tables, self._loop.noise(params, jnp.zeros((), jnp.int32)), _sensed(data)
            ),
            under_way=jnp.zeros((delays, self.model.nu), self.dtype),
            step=jnp.zeros((), jnp.int32),
        )

    def _run_piece(
        self, tables: Tables, own: dict[str, Array], params: EpisodeParams, state: MjxState
    ) -> tuple[MjxState, MjxTick]:
        model, loop, unit = self._mjx.replace(**own), self._loop, self._unit
        trunk = self._at.trunk

        def physics(data: Any, torque: Array, step: Array, alive: Array) -> Any:
            push = push_at(params, step, xp=jnp).astype(self.dtype)
            pushes = jnp.zeros_like(data.xfrc_applied).at[trunk, :3].set(push)
            stepped = mjx_step(model, data.replace(ctrl=torque, xfrc_applied=pushes))
            # A robot that has fallen stays as it is, whatever its state has become.
            return jax.tree.map(
                lambda new, old: jnp.where(alive, new, old), _same_types(stepped, data), data
            )

        def act(carry: MjxState, _: None) -> tuple[MjxState, tuple[Array, Sensed]]:
            data, robot, under_way, at = carry
            robot, torque = loop.act(tables, robot, loop.noise(params, at), _sensed(data))
            under_way, applied = delayed_torque(under_way, torque, at // unit, params.delay // unit)

            def onward(data: Any, i: Array) -> tuple[Any, Sensed]:
                return physics(data, applied, at + i, robot.alive), _sensed(data)

            if unit == 1:
                before = jax.tree.map(lambda a: a[None], _sensed(data))
                data = physics(data, applied, at, robot.alive)
            else:
                data, before = jax.lax.scan(onward, data, jnp.arange(unit, dtype=jnp.int32))
            return MjxState(data, robot, under_way, at + unit), (torque, before)

        def tick(carry: MjxState, _: None) -> tuple[MjxState, MjxTick]:
            data, robot, under_way, at = carry
            noise = loop.noise(params, at)
            robot, log = loop.plan(tables, params.origin, robot, noise, _sensed(data))
            carry = MjxState(data, robot, under_way, at)
            calls = self._per_tick // unit
            after, (torques, before) = jax.lax.scan(act, carry, None, length=calls)
            states = jax.tree.map(
                lambda steps, last: jnp.concatenate([steps.reshape(-1, last.size), last[None]]),
                before,
                _sensed(after.data),
            )
            window = Window(
                qpos=states.qpos,
                qvel=states.qvel,
                sensordata=states.sensordata,
                torque=jnp.repeat(torques, unit, axis=0),
            )
            wanted = log.velocity_command, log.velocity_reference
            track = after.walk.track
            stats = loop.stats(tables.params.robot, track, params.origin, window, *wanted)
            return after, MjxTick(data.qpos, data.qvel, torques[0], log, stats)

        return jax.lax.scan(tick, state, None, length=_PIECE)


ENGINE = MjxEngine


def _check_scene(scene: SceneSpec) -> None:
    if scene.contacts != "feet" or scene.cone != "pyramidal":
        raise ValueError(
            "MJX needs sim.contacts = 'feet' and sim.cone = 'pyramidal', got "
            f"'{scene.contacts}' and '{scene.cone}'"
        )


# What ``scene.apply_world`` may change, with what follows from it.
_MODEL_FIELDS = (
    "geom_pos", "geom_quat", "geom_size", "geom_friction", "geom_rbound", "geom_aabb",
    "body_mass", "body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0",
    "actuator_acc0",
)  # fmt: skip


def _sensed(data: Any) -> Sensed:
    return Sensed(data.qpos, data.qvel, data.sensordata)


def _same_types(new: Any, old: Any) -> Any:
    """``new`` with the dtypes of ``old``: in float64 some contact ids change their width."""
    return jax.tree.map(lambda a, b: a.astype(b.dtype) if hasattr(a, "astype") else a, new, old)


def _impl_argument(impl: str | None) -> dict[str, str]:
    return {} if impl is None else {"impl": impl}


def _sharding(robots: int) -> NamedSharding | None:
    """The batch axis over all local devices; ``None`` where there is one, or it does not divide."""
    devices = jax.local_devices()
    if len(devices) == 1 or robots % len(devices):
        return None
    mesh = jax.sharding.Mesh(np.array(devices), ("robots",))
    return NamedSharding(mesh, PartitionSpec("robots"))


def _spread(tables: Any, axes: Any, place: NamedSharding) -> Any:
    """Parameters on all devices, those of single robots on the robot's own."""
    everywhere = NamedSharding(place.mesh, PartitionSpec())
    return jax.tree.map(
        lambda axis, leaf: jax.device_put(leaf, everywhere if axis is None else place),
        axes,
        tables,
        is_leaf=lambda a: a is None,
    )
