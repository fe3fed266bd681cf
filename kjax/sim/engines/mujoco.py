"""One robot at a time in C MuJoCo: the physics steps in C, the controller in two jitted calls."""

import dataclasses
import signal
import threading
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from typing import Any

import mujoco
import numpy as np

from kjax.robots import get_robot
from kjax.sim.closed_loop import TickLog
from kjax.sim.engines.contract import OnProgress, Torques, require_one_spec, require_options
from kjax.sim.episode import BatchSpec, Episode, EpisodeParams, initial_state, push_at
from kjax.sim.noise import force_noise, noise_dim, sensor_noise
from kjax.sim.observe import build_observe, find_addresses
from kjax.sim.program import Program, build_program, requests
from kjax.sim.recording import Recording, concatenate
from kjax.sim.scene import apply_world, build_model
from kjax.sim.trajectory import Trajectory, sagittal

# Called once per control tick with the steps done, the steps in all and the data; return value
# ignored. For progress bars and viewers.
OnTick = Callable[[int, int, mujoco.MjData], None]

_KEPT = 4  # programs that an engine keeps
_NOISE_TICKS = 1000  # noise is drawn for so many ticks at once


class MujocoEngine:
    """C MuJoCo, one robot after the other, every physics step recorded; see ``engines``.

    A program is compiled for each controller: episodes may differ in seed, command, times of gaits,
    terrain, friction, payload, pushes, delay, place and heading of the start without another one.

    Attributes:
      spec: what all episodes have in common.
      torques: see ``engines.contract``.
      robot: who walks.
      model: of the scene.
      addresses: of the robot in it.
      observe: (qpos, qvel, sensordata) -> observation.
    """

    def __init__(
        self,
        spec: BatchSpec,
        *,
        torques: Torques = "every_step",
        threads: int | None = None,
        dtype: Any = None,
    ):
        """The scene; the controller is compiled by ``program``, or in the first run.

        Args:
          spec: of the episodes to come.
          torques: ``"every_step"``, or ``"held"`` for a control tick.
          threads: of no effect: one robot walks at a time.
          dtype: floating type of the controller; JAX's default if ``None``.
        """
        require_options(spec, torques)
        self.spec, self.torques, self._dtype = spec, torques, dtype
        self.robot = get_robot(spec.scene.robot)
        self.model = build_model(self.robot, spec.scene)
        self.addresses = find_addresses(self.robot, self.model)
        self.observe = build_observe(self.robot, self.model, spec.scene.contact_threshold)
        self._programs: dict[Hashable, Program] = {}

    def run(self, episodes: Sequence[Episode], on_progress: OnProgress | None = None) -> Recording:
        """Closed loops of all episodes, one after the other, each until its end or its fall.

        On Ctrl-C what was walked is returned, marked as interrupted.

        Raises:
          ValueError: for an episode with another spec.
        """
        require_one_spec(self.spec, episodes)
        steps = [one.ticks * self.spec.per_tick for one in episodes]
        parts: list[Recording] = []
        for number, episode in enumerate(episodes):
            before = sum(steps[:number])

            def on_tick(done: int, total: int, data: Any, before: int = before) -> None:
                if on_progress is not None:
                    on_progress(before + done, sum(steps))

            try:
                parts.append(self._walk(episode, on_tick))
            except KeyboardInterrupt:  # before there was anything of this one to keep
                if not parts:
                    raise
                parts[-1] = dataclasses.replace(parts[-1], interrupted=True)
            if parts[-1].interrupted:
                break
        return concatenate(parts)

    @staticmethod
    def check(spec: BatchSpec, params: EpisodeParams, torques: Torques) -> None:
        """This engine walks every episode."""

    def program(self, episode: Episode) -> Program:
        """The compiled calls for an episode."""
        key = (episode.controller_key, len(episode.controller.command.times))
        if key not in self._programs:
            while len(self._programs) >= _KEPT:
                del self._programs[next(iter(self._programs))]
            self._programs[key] = build_program(
                episode, self.robot, self.model, held=self.torques == "held", dtype=self._dtype
            )
            # The noise's program as well: a Ctrl-C in a compilation can take the process down.
            _Inputs(self, episode, mujoco.MjData(self.model)).at(0)
        return self._programs[key]

    def _walk(self, episode: Episode, on_tick: OnTick | None) -> Recording:
        """One closed loop; KeyboardInterrupt if nothing of it is there to keep."""
        walk = _Walk(self, episode)
        steps = episode.ticks * self.spec.per_tick
        begin, interrupted = time.perf_counter(), False
        try:
            for tick in _until_ctrl_c(range(episode.ticks)):
                if not walk.plan(tick):
                    break
                walk.act_and_step(tick)
                if on_tick is not None:
                    on_tick(walk.done, steps, walk.data)
        except KeyboardInterrupt:
            interrupted = True
        wall = time.perf_counter() - begin
        if walk.done == 0:
            raise KeyboardInterrupt  # nothing to keep
        return walk.recording(wall, interrupted=interrupted)


