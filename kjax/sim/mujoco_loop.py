"""One robot in C MuJoCo: the physics steps in C, the controller in two jitted calls."""

import dataclasses
import signal
import threading
import time
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from kjax.config import RunConfig
from kjax.controller import Controller, build_controller
from kjax.params import Tables, condense, with_params
from kjax.resolve import build_command, controller_key, resolve
from kjax.robots import Robot, get_robot
from kjax.sim import free_base
from kjax.sim.episode import (
    Trajectory,
    fallen,
    initial_state,
    origin,
    sagittal,
)
from kjax.sim.excitation import force_deviation, force_noise, perturb
from kjax.sim.noise import add_noise, noise_dim, sensor_noise
from kjax.sim.observe import Addresses, Observe, build_observe, find_addresses
from kjax.sim.push import push_force
from kjax.sim.resolve import batch_spec
from kjax.sim.scene import apply_scene, build_model
from kjax.state import ControllerState
from kjax.types import Command, Observation

# Called once per control tick with the steps done, the steps in all and the data; return value
# ignored. For progress bars and viewers.
OnTick = Callable[[int, int, mujoco.MjData], None]


class TickLog(NamedTuple):
    """What is recorded at the MPC rate."""

    gait: Any
    stance: Any
    force: Any
    velocity_command: Any
    velocity_reference: Any
    status: Any
    residual: Any
    iterations: Any


class Requests(NamedTuple):
    """What is asked of the controller in one episode; data, so that no episode recompiles.

    Attributes:
      gait_times: (K,) when each gait is asked for [s].
      command: what is asked over time.
    """

    gait_times: Any
    command: Command


class LoopState(NamedTuple):
    """What is carried from call to call."""

    controller: ControllerState
    requests: Requests


def requests(config: RunConfig) -> Requests:
    """What a config asks of the controller."""
    return Requests(
        gait_times=np.asarray(config.gait.times),
        command=build_command(config.command),
    )


class Simulation(NamedTuple):
    """Everything compiled and built for one config, and for all with the same ``simulation_key``.

    The jitted calls take one flat vector of sensor values (qpos, qvel, sensordata, noise, and where
    forces are perturbed what is added to them) and keep the controller state and the episode's
    requests in another: passing pytrees costs 2 us per leaf and call, more than the controller
    itself.

    Attributes:
      config: it was built from.
      robot: who walks.
      model: MuJoCo model.
      addresses: of joints, actuators, sensors.
      observe: (qpos, qvel, sensordata) -> observation.
      controller: pure functions.
      tables: what the controller's functions take.
      init: jitted (sensed, requests) -> state; without requests, those of the config.
      plan: jitted (state, sensed) -> (state, log).
      act: jitted (state, sensed) -> (state, torque (12,) in leg order).
      unpack_log: log vectors (P, n) -> ``TickLog`` of arrays with a leading axis P.
    """

    config: RunConfig
    robot: Robot
    model: mujoco.MjModel
    addresses: Addresses
    observe: Observe
    controller: Controller
    tables: Tables
    init: Callable[..., Array]
    plan: Callable[[ArrayLike, ArrayLike], tuple[Array, Array]]
    act: Callable[[ArrayLike, ArrayLike], tuple[Array, Array]]
    unpack_log: Callable[[np.ndarray], TickLog]


def simulation_key(config: RunConfig) -> Hashable:
    """What the episodes of one compiled simulation share: specs and the controller's parameters.

    Not the seed, duration, noise (but for whether it perturbs forces), pushes, times and speeds of
    the command, times of the gaits, friction, payload, delay, place and heading of the start, and
    the terrain's seed and sizes.
    """
    spec = batch_spec(config)
    scene = dataclasses.replace(spec.scene, noise=True)  # noise is handed over from outside
    return spec.controller, scene, controller_key(config), len(config.command.times)


