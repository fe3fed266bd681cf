"""The controller: pure functions ``init``, ``plan``, ``act`` and ``step`` over plain pytrees.

``plan`` runs at the MPC rate: phase clock, reference, lift, QP. ``act`` runs at the physics rate:
swing feet follow their paths, stance feet press the planned forces. Both take and return the same
``ControllerState``; nothing is hidden, so they run in a Python loop, in ``lax.scan`` and under
``vmap`` alike. The caller owns ``jit``.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kjax import gait, qp
from kjax.config import RunConfig
from kjax.gait.reference import SAMPLES, periodic_reference
from kjax.koopman.edmd import build_dictionary, fit_modes, srb_params
from kjax.legs import lateral, swing
from kjax.legs.base import LegCommand, build_base
from kjax.legs.kinematics import PlanarState
from kjax.mpc import multiphase
from kjax.mpc.lmpc import (
    LmpcTables,
    build_tables,
    mode_settings,
    reference_trajectory,
    shift_plan,
    solve_lmpc,
)
from kjax.types import Command, Mode, Observation, RobotParams


class ControllerParams(NamedTuple):
    """All numbers of a controller; data, so any leaf may be batched or replaced.

    Attributes:
      robot: geometry and masses.
      tables: LMPC per contact mode.
      schedule: gaits.
      gait_times: (K,) times at which a gait is asked for, the first one 0 [s].
      gaits: (K,) index of the gait asked for then.
      reference: (G, ramp levels, P, samples, 4) periodic motion of each gait; see
        ``gait.reference``.
      multiphase: LMPC over a gait cycle, for gaits that use it.
      swing: swing settings.
      lateral: regulator of roll, yaw and sideways motion; of no effect on the planar base.
      command: forward velocity over time.
      height: (G,) mean height of the centre of mass [m].
      follow_ground: 1 to measure it from the stance feet, 0 from z = 0 [-].
      command_slew: largest rate of change of the reference velocity [m/s^2].
      integral: (2, 2) integral action on velocity and pitch: its rates [1/s] and its limits
        [m/s, rad].
      position_slack: clamp of the position reference [m].
    """

    robot: RobotParams
    tables: LmpcTables
    schedule: gait.Schedule
    gait_times: Float[Array, "K"]
    gaits: Int[Array, "K"]
    reference: Float[Array, "G levels P samples 4"]
    multiphase: multiphase.MultiPhaseParams
    swing: swing.SwingParams
    lateral: lateral.LateralParams
    command: Command
    height: Float[Array, "G"]
    follow_ground: Float[Array, ""]
    command_slew: Float[Array, ""]
    integral: Float[Array, "2 2"]
    position_slack: Float[Array, ""]


class ControllerState(NamedTuple):
    """What the controller remembers between calls.

    Attributes:
      time: since ``init`` [s].
      clock: place in the gait.
      stance: (4,) scheduled stance legs.
      position: integrated reference of p_x [m].
      velocity_command: velocity commanded now [m/s].
      ground: height of the ground under the last stance feet [m].
      velocity: reference of v_x, which follows the command at a bounded rate [m/s].
      correction: integrals of the errors of velocity and pitch, added to their references
        [m/s, rad].
      plan: (4k,) last force plan, body frame [N].
      force: (4, 2) force (x, z) that each leg shall put on the robot now, body frame [N].
      swing: state of the swing legs.
      track: (2,) cosine and sine of the heading to keep, the trunk's at ``init``, world [-];
        ``None`` on the planar base.
    """

    time: Float[Array, ""]
    clock: gait.Clock
    stance: Bool[Array, "4"]
    position: Float[Array, ""]
    velocity_command: Float[Array, ""]
    ground: Float[Array, ""]
    velocity: Float[Array, ""]
    correction: Float[Array, "2"]
    plan: Float[Array, "nu"]
    force: Float[Array, "4 2"]
    swing: swing.SwingState
    track: Float[Array, "2"] | None


class PlanInfo(NamedTuple):
    """What a plan did; for logs and for callers that must know.

    Attributes:
      status: a ``qp.Status``. At the iteration limit the solver's last point is in force; with
        faulty data the shifted last plan is.
      residual: relative KKT residual of the solver's point [-].
      iterations: of the solver.
      mode: contact mode.
      x: (6,) SRB state as estimated from the observation.
      reference: (6,) state wanted one model step ahead.
    """

    status: Int[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    mode: Int[Array, ""]
    x: Float[Array, "6"]
    reference: Float[Array, "6"]


class _Forces(NamedTuple):
    """What a scheme of prediction returns: forces (2, 2) per foot of each end, and the rest."""

    ends: Float[Array, "2 2"]
    plan: Float[Array, "nu"]
    status: Int[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    reference: Float[Array, "6"]


class Controller(NamedTuple):
    """A controller is a record of pure functions.

    Attributes:
      init: (params, observation) -> state.
      plan: (params, state, observation) -> (state, info), once per control_dt.
      act: (params, state, observation) -> (state, torque), once per sim_dt; torque (4, 3) [N m]
        of (abduction, thigh, calf) in leg order, within the robot's limits.
      step: plan, then act: (params, state, observation) -> (state, torque, info).
    """

    init: Callable[[ControllerParams, Observation], ControllerState]
    plan: Callable[
        [ControllerParams, ControllerState, Observation], tuple[ControllerState, PlanInfo]
    ]
    act: Callable[
        [ControllerParams, ControllerState, Observation],
        tuple[ControllerState, Float[Array, "4 3"]],
    ]
    step: Callable[
        [ControllerParams, ControllerState, Observation],
        tuple[ControllerState, Float[Array, "4 3"], PlanInfo],
    ]


def build_controller(config: RunConfig) -> Controller:
    """Controller functions for the static choices of a config (rates, horizon, solver)."""
    lmpc = config.lmpc
    sim_dt = config.sim.sim_dt
    lift = build_dictionary(config.koopman).lift
    measured_feet = config.koopman.feet == "measured"
    cycle_nodes = int(_cycle_nodes(build_gaits(config), config).sum(axis=1).max())
    cycle_nodes += cycle_nodes > 0  # the present phase may hold one more, part now and part later
    base = build_base(config.sim.base)

    def init(params: ControllerParams, observation: Observation) -> ControllerState:
        observation = _cast(observation, params)
        track = base.track(observation)
        view = base.view(params.robot, track, observation)
        zero = jnp.zeros_like(params.position_slack)
        return ControllerState(
            time=zero,
            clock=gait.start(params.gaits[0], zero - lmpc.control_dt),  # first plan: phase 0
            stance=jnp.ones((4,), bool),
            position=view.planar.x[0],
            velocity_command=zero,
            ground=zero,
            velocity=zero,
            correction=jnp.zeros((2,), zero.dtype),
            plan=jnp.zeros_like(params.tables.lower[0]),
            force=jnp.zeros((4, 2), zero.dtype),
            swing=swing.initial_swing(view.feet),
            track=track,
        )

    def plan(
        params: ControllerParams, state: ControllerState, observation: Observation
    ) -> tuple[ControllerState, PlanInfo]:
        observation = _cast(observation, params)
        readable = _all_finite(observation, state.track)
        view = base.view(params.robot, state.track, _stand_in(observation, readable, params))
        body = view.planar
        schedule = params.schedule

        wanted = params.gaits[_piece(params.gait_times, state.time)]
        clock = gait.advance(schedule, state.clock, lmpc.control_dt, wanted)
        where = (clock.gait, clock.phase)
        stance, mode = schedule.stance[where], schedule.mode[where]
        lifting = state.stance & ~stance
        # A new gait gives legs that are in the air already another time to come down.
        anew = ~stance & (clock.gait != state.clock.gait)
        swings = swing.begin_swings(
            state.swing, lifting | anew, view.feet, gait.time_to_touchdown(schedule, clock)
        )
        cut = stance & ~state.stance & (clock.gait != state.clock.gait)
        swings = swing.end_swings(params.swing, swings, stance, cut, observation.contact, view.feet)

        command = params.command.velocities[_piece(params.command.times, state.time)]
        change = params.command_slew * lmpc.control_dt
        velocity = state.velocity + jnp.clip(command - state.velocity, -change, change)
        now = _periodic_rows(
            params, clock, clock.phase[None], jnp.zeros_like(clock.phase)[None], clock.elapsed[None]
        )[0]
        error = jnp.stack([velocity - body.x[3], now[1] - body.x[2]])
        rate, limit = params.integral
        # Errors beyond the limit are a step on its way, not a bias.
        correction = state.correction + rate * lmpc.control_dt * jnp.clip(error, -limit, limit)
        # What one gait's model misses says nothing about another's.
        same = clock.gait == state.clock.gait
        correction = jnp.where(same, jnp.clip(correction, -limit, limit), 0.0)
        target = velocity + correction[0]
        lean = jnp.stack([jnp.zeros_like(target), correction[1]] + [jnp.zeros_like(target)] * 2)
        slack = params.position_slack
        position = jnp.clip(
            state.position + target * lmpc.control_dt, body.x[0] - slack, body.x[0] + slack
        )
        contact = _contact_points(params.robot, body, stance)
        count = jnp.sum(stance)
        under = jnp.sum(jnp.where(stance, body.feet[:, 1] - params.robot.foot_radius, 0.0))
        ground = jnp.where(count > 0, under / jnp.maximum(count, 1), state.ground)
        height = params.height[clock.gait] + params.follow_ground * ground

        def within_stance() -> _Forces:
            ahead = lmpc.model_dt * jnp.arange(1, lmpc.horizon + 1, dtype=position.dtype)
            phases = jnp.broadcast_to(clock.phase, ahead.shape)
            reference = reference_trajectory(
                position=position,
                velocity=target,
                height=height,
                periodic=lean
                + _periodic_rows(
                    params, clock, phases, jnp.zeros_like(phases), clock.elapsed + ahead
                ),
                ahead=ahead,
            )
            warm = shift_plan(state.plan, lmpc)
            solution = solve_lmpc(
                params.tables,
                mode,
                lift(body.x),
                reference,
                warm,
                lmpc,
                feet=contact @ body.rotation if measured_feet else None,
            )
            # Out of iterations, the solver's point is feasible and no worse than its start; only
            # faulty data makes the shifted last plan the better choice.
            usable = (solution.status <= qp.Status.ITERATION_LIMIT) & readable
            fallback = jnp.clip(warm, params.tables.lower[mode], params.tables.upper[mode])
            forces = jnp.where(usable, solution.x, fallback)
            return _Forces(
                forces[:4].reshape(2, 2),
                forces,
                solution.status,
                solution.residual,
                solution.iterations,
                reference[0],
            )

        def over_a_cycle() -> _Forces:
            settings = params.multiphase
            nodes = multiphase.build_nodes(
                settings, schedule, clock, cycle_nodes, shortest=0.5 * lmpc.control_dt
            )
            outlook = multiphase.predict(
                settings,
                nodes,
                body.x,
                position=position,
                velocity=target,
                command=command + correction[0],
                slew=params.command_slew,
                height=height,
                ground=ground,
                periodic=lean
                + _periodic_rows(
                    params, clock, nodes.phase, nodes.cycle - clock.cycle, nodes.place
                ),
                contact=contact + body.x[:2],
                stance_time=schedule.duration[clock.gait, nodes.phase],
                cycle_time=nodes.end[-1],
            )
            solved = multiphase.solve(
                settings,
                params.robot,
                nodes,
                outlook,
                body.x,
                (body.x[:2] - body.base) @ body.rotation,
                tolerance=config.multiphase.tolerance,
                max_iterations=config.multiphase.max_iterations,
            )
            # A point that misses its rows by a percent still walks better than none.
            usable = (solved.status <= qp.Status.ITERATION_LIMIT) & (solved.residual < 1e-2)
            carry = jnp.stack([jnp.zeros_like(outlook.force_z[0]), outlook.force_z[0]])
            first = jnp.where(usable & readable, solved.force[0], carry) @ body.rotation
            standing = jnp.arange(2) == nodes.end_index[0]
            return _Forces(
                jnp.where(standing[:, None], first, 0.0),
                jnp.zeros_like(state.plan),
                solved.status,
                solved.residual,
                solved.iterations,
                outlook.reference[0],
            )

        if cycle_nodes:
            crossing = (params.multiphase.nodes[clock.gait].sum() > 0) & stance.any()
            solved = jax.lax.cond(crossing, over_a_cycle, within_stance)
        else:
            solved = within_stance()

        moved = ControllerState(
            time=state.time + lmpc.control_dt,
            clock=clock,
            stance=stance,
            position=jnp.where(readable, position, state.position),
            velocity_command=command,
            ground=jnp.where(readable, ground, state.ground),
            velocity=velocity,
            correction=jnp.where(readable, correction, state.correction),
            plan=solved.plan,
            force=jnp.broadcast_to(solved.ends[:, None], (2, 2, 2)).reshape(4, 2) * stance[:, None],
            swing=jax.tree.map(lambda new, old: jnp.where(readable, new, old), swings, state.swing),
            track=state.track,
        )
        info = PlanInfo(
            status=jnp.where(readable, solved.status, qp.Status.NON_FINITE).astype(jnp.int32),
            residual=jnp.where(readable, solved.residual, jnp.inf),
            iterations=solved.iterations,
            mode=mode,
            x=body.x,
            reference=solved.reference,
        )
        return moved, info

    def act(
        params: ControllerParams, state: ControllerState, observation: Observation
    ) -> tuple[ControllerState, Array]:
        observation = _cast(observation, params)
        readable = _all_finite(observation, state.track)
        observation = _stand_in(observation, readable, params)
        robot = params.robot
        view = base.view(robot, state.track, observation)
        where = (state.clock.gait, state.clock.phase)

        settings = swing.for_gait(params.swing, state.clock.gait)
        swings = swing.continue_swings(
            settings,
            state.swing,
            ~state.stance & readable,
            observation.contact,
            view.feet,
            sim_dt,
        )
        command = LegCommand(
            stance=state.stance & ~swings.reaching,
            force=state.force,
            swing=swings,
            stance_time=params.schedule.stance_time[where],
            velocity=state.velocity + state.correction[0],
        )
        sideways = lateral.for_gait(params.lateral, state.clock.gait)
        torque = base.torque(robot, settings, sideways, view, command, observation)
        torque = jnp.clip(torque, -robot.torque_limit, robot.torque_limit)
        return state._replace(swing=swings), jnp.where(readable, torque, 0.0)

    def step(
        params: ControllerParams, state: ControllerState, observation: Observation
    ) -> tuple[ControllerState, Array, PlanInfo]:
        state, info = plan(params, state, observation)
        state, torque = act(params, state, observation)
        return state, torque, info

    return Controller(init=init, plan=plan, act=act, step=step)


def build_params(config: RunConfig, robot: RobotParams, *, dtype: Any = None) -> ControllerParams:
    """Fit the Koopman models, condense the LMPC and gather everything that ``plan`` needs.

    The work is done in float64 whatever the caller's default; the result is cast once.

    Args:
      config: of the run.
      robot: e.g. ``kjax.robots.go1.PARAMS``.
      dtype: floating type of the result; JAX's current default if ``None``.
    """
    dtype = jnp.zeros(()).dtype if dtype is None else jnp.dtype(dtype)
    gaits = build_gaits(config)
    names = [g.name for g in gaits]
    leg, bound, sideways = config.leg, config.bound, config.lateral
    is_bound = np.array([name == "bound" for name in names])
    sole = robot.foot_radius - bound.height
    bound_feet = ((bound.feet_front, float(sole)), (-bound.feet_rear, float(sole)))
    with jax.enable_x64(True):
        body = srb_params(config.srb, {Mode.FRONT: bound_feet, Mode.REAR: bound_feet})
        key = jax.random.key(config.koopman.dataset.seed)
        model, report = _fit_modes(body, config.koopman, key)
        if not bool(report.finite.all()):
            raise ValueError("the EDMD fit is not finite: check srb and koopman.dataset ranges")
        params = ControllerParams(
            robot=robot,
            tables=_build_tables(
                model,
                mode_settings(config.lmpc, bound, config.srb.mass),
                steps=round(config.lmpc.model_dt / config.koopman.dataset.dt),
                horizon=config.lmpc.horizon,
                feet=body.feet,
            ),
            schedule=gait.build_schedule(gaits),
            gait_times=jnp.asarray(config.gait.times),
            gaits=jnp.asarray([names.index(name) for name in config.gait.names]),
            reference=jnp.asarray(_reference_tables(gaits, config)),
            multiphase=_multiphase_params(gaits, config, robot),
            swing=swing.SwingParams(
                apex=jnp.asarray(np.where(is_bound, bound.apex, leg.apex)),
                velocity_gain=jnp.asarray(
                    np.where(is_bound, bound.velocity_gain, leg.velocity_gain)
                ),
                offset=jnp.asarray(is_bound[:, None] * _bound_offset(robot, config)),
                horizontal_fraction=jnp.asarray(leg.horizontal_fraction),
                hold_after=jnp.asarray(leg.hold_after),
                reach_speed=jnp.asarray(leg.reach_speed),
                kp=jnp.asarray([leg.kp_abduction, leg.kp, leg.kp]),
                kd=jnp.asarray([leg.kd_abduction, leg.kd, leg.kd]),
            ),
            lateral=lateral.LateralParams(
                roll=jnp.asarray([sideways.roll_stiffness, sideways.roll_damping]),
                yaw=jnp.asarray([sideways.yaw_stiffness, sideways.yaw_damping]),
                damping=jnp.asarray(sideways.damping),
                weights=jnp.asarray(sideways.wrench_weights),
                ridge=jnp.asarray(sideways.force_weight),
                friction=jnp.asarray(sideways.friction),
                friction_offset=jnp.asarray(sideways.friction_offset),
                friction_x=jnp.asarray(
                    np.where(is_bound, sideways.plan_friction_bound, sideways.plan_friction)
                ),
                foothold_gain=jnp.asarray(sideways.velocity_gain),
            ),
            command=Command(
                times=jnp.asarray(config.command.times),
                velocities=jnp.asarray(config.command.velocities),
            ),
            height=jnp.asarray(np.where(is_bound, bound.height, config.lmpc.height)),
            follow_ground=jnp.asarray(float(config.lmpc.height_above == "feet")),
            command_slew=jnp.asarray(config.lmpc.command_slew, float),
            integral=jnp.asarray([config.lmpc.integral_gains, config.lmpc.integral_limits]),
            position_slack=jnp.asarray(config.lmpc.position_slack),
        )
        params = jax.device_get(params)
    return jax.tree.map(lambda leaf: _as(leaf, dtype), params)


_fit_modes = jax.jit(fit_modes, static_argnames="config")
_build_tables = jax.jit(build_tables, static_argnames=("steps", "horizon"))


def build_gaits(config: RunConfig) -> list[gait.Gait]:
    """The gaits of a config, in the order of their indices: trot, bound, stand, landing."""
    chosen, bound = config.gait, config.bound
    landing = "landing" if chosen.landing_time > 0 else ""
    gaits = [
        gait.trot(chosen.stance_time, chosen.trot_flight),
        gait.bound(
            bound.front_stance,
            bound.first_flight,
            bound.rear_stance,
            bound.second_flight,
            ramp_start=bound.ramp_start,
            ramp_cycles=bound.ramp_cycles,
            leave_anywhere=chosen.switch_rule == "anywhere",
            leave_through=landing,
        ),
        gait.stand(),
    ]
    return [*gaits, gait.stand(chosen.landing_time, name=landing)] if landing else gaits


def _cycle_nodes(gaits: list[gait.Gait], config: RunConfig) -> np.ndarray:
    """Number of nodes (G, P) of each phase; zero for gaits that predict within a stance only."""
    nodes = np.zeros((len(gaits), max(len(g.phases) for g in gaits)), int)
    for index, one in enumerate(gaits):
        if one.name != "bound" or config.bound.horizon != "multiphase":
            continue
        for place, phase in enumerate(one.phases):
            parts = np.ceil(phase.duration / config.multiphase.node_dt - 1e-9)
            nodes[index, place] = 1 if phase.mode == Mode.FLIGHT else parts
    return nodes


def _multiphase_params(
    gaits: list[gait.Gait], config: RunConfig, robot: RobotParams
) -> multiphase.MultiPhaseParams:
    chosen, bound = config.multiphase, config.bound
    return multiphase.MultiPhaseParams(
        nodes=jnp.asarray(_cycle_nodes(gaits, config)),
        state_weights=jnp.asarray(chosen.state_weights),
        input_weight=jnp.asarray(chosen.input_weight),
        mass=jnp.asarray(config.srb.mass),
        inertia=jnp.asarray(config.srb.inertia * chosen.inertia_scale),
        friction=jnp.asarray(chosen.friction),
        torque_limit=jnp.asarray(chosen.torque_fraction * robot.torque_limit[1:]),
        force_x_max=jnp.asarray(chosen.force_x_max),
        force_z=jnp.asarray([chosen.force_z_min, chosen.force_z_max]),
        feet=jnp.asarray([bound.feet_front, -bound.feet_rear]),
        velocity_gain=jnp.asarray(bound.velocity_gain),
        velocity_time=jnp.asarray(chosen.velocity_time),
        height_time=jnp.asarray(chosen.height_time),
    )


def _reference_tables(gaits: list[gait.Gait], config: RunConfig) -> np.ndarray:
    """Periodic motion of every gait at every ramp level; zero but for a bound that wants one."""
    bound = config.bound
    levels = 1 + max(g.ramp_cycles for g in gaits)
    rows = np.zeros((len(gaits), levels, max(len(g.phases) for g in gaits), SAMPLES, 4))
    for index, one in enumerate(gaits):
        if one.name != "bound" or bound.reference != "periodic":
            continue
        modes = [phase.mode for phase in one.phases]
        for level in range(levels):
            grown = min(level / one.ramp_cycles, 1.0) if one.ramp_cycles else 1.0
            scale = one.ramp_start + (1.0 - one.ramp_start) * grown
            durations = [
                phase.duration * (scale if phase.mode == Mode.FLIGHT else 1.0)
                for phase in one.phases
            ]
            rows[index, level] = periodic_reference(
                np.array(durations),
                modes,
                bound.feet_front,
                bound.feet_rear,
                config.srb.mass,
                config.srb.inertia,
            ).rows
    return rows


def _bound_offset(robot: RobotParams, config: RunConfig) -> np.ndarray:
    """Foothold of a bound ahead of the hip, standing still, for each leg [m]."""
    wanted = [config.bound.feet_front] * 2 + [-config.bound.feet_rear] * 2
    return np.asarray(wanted) - np.asarray(robot.hip_pos)[:, 0]


def _as(leaf: Any, dtype: Any) -> Array:
    """Leaf on the device: floats in ``dtype``, integers as int32, the rest as it is."""
    kind = jnp.asarray(leaf).dtype
    if jnp.issubdtype(kind, jnp.floating):
        return jnp.asarray(leaf, dtype)
    return jnp.asarray(leaf, jnp.int32) if jnp.issubdtype(kind, jnp.integer) else jnp.asarray(leaf)


def _cast(observation: Observation, params: ControllerParams) -> Observation:
    """Observation in the controller's floating type."""
    dtype = params.position_slack.dtype
    floats = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), observation)
    return floats._replace(contact=jnp.asarray(observation.contact, bool))