ENGINE = MujocoEngine


class _Inputs:
    """The vector of sensor values that a program takes: qpos, qvel, sensordata, noise, forces."""

    def __init__(self, engine: MujocoEngine, episode: Episode, data: mujoco.MjData):
        scene, model = engine.spec.scene, engine.model
        self._params, self._base, self._data = episode.params, scene.base, data
        self._noisy = scene.noise
        sizes = [model.nq, model.nv, model.nsensordata, noise_dim(scene.base) * scene.noise]
        self._cuts = np.cumsum(sizes)
        per_tick, ticks = engine.spec.per_tick, episode.ticks
        # Noise is drawn in pieces of one size: one compilation, and no wait before a long run.
        self._piece = _NOISE_TICKS * per_tick
        self._noise, self._first = np.zeros((0, 0)), -self._piece
        self._force = np.zeros((ticks, 0))
        if scene.force_noise:
            self._force = force_noise(episode.params, per_tick, ticks)
        self._values = np.zeros(self._cuts[-1] + self._force.shape[1])

    def at(self, step: int) -> np.ndarray:
        """Values at a physics step."""
        values, cuts, data = self._values, self._cuts, self._data
        values[: cuts[0]] = data.qpos
        values[cuts[0] : cuts[1]] = data.qvel
        values[cuts[1] : cuts[2]] = data.sensordata
        if self._noisy:
            if step >= self._first + self._piece:
                self._first = step - step % self._piece
                self._noise = sensor_noise(self._params, self._base, self._piece, self._first)
            values[cuts[2] : cuts[3]] = self._noise[step - self._first]
        return values

    def at_tick(self, tick: int, step: int) -> np.ndarray:
        """Values at a control tick, which begins with a physics step."""
        values = self.at(step)
        values[self._cuts[3] :] = self._force[tick]
        return values