def build_simulation(config: RunConfig) -> Simulation:
    """Model, controller and compiled calls for a config."""
    robot = get_robot(config.robot)
    model = build_model(robot, config.sim, config.terrain)
    observe = build_observe(robot, model, config.sim.contact_threshold)
    spec, params = resolve(config, robot.params)
    controller, tables = build_controller(spec), condense(spec, params)
    parts = (model.nq, model.nv, model.nsensordata, noise_dim(config.sim.base))
    cuts, size = np.cumsum(parts[:-1]), sum(parts)
    excited = force_deviation(config.noise) > 0

    def sense(sensed: Array) -> Observation:
        qpos, qvel, sensordata, noise = jnp.split(sensed[:size], cuts)
        return add_noise(observe(qpos, qvel, sensordata), noise)

    def pack(tree: LoopState | TickLog) -> Array:
        return jnp.concatenate([jnp.ravel(a).astype(dtype) for a in jax.tree.leaves(tree)])

    def unpack(flat: Array, like: Any) -> Any:
        leaves, shape = jax.tree.flatten(like)
        parts = jnp.split(flat, np.cumsum([leaf.size for leaf in leaves])[:-1])
        return jax.tree.unflatten(
            shape,
            [
                part.reshape(leaf.shape).astype(leaf.dtype)
                for part, leaf in zip(parts, leaves, strict=True)
            ],
        )

    def with_requests(requests: Requests) -> Tables:
        return with_params(tables, gait_times=requests.gait_times, command=requests.command)

    def begin(sensed: Array, wanted: Requests) -> LoopState:
        wanted = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), wanted)
        return LoopState(controller.init(with_requests(wanted), sense(sensed)), wanted)

    def plan_log(loop: LoopState, sensed: Array) -> tuple[LoopState, TickLog]:
        state, info = controller.plan(with_requests(loop.requests), loop.controller, sense(sensed))
        if excited:
            state = state._replace(force=perturb(state.force, state.stance, sensed[size:]))
        log = TickLog(
            gait=state.clock.gait,
            stance=state.stance,
            force=state.force,
            velocity_command=state.command[0],
            velocity_reference=state.velocity,
            status=info.status,
            residual=info.residual,
            iterations=info.iterations,
        )
        return loop._replace(controller=state), log

    def init(sensed: Array, wanted: Requests) -> Array:
        return pack(begin(sensed, wanted))

    def plan(flat: Array, sensed: Array) -> tuple[Array, Array]:
        state, log = plan_log(unpack(flat, state_like), sensed)
        return pack(state), pack(log)

    def act(flat: Array, sensed: Array) -> tuple[Array, Array]:
        loop = unpack(flat, state_like)
        state, command = controller.act(
            with_requests(loop.requests), loop.controller, sense(sensed)
        )
        return pack(loop._replace(controller=state)), command.torque.reshape(-1)

    dtype = tables.params.position_slack.dtype
    example = jax.ShapeDtypeStruct((size + 4 * excited,), dtype)
    default = requests(config)
    state_like = jax.eval_shape(begin, example, default)
    jitted_init = jax.jit(init)
    _, log_like = jax.eval_shape(plan_log, state_like, example)
    simulation = Simulation(
        config=config,
        robot=robot,
        model=model,
        addresses=find_addresses(robot, model),
        observe=observe,
        controller=controller,
        tables=tables,
        init=lambda sensed, wanted=default: jitted_init(sensed, wanted),
        plan=jax.jit(plan),
        act=jax.jit(act),
        unpack_log=lambda flat: jax.device_get(jax.vmap(lambda one: unpack(one, log_like))(flat)),
    )
    # Compile here, so that the loop's first tick is like its others; the results are dropped.
    sensed = np.zeros(example.shape)
    state = simulation.init(sensed)
    jax.block_until_ready((simulation.plan(state, sensed), simulation.act(state, sensed)))
    return simulation


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


