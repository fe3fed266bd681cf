"""One robot at a time in C MuJoCo: the physics steps in C, the controller in two jitted calls."""

import dataclasses
import signal
import threading
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from typing import Any

import mujoco
import numpy as np

from kjax.config import RunConfig
from kjax.controllers.resolve import controller_key
from kjax.files import file_hashes
from kjax.robots import get_robot
from kjax.sim.closed_loop import TickLog
from kjax.sim.engines.contract import OnProgress, Torques, require_one_spec, ticks_of
from kjax.sim.episode import Trajectory, initial_state, sagittal
from kjax.sim.excitation import force_deviation, force_noise
from kjax.sim.noise import noise_dim, sensor_noise
from kjax.sim.observe import build_observe, find_addresses
from kjax.sim.program import Program, build_program, requests
from kjax.sim.recording import Recording, concatenate
from kjax.sim.resolve import batch_spec, push_at, resolve_scene
from kjax.sim.scene import apply_scene, build_model

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
      config: that it was built from.
      spec: what all configs have in common.
      robot: who walks.
      model: of the scene.
      addresses: of the robot in it.
      observe: (qpos, qvel, sensordata) -> observation.
    """

    def __init__(
        self,
        config: RunConfig,
        *,
        torques: Torques = "every_step",
        threads: int | None = None,
        dtype: Any = None,
    ):
        """Scene and program of a config; compiles.

        Args:
          config: one of those to come.
          torques: ``"every_step"``, or ``"held"`` for a control tick.
          threads: of no effect: one robot walks at a time.
          dtype: floating type of the controller; JAX's default if ``None``.
        """
        self.config, self.spec, self.torques = config, batch_spec(config), torques
        self._dtype = dtype
        self.robot = get_robot(config.robot)
        self.model = build_model(self.robot, config.sim, config.terrain)
        self.addresses = find_addresses(self.robot, self.model)
        self.observe = build_observe(self.robot, self.model, config.sim.contact_threshold)
        self._programs: dict[Hashable, Program] = {}
        self.program(config)
        # The noise's program as well: a Ctrl-C during a compilation can take the process down.
        sensor_noise(config, _NOISE_TICKS * self._per_tick)

    def run(self, configs: Sequence[RunConfig], on_progress: OnProgress | None = None) -> Recording:
        """Closed loops of all configs, one after the other, each until its end or its fall.

        On Ctrl-C what was walked is returned, marked as interrupted.

        Raises:
          ValueError: for a config with another ``batch_spec``.
        """
        require_one_spec(self.spec, configs)
        steps = [ticks_of(one) * self._per_tick for one in configs]
        parts: list[Recording] = []
        for number, config in enumerate(configs):
            before = sum(steps[:number])

            def on_tick(done: int, total: int, data: Any, before: int = before) -> None:
                if on_progress is not None:
                    on_progress(before + done, sum(steps))

            try:
                parts.append(self._episode(config, on_tick))
            except KeyboardInterrupt:  # before there was anything of this one to keep
                if not parts:
                    raise
                parts[-1] = dataclasses.replace(parts[-1], interrupted=True)
            if parts[-1].interrupted:
                break
        return concatenate(parts)

    @staticmethod
    def check(config: RunConfig, torques: Torques) -> None:
        """This engine walks every config."""

    @property
    def _per_tick(self) -> int:
        return round(self.spec.controller.control_dt / self.spec.scene.sim_dt)

    def program(self, config: RunConfig) -> Program:
        """The compiled calls for a config."""
        key = (controller_key(config), len(config.command.times), *file_hashes(config).values())
        if key not in self._programs:
            while len(self._programs) >= _KEPT:
                del self._programs[next(iter(self._programs))]
            self._programs[key] = build_program(
                config, self.robot, self.spec, self.model,
                held=self.torques == "held", dtype=self._dtype,
            )  # fmt: skip
        return self._programs[key]

    def _episode(self, config: RunConfig, on_tick: OnTick | None) -> Recording:
        """One closed loop; KeyboardInterrupt if nothing of it is there to keep."""
        model, at, robot = self.model, self.addresses, self.robot
        program = self.program(config)
        apply_scene(robot, model, config.sim, config.terrain)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = initial_state(config, model)
        mujoco.mj_forward(model, data)
        episode = resolve_scene(config)[1]

        per_tick = self._per_tick
        per_act = round(config.leg.act_dt / config.sim.sim_dt)
        per_act = per_tick if self.torques == "held" else per_act
        ticks = ticks_of(config)
        steps = ticks * per_tick
        noisy = self.spec.scene.noise
        sizes = [model.nq, model.nv, model.nsensordata, noise_dim(config.sim.base) * noisy]
        cuts = np.cumsum(sizes)
        excited = force_deviation(config.noise) > 0
        added = force_noise(config, ticks) if excited else np.zeros((ticks, 0))
        sensed = np.zeros(cuts[-1] + added.shape[1])

        def sense(step: int) -> np.ndarray:
            sensed[: cuts[0]] = data.qpos
            sensed[cuts[0] : cuts[1]] = data.qvel
            sensed[cuts[1] : cuts[2]] = data.sensordata
            if noisy:
                sensed[cuts[2] : cuts[3]] = noise[step % piece]
            return sensed

        qpos, qvel = np.zeros((steps, model.nq)), np.zeros((steps, model.nv))
        torque, foot_force = np.zeros((steps, model.nu)), np.zeros((steps, 4))
        plan_time, act_time = np.zeros(ticks), np.zeros(steps)
        body_contact = np.zeros(ticks, bool)
        is_foot_or_world = model.geom_bodyid == 0
        is_foot_or_world[at.feet] = True
        delay = int(episode.delay)
        push = push_at(episode, np.arange(steps)[:, None])
        logs: list[np.ndarray] = []
        # Noise is drawn in pieces of one size: one compilation, and no wait before a long run.
        piece = _NOISE_TICKS * per_tick
        noise = sensor_noise(config, piece)
        state = program.init(sense(0), requests(config))

        fell = interrupted = False
        done = 0
        begin = time.perf_counter()
        try:
            for tick in _until_ctrl_c(range(ticks)):
                if tick > 0 and tick % _NOISE_TICKS == 0:
                    noise = sensor_noise(config, piece, tick * per_tick)
                sense(tick * per_tick)
                sensed[cuts[3] :] = added[tick]
                clock = time.perf_counter()
                state, log = program.plan(state, sensed)
                logs.append(np.asarray(log))
                plan_time[tick] = time.perf_counter() - clock
                body_contact[tick] = not is_foot_or_world[data.contact.geom].all()
                if not logs[-1][-1]:  # alive, the last entry
                    fell = True
                    break
                for i in range(tick * per_tick, (tick + 1) * per_tick):
                    qpos[i], qvel[i] = data.qpos, data.qvel
                    foot_force[i] = data.sensordata[at.foot_force]
                    if i % per_act:
                        torque[i], act_time[i] = torque[i - 1], act_time[i - 1]
                    else:
                        sense(i)
                        clock = time.perf_counter()
                        state, command = program.act(state, sensed)
                        torque[i] = command
                        act_time[i] = time.perf_counter() - clock
                    data.ctrl[:] = torque[i - delay] if i >= delay else 0.0
                    data.xfrc_applied[at.trunk, :3] = push[i]
                    mujoco.mj_step(model, data)
                    done = i + 1
                if on_tick is not None:
                    on_tick(done, steps, data)
        except KeyboardInterrupt:
            interrupted = True
        wall = time.perf_counter() - begin
        if done == 0:
            raise KeyboardInterrupt  # nothing to keep

        x, feet = sagittal(robot.params, self.observe, qpos[:done], qvel[:done], episode.origin)
        legs = at.sign.reshape(-1) * torque[:done, at.actuator.reshape(-1)]
        began = len(logs)

        def one(series: np.ndarray) -> np.ndarray:
            return np.asarray(series)[:, None]

        return Recording(
            configs=[config],
            dt=config.sim.sim_dt,
            per_tick=per_tick,
            samples=np.array([done]),
            ticks=np.array([began]),
            fell=np.array([fell]),
            qpos=one(qpos[:done]),
            qvel=one(qvel[:done]),
            torque=one(legs),
            x=one(x),
            feet=one(feet),
            foot_force=one(foot_force[:done]),
            log=TickLog(*map(one, program.unpack_log(np.stack(logs)))),
            body_contact=one(body_contact[:began]),
            plan_time=one(plan_time[:began]),
            act_time=one(act_time[:done]),
            wall_time=wall,
            interrupted=interrupted,
        )


ENGINE = MujocoEngine


def simulate(
    engine: MujocoEngine,
    config: RunConfig | None = None,
    *,
    seed: int | None = None,
    terrain_seed: int | None = None,
    on_tick: OnTick | None = None,
) -> Trajectory:
    """One episode. It ends at the config's duration, at a fall, or at Ctrl-C (and then returns).

    Args:
      engine: with the config's ``batch_spec``.
      config: of the episode, in place of the one that the engine was built from.
      seed: of noise and initial state, in place of the config's.
      terrain_seed: of the obstacles, in place of the config's; moves those of the model.
      on_tick: called once per control tick.

    Raises:
      ValueError: for a config that needs another engine.
    """
    config = engine.config if config is None else config
    if seed is not None:
        config = dataclasses.replace(config, seed=seed)
    if terrain_seed is not None:
        terrain = dataclasses.replace(config.terrain, seed=terrain_seed)
        config = dataclasses.replace(config, terrain=terrain)
    require_one_spec(engine.spec, [config])
    return engine._episode(config, on_tick).trajectory(0)


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