class _Walk:
    """A robot's episode under way, and its series."""

    def __init__(self, engine: MujocoEngine, episode: Episode):
        self.engine, self.episode = engine, episode
        model, spec = engine.model, engine.spec
        self.program = engine.program(episode)
        apply_world(engine.robot, model, episode.world)
        self.data = mujoco.MjData(model)
        self.data.qpos[:], self.data.qvel[:] = initial_state(episode.start, model, engine.addresses)
        mujoco.mj_forward(model, self.data)
        self.inputs = _Inputs(engine, episode, self.data)
        self.per_tick = spec.per_tick
        self.per_act = spec.per_tick if engine.torques == "held" else spec.per_act
        ticks, steps = episode.ticks, episode.ticks * spec.per_tick
        self.qpos, self.qvel = np.zeros((steps, model.nq)), np.zeros((steps, model.nv))
        self.torque, self.foot_force = np.zeros((steps, model.nu)), np.zeros((steps, 4))
        self.plan_time, self.act_time = np.zeros(ticks), np.zeros(steps)
        self.body_contact = np.zeros(ticks, bool)
        self.logs: list[np.ndarray] = []
        self.is_foot_or_world = model.geom_bodyid == 0
        self.is_foot_or_world[engine.addresses.feet] = True
        self.delay = int(episode.params.delay)
        self.push = push_at(episode.params, np.arange(steps)[:, None])
        self.state = self.program.init(self.inputs.at(0), requests(episode))
        self.done, self.fell = 0, False

    def plan(self, tick: int) -> bool:
        """Plan at the beginning of a control tick; whether the robot stands."""
        values = self.inputs.at_tick(tick, tick * self.per_tick)
        clock = time.perf_counter()
        self.state, log = self.program.plan(self.state, values)
        self.logs.append(np.asarray(log))
        self.plan_time[tick] = time.perf_counter() - clock
        self.body_contact[tick] = not self.is_foot_or_world[self.data.contact.geom].all()
        self.fell = not self.logs[-1][-1]  # alive, the last entry
        return not self.fell

    def act_and_step(self, tick: int) -> None:
        """The physics steps of a control tick."""
        model, data, torque = self.engine.model, self.data, self.torque
        at = self.engine.addresses
        for i in range(tick * self.per_tick, (tick + 1) * self.per_tick):
            self.qpos[i], self.qvel[i] = data.qpos, data.qvel
            self.foot_force[i] = data.sensordata[at.foot_force]
            if i % self.per_act:
                torque[i], self.act_time[i] = torque[i - 1], self.act_time[i - 1]
            else:
                values = self.inputs.at(i)
                clock = time.perf_counter()
                self.state, command = self.program.act(self.state, values)
                torque[i] = command
                self.act_time[i] = time.perf_counter() - clock
            data.ctrl[:] = torque[i - self.delay] if i >= self.delay else 0.0
            data.xfrc_applied[at.trunk, :3] = self.push[i]
            mujoco.mj_step(model, data)
            self.done = i + 1

    def recording(self, wall: float, *, interrupted: bool) -> Recording:
        """What was walked."""
        engine, done, began = self.engine, self.done, len(self.logs)
        at = engine.addresses
        qpos, qvel = self.qpos[:done], self.qvel[:done]
        origin = self.episode.params.origin
        x, feet = sagittal(engine.robot.params, engine.observe, qpos, qvel, origin)
        legs = at.sign.reshape(-1) * self.torque[:done, at.actuator.reshape(-1)]

        def one(series: np.ndarray) -> np.ndarray:
            return np.asarray(series)[:, None]

        return Recording(
            episodes=[self.episode],
            dt=engine.spec.scene.sim_dt,
            per_tick=self.per_tick,
            samples=np.array([done]),
            ticks=np.array([began]),
            fell=np.array([self.fell]),
            qpos=one(qpos),
            qvel=one(qvel),
            torque=one(legs),
            x=one(x),
            feet=one(feet),
            foot_force=one(self.foot_force[:done]),
            log=TickLog(*map(one, self.program.unpack_log(np.stack(self.logs)))),
            body_contact=one(self.body_contact[:began]),
            plan_time=one(self.plan_time[:began]),
            act_time=one(self.act_time[:done]),
            wall_time=wall,
            interrupted=interrupted,
        )


def simulate(
    engine: MujocoEngine, episode: Episode, *, on_tick: OnTick | None = None
) -> Trajectory:
    """One episode. It ends at its duration, at a fall, or at Ctrl-C (and then returns).

    Args:
      engine: with the episode's spec.
      episode: from ``sim.resolve.resolve_episode``.
      on_tick: called once per control tick.

    Raises:
      ValueError: for an episode that needs another engine.
    """
    require_one_spec(engine.spec, [episode])
    return engine._walk(episode, on_tick).trajectory(0)


def _until_ctrl_c(ticks: Iterable[int]) -> Iterator[int]:
    """The ticks, until Ctrl-C: then KeyboardInterrupt between two ticks.

    Python's own handler may raise inside a compiled call, which can take the process down. A
    second Ctrl-C goes to the handler that was there before.
    """
    if threading.current_thread() is not threading.main_thread():
        yield from ticks  # signals are the main thread's
        return
    asked = False
    before = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: Any) -> None:
        nonlocal asked
        asked = True
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, note)
    try:
        for tick in ticks:
            if asked:
                raise KeyboardInterrupt
            yield tick
    finally:
        signal.signal(signal.SIGINT, before)