def simulate(
    simulation: Simulation,
    config: RunConfig | None = None,
    *,
    seed: int | None = None,
    terrain_seed: int | None = None,
    on_tick: OnTick | None = None,
) -> Trajectory:
    """One episode. It ends at the config's duration, at a fall, or at Ctrl-C (and then returns).

    Args:
      simulation: from ``build_simulation``.
      config: of the episode, in place of the one that the simulation was built from.
      seed: of noise and initial state, in place of the config's.
      terrain_seed: of the obstacles, in place of the config's; moves those of the model.
      on_tick: called once per control tick.

    Raises:
      ValueError: for a config that needs another simulation.
    """
    config = simulation.config if config is None else config
    if simulation_key(config) != simulation_key(simulation.config):
        raise ValueError("the simulation was built from a config with another simulation_key")
    if seed is not None:
        config = dataclasses.replace(config, seed=seed)
    model, at = simulation.model, simulation.addresses
    field = config.terrain
    if terrain_seed is not None:
        field = dataclasses.replace(field, seed=terrain_seed)
    robot = simulation.robot
    apply_scene(robot, model, config.sim, field)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = initial_state(config, model)
    mujoco.mj_forward(model, data)

    per_tick = round(config.lmpc.control_dt / config.sim.sim_dt)
    per_act = round(config.leg.act_dt / config.sim.sim_dt)
    ticks = -(-round(config.duration / config.sim.sim_dt) // per_tick)
    steps = ticks * per_tick
    cuts = np.cumsum([model.nq, model.nv, model.nsensordata, noise_dim(config.sim.base)])
    excited = force_deviation(config.noise) > 0
    added = force_noise(config, ticks) if excited else np.zeros((ticks, 0))
    sensed = np.zeros(cuts[-1] + added.shape[1])

    def sense(step: int) -> np.ndarray:
        sensed[: cuts[0]] = data.qpos
        sensed[cuts[0] : cuts[1]] = data.qvel
        sensed[cuts[1] : cuts[2]] = data.sensordata
        sensed[cuts[2] : cuts[3]] = noise[step - first_step]
        return sensed

    qpos, qvel = np.zeros((steps, model.nq)), np.zeros((steps, model.nv))
    torque, foot_force = np.zeros((steps, 12)), np.zeros((steps, 4))
    plan_time, act_time = np.zeros(ticks), np.zeros(steps)
    body_contact = np.zeros(ticks, bool)
    is_foot_or_world = model.geom_bodyid == 0
    is_foot_or_world[at.feet] = True
    delay = round(config.sim.delay / config.sim.sim_dt)
    push = push_force(config.push, np.arange(steps) * config.sim.sim_dt, config.sim.sim_dt, np)
    logs: list[np.ndarray] = []
    actuators, sign, trunk = at.actuator.reshape(-1), at.sign.reshape(-1), at.trunk

    first_step, noise = 0, sensor_noise(config, per_tick)
    state = simulation.init(sense(0), requests(config))

    fell = interrupted = False
    done = 0
    begin = time.perf_counter()
    try:
        for tick in _until_ctrl_c(range(ticks)):
            first_step = tick * per_tick
            noise = sensor_noise(config, per_tick, first_step)
            sense(first_step)
            sensed[cuts[3] :] = added[tick]
            clock = time.perf_counter()
            state, log = simulation.plan(state, sensed)
            logs.append(np.asarray(log))
            plan_time[tick] = time.perf_counter() - clock
            for i in range(tick * per_tick, (tick + 1) * per_tick):
                qpos[i], qvel[i] = data.qpos, data.qvel
                foot_force[i] = data.sensordata[at.foot_force]
                if i % per_act:
                    torque[i], act_time[i] = torque[i - 1], act_time[i - 1]
                else:
                    sense(i)
                    clock = time.perf_counter()
                    state, command = simulation.act(state, sensed)
                    torque[i] = command
                    act_time[i] = time.perf_counter() - clock
                data.ctrl[actuators] = sign * torque[i - delay] if i >= delay else 0.0
                data.xfrc_applied[trunk, :3] = push[i]
                mujoco.mj_step(model, data)
                done = i + 1
            body_contact[tick] = not is_foot_or_world[data.contact.geom].all()
            roll, pitch, _ = free_base.attitude(data.qpos)
            height = data.subtree_com[trunk, 2] - config.sim.floor
            if fallen(robot.params, height, pitch, roll):
                fell = True
                break
            if on_tick is not None:
                on_tick(done, steps, data)
    except KeyboardInterrupt:
        interrupted = True
    wall = time.perf_counter() - begin
    if done == 0:
        raise KeyboardInterrupt  # nothing to keep

    keep = slice(0, done)
    x, feet = sagittal(robot.params, simulation.observe, qpos[keep], qvel[keep], origin(config.sim))
    ticks_log = simulation.unpack_log(np.stack(logs))
    held = np.arange(done) // per_tick
    return Trajectory(
        dt=config.sim.sim_dt,
        time=np.arange(done) * config.sim.sim_dt,
        qpos=qpos[keep],
        qvel=qvel[keep],
        x=x,
        feet=feet,
        foot_force=foot_force[keep],
        torque=torque[keep].reshape(-1, 4, 3),
        gait=ticks_log.gait[held],
        stance=ticks_log.stance[held],
        force=ticks_log.force[held],
        velocity_command=ticks_log.velocity_command[held],
        velocity_reference=ticks_log.velocity_reference[held],
        body_contact=body_contact[: len(ticks_log.status)],
        plan_status=ticks_log.status,
        plan_residual=ticks_log.residual,
        plan_iterations=ticks_log.iterations,
        plan_time=plan_time[: len(ticks_log.status)],
        act_time=act_time[keep],
        wall_time=wall,
        fell=fell,
        interrupted=interrupted,
    )