def _all_finite(observation: Observation, track: Array | None) -> Array:
    """Whether the observation, and the heading that it is seen from, hold numbers only."""
    leaves = [*observation[:-1], *([] if track is None else [track])]
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in leaves]).all()


def _stand_in(observation: Observation, readable: Array, params: ControllerParams) -> Observation:
    """The observation, or a harmless one where it is not finite, so that no NaN spreads."""
    harmless = Observation(
        base_pos=jnp.array([0.0, 0.0, 0.3]),
        base_quat=jnp.array([1.0, 0.0, 0.0, 0.0]),
        base_vel=jnp.zeros(3),
        base_ang_vel=jnp.zeros(3),
        joint_pos=jnp.tile(jnp.array([0.0, 0.9, -1.8]), (4, 1)),
        joint_vel=jnp.zeros((4, 3)),
        contact=observation.contact,
    )
    return jax.tree.map(
        lambda seen, safe: jnp.where(readable, seen, safe.astype(seen.dtype)),
        observation,
        harmless,
    )


def _piece(times: Float[Array, "K"], time: Float[Array, ""]) -> Int[Array, ""]:
    """Index of the piece that ``time`` lies in; it begins at its start time, within rounding."""
    return jnp.maximum(jnp.sum(time >= times - 1e-5) - 1, 0)


