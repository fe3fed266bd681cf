"""Many robots in C MuJoCo: MuJoCo's batches, and one jitted controller call for all robots a tick.

The robots are split into as many groups as there are threads. Each group has a batch of its own
and a Python thread that takes turns between controller and physics; both release the interpreter,
so that no core waits for another.

Every robot has its own ``MjModel``, so terrain, friction and payload may differ, and its physics is
that of a single run to the last bit.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from threading import Event
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np

from kjax.controllers.params import Tables
from kjax.robots import get_robot
from kjax.sim.batching import rows_of, scene_models, stack_tables
from kjax.sim.closed_loop import LoopState, Sensed, TickLog, build_closed_loop
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
    initial_state,
    push_at,
    stack_params,
)
from kjax.sim.observe import find_addresses
from kjax.sim.recording import Recording, empty_log, recording_of_ticks
from kjax.sim.scene import build_model
from kjax.sim.tick_stats import TickStats, empty_stats, empty_windows
from kjax.threads import usable_cores

_WAIT = 0.1  # s between two looks at the threads
_READ = 10  # ticks whose physics steps are read in one call


class Calls(NamedTuple):
    """Jitted functions of a group, batched over its robots.

    Attributes:
      init: (tables, params, sensed) -> state.
      first: (tables, params, state, step, sensed) -> (state, torque, log); plan and act.
      then: the same without plan -> (state, torque).
      stats: (robot, track, origin, windows, commands, references) -> stats of some ticks.
    """

    init: Callable[..., LoopState]
    first: Callable[..., tuple[LoopState, Any, TickLog]]
    then: Callable[..., tuple[LoopState, Any]]
    stats: Callable[..., TickStats]


class BatchEngine:
    """C MuJoCo for batches of episodes with one spec.

    Compiles once per number of robots and kind of difference between them.

    Attributes:
      spec: what all episodes have in common.
      model: MuJoCo model of the scene.
      torques: ``"every_step"``: at every physics step, as on the robot; ``"held"``: at the control
        rate, held in between, several times cheaper.
      threads: number of groups.
    """

    def __init__(
        self,
        spec: BatchSpec,
        *,
        torques: Torques = "every_step",
        threads: int | None = None,
        dtype: Any = np.float32,
    ):
        """Scene and controller functions; nothing is compiled yet.

        Args:
          spec: of the episodes to come.
          torques: see the class.
          threads: as many as this process may use cores if ``None``.
          dtype: floating type of the controller.
        """
        require_options(spec, torques)
        if threads is not None and threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self.spec, self.torques, self.dtype = spec, torques, np.dtype(dtype)
        self.threads = usable_cores() if threads is None else threads
        robot = get_robot(spec.scene.robot)
        self.model = build_model(robot, spec.scene, visual=False)
        self._loop = build_closed_loop(robot, spec, self.model, held=torques == "held")
        self._calls: dict[Any, Calls] = {}

    def run(self, episodes: Sequence[Episode], on_progress: OnProgress | None = None) -> Recording:
        """Closed loops of all episodes, each until its end or its fall.

        On Ctrl-C what was walked is returned, marked as interrupted.

        Raises:
          ValueError: for an episode with another spec, or other durations.
        """
        require_one_batch(self.spec, episodes, self.torques)
        threads = min(self.threads, len(episodes))
        size = -(-len(episodes) // threads)
        filled = [*episodes, *[episodes[-1]] * (threads * size - len(episodes))]
        tables, axes = stack_tables(filled, self.dtype)
        params = stack_params(filled)
        calls = self._compiled(axes)
        stop, groups = Event(), []
        for first in range(0, len(filled), size):
            own = slice(first, first + size)
            groups.append(
                _Group(
                    self,
                    filled[own],
                    calls,
                    stop,
                    tables=rows_of(tables, axes, own),
                    params=jax.tree.map(lambda a, s=own: a[s], params),
                )
            )
        groups[0].warm_up()  # compile in one thread
        begin = time.perf_counter()
        interrupted = _run_threads(groups, stop, on_progress)
        wall = time.perf_counter() - begin
        done = [group.result() for group in groups]
        parts = [
            np.concatenate(arrays, axis=-1) for arrays in zip(*(d[:2] for d in done), strict=True)
        ]
        series = [
            np.concatenate(arrays, axis=1)[:, : len(episodes)]
            for arrays in zip(*(d[2:] for d in done), strict=True)
        ]
        stats = len(TickStats._fields)
        return recording_of_ticks(
            episodes,
            self.spec.controller.control_dt,
            ticks=parts[0][: len(episodes)],
            fell=parts[1][: len(episodes)],
            qpos=series[0],
            qvel=series[1],
            torque=series[2],
            log=TickLog(*series[3:-stats]),
            stats=TickStats(*series[-stats:]),
            wall_time=wall,
            interrupted=interrupted,
        )

    @staticmethod
    def check(spec: BatchSpec, params: EpisodeParams, torques: Torques) -> None:
        """Raise a ValueError that says why this engine cannot walk an episode, if it cannot."""
        check_delay(spec, params, torques)

    def _compiled(self, axes: Any) -> Calls:
        """Batched and jitted functions for parameters with these axes."""
        leaves, tree = jax.tree.flatten(axes, is_leaf=lambda a: a is None)
        key = (tuple(leaves), tree)
        if key not in self._calls:
            loop = self._loop

            def init(tables: Any, params: Any, sensed: Any) -> Any:
                return loop.init(tables, loop.noise(params, jnp.zeros((), jnp.int32)), sensed)

            def first(tables: Any, params: Any, state: Any, step: Any, sensed: Any) -> Any:
                noise = loop.noise(params, step)
                state, log = loop.plan(tables, params.origin, state, noise, sensed)
                state, torque = loop.act(tables, state, noise, sensed)
                return state, torque, log

            def then(tables: Any, params: Any, state: Any, step: Any, sensed: Any) -> Any:
                return loop.act(tables, state, loop.noise(params, step), sensed)

            # All else is the same in every tick of an episode.
            stats = jax.vmap(loop.stats, (None, None, None, 0, 0, 0))
            robots = axes.params.robot

            self._calls[key] = Calls(
                init=jax.jit(jax.vmap(init, (axes, 0, 0))),
                # The old state is given up, so that what stays the same is not copied.
                first=jax.jit(jax.vmap(first, (axes, 0, 0, None, 0)), donate_argnums=2),
                then=jax.jit(jax.vmap(then, (axes, 0, 0, None, 0)), donate_argnums=2),
                stats=jax.jit(jax.vmap(stats, (robots, 0, 0, 0, 0, 0))),
            )
        return self._calls[key]


ENGINE = BatchEngine


class _Group:
    """The robots of one thread."""

    def __init__(
        self,
        engine: BatchEngine,
        episodes: Sequence[Episode],
        calls: Calls,
        stop: Event,
        *,
        tables: Tables,
        params: EpisodeParams,
    ):
        model, spec, count = engine.model, engine.spec, len(episodes)
        self._calls, self._stop, self._dtype = calls, stop, engine.dtype
        self._tables, self._params = tables, params
        self._per_tick = spec.per_tick
        # Physics steps that share a torque.
        self._unit = spec.per_tick if engine.torques == "held" else spec.per_act
        self.ticks = episodes[0].ticks
        self.done = 0
        robot = get_robot(spec.scene.robot)
        models, at = scene_models(robot, model, episodes), find_addresses(robot, model)
        self._batch = mujoco.batch.Batch(models[0], nsim=count, nthread=1)
        if any(one is not models[0] for one in models):
            self._batch.set_models(models)
        bind = self._batch.bind
        self._qpos, self._qvel = bind("qpos"), bind("qvel")
        self._sensordata, self._ctrl = bind("sensordata"), bind("ctrl")
        self._pushes = bind("xfrc_applied")[:, at.trunk, :3]
        for i, one in enumerate(episodes):
            self._qpos[i], self._qvel[i] = initial_state(one.start, model, at)
        self._batch.forward()
        self._legs, self._sign = at.actuator.reshape(-1), at.sign.reshape(-1)
        self._pushed = bool((params.push_steps > 0).any())
        # Torques on their way to the joints, a ring of as many as the longest delay.
        self._ring = np.zeros((1 + int(params.delay.max()) // self._unit, count, model.nu))
        self._delay = params.delay // self._unit
        self.fell_at = np.full(count, self.ticks)
        self.fell = np.zeros(count, bool)
        # The physics steps of the last ticks, until they are read, and what was asked in each.
        self._windows = empty_windows(model, count, _READ, self._per_tick, self._dtype)
        self._asked = np.zeros((2, count, _READ), self._dtype)
        self._kept = 0
        self._record: list[Any] = []

    def sensed(self) -> Sensed:
        """What the controller sees, in its type."""
        return Sensed(
            *(
                np.asarray(field, self._dtype)
                for field in (self._qpos, self._qvel, self._sensordata)
            )
        )

    def warm_up(self) -> None:
        """Compile by calling, results dropped."""
        sensed, step = self.sensed(), np.int32(0)
        state = self._calls.init(self._tables, self._params, sensed)
        state, *rest = self._calls.first(self._tables, self._params, state, step, sensed)
        if self._unit < self._per_tick:
            state, *rest = self._calls.then(self._tables, self._params, state, step, sensed)
        jax.block_until_ready((state, rest, self._read(state)))

    def walk(self) -> None:
        """All ticks, until told to stop."""
        tables, params = self._tables, self._params
        state = self._calls.init(tables, params, self.sensed())
        alive = np.ones(len(self.fell), bool)
        ids: np.ndarray | None = None  # all
        series: tuple[np.ndarray, ...] = ()
        stats = empty_stats(self.ticks, len(alive), self._dtype)
        for tick in range(self.ticks):
            if self._stop.is_set() or not alive.any():
                break
            step, sensed = tick * self._per_tick, self.sensed()
            state, torque, log = self._calls.first(tables, params, state, np.int32(step), sensed)
            host = TickLog(*map(np.asarray, log))
            torque = np.asarray(torque)
            if not series:
                series = self._arrays(host)
            for array, value in zip(
                series,
                (self._qpos, self._qvel, self._sign * torque[:, self._legs], *host),
                strict=True,
            ):
                array[tick] = value
            still = host.alive
            if not still[alive].all():
                fallen = alive & ~still
                self.fell_at[fallen], self.fell[fallen] = tick + 1, True
                alive = alive & still
                ids = np.flatnonzero(alive)
                if not len(ids):
                    break
            self._asked[:, :, self._kept] = host.velocity_command, host.velocity_reference
            state = self._steps(state, torque, step, ids)
            self._kept += 1
            self.done = tick + 1
            if self._kept == _READ:
                self._read_into(stats, state)
        self._read_into(stats, state)
        self._record = [*series, *stats]

    def _steps(
        self, state: LoopState, torque: np.ndarray, step: int, ids: np.ndarray | None
    ) -> LoopState:
        """The physics steps of a tick, which are left in the windows."""
        for i in range(0, self._per_tick, self._unit):
            if i > 0:
                state, later = self._calls.then(
                    self._tables, self._params, state, np.int32(step + i), self.sensed()
                )
                torque = np.asarray(later)
            self._apply(torque, step + i)
            for j in range(i, i + self._unit):
                self._note(j, torque)
                self._advance(ids)
        self._note(self._per_tick)
        return state

    def _read(self, state: LoopState) -> TickStats:
        """Stats (robots, ticks) of the windows that are kept; further ones mean nothing."""
        robot, origin = self._tables.params.robot, self._params.origin
        return self._calls.stats(robot, state.track, origin, self._windows, *self._asked)

    def _read_into(self, stats: TickStats, state: LoopState) -> None:
        """Write the stats of the ticks that are kept, the last ones done, and keep none."""
        if self._kept:
            done = slice(self.done - self._kept, self.done)
            for series, found in zip(stats, self._read(state), strict=True):
                series[done] = np.moveaxis(np.asarray(found), 1, 0)[: self._kept]
        self._kept = 0

    def _apply(self, torque: np.ndarray, step: int) -> None:
        """Torques, delayed, and pushes for the physics steps from ``step`` on."""
        if len(self._ring) > 1:
            place = step // self._unit
            self._ring[place % len(self._ring)] = torque
            when = (place - self._delay) % len(self._ring)
            torque = self._ring[when, np.arange(len(torque))]
        self._ctrl[:] = torque
        if self._pushed:
            self._pushes[:] = push_at(self._params, step, self._unit)

    def _note(self, place: int, torque: np.ndarray | None = None) -> None:
        """Keep the state before a step of the tick, or after its last, and the torque."""
        windows, where = self._windows, (slice(None), self._kept, place)
        windows.qpos[where], windows.qvel[where] = self._qpos, self._qvel
        windows.sensordata[where] = self._sensordata
        if torque is not None:
            windows.torque[where] = torque

    def _advance(self, ids: np.ndarray | None) -> None:
        """A physics step of the robots that are alive."""
        try:
            self._batch.step(ids=ids)
        except mujoco.batch.SimulationError as error:
            # They kept their state: make it one that counts as a fall in the next tick.
            self._qpos[np.asarray(error.ids)] = np.nan

    def _arrays(self, log: TickLog) -> tuple[np.ndarray, ...]:
        count = len(self.fell)
        qpos, qvel = (np.zeros((self.ticks, *field.shape)) for field in (self._qpos, self._qvel))
        torque = np.zeros((self.ticks, count, len(self._legs)), self._dtype)
        return qpos, qvel, torque, *empty_log(self.ticks, log)

    def result(self) -> tuple[np.ndarray, ...]:
        """Ticks done, falls, and the series."""
        did = np.minimum(self.fell_at, self.done) if self._stop.is_set() else self.fell_at
        return (np.where(self.fell, self.fell_at, did), self.fell, *self._record)


def _run_threads(groups: list[_Group], stop: Event, on_progress: OnProgress | None) -> bool:
    """Run all groups to their end; whether Ctrl-C stopped them."""
    robots = [len(group.fell) for group in groups]
    total = sum(group.ticks * count for group, count in zip(groups, robots, strict=True))
    interrupted = False
    with ThreadPoolExecutor(len(groups)) as pool:
        futures = [pool.submit(group.walk) for group in groups]
        while True:
            try:
                _, left = wait(futures, timeout=_WAIT)
                if on_progress is not None:
                    done = (group.done * n for group, n in zip(groups, robots, strict=True))
                    on_progress(sum(done) if left else total, total)
                if not left:
                    break
            except KeyboardInterrupt:
                interrupted = True
                stop.set()
    for future in futures:
        future.result()
    return interrupted