def _periodic_rows(
    params: ControllerParams,
    clock: gait.Clock,
    phase: Int[Array, "k"],
    cycles: Int[Array, "k"],
    place: Float[Array, "k"],
) -> Float[Array, "k 4"]:
    """The gait's periodic motion in ``phase``, so many cycles on, ``place`` [s] after its start.

    It stops at the phase's end.
    """
    levels, samples = params.reference.shape[1], params.reference.shape[3]
    cycle = clock.cycle + cycles
    level = jnp.minimum(cycle, levels - 1)
    duration = jax.vmap(
        lambda phase, cycle: gait.phase_duration(
            params.schedule, clock._replace(phase=phase, cycle=cycle)
        )
    )(phase, cycle)
    where = jnp.clip(place / duration, 0.0, 1.0) * (samples - 1)
    low = jnp.minimum(where.astype(jnp.int32), samples - 2)
    part = (where - low)[:, None]
    at, after = (params.reference[clock.gait, level, phase, i] for i in (low, low + 1))
    return (1.0 - part) * at + part * after


def _contact_points(
    robot: RobotParams, body: PlanarState, stance: Bool[Array, "4"]
) -> Float[Array, "2 2"]:
    """Mean contact point (x, z) of the stance feet at each end, world frame from the CoM [m].

    An end without a stance foot gets its swing feet, which no force acts on.
    """
    ground = body.feet - jnp.stack([jnp.zeros_like(robot.foot_radius), robot.foot_radius])
    ends = (ground - body.x[:2]).reshape(2, 2, 2)
    weight = stance.reshape(2, 2).astype(ends.dtype)
    weight = jnp.where(weight.sum(axis=1, keepdims=True) > 0, weight, 1.0)
    return (ends * weight[..., None]).sum(axis=1) / weight.sum(axis=1)[:, None]
