"""The controller: pure functions ``init``, ``plan``, ``act`` and ``step`` over plain pytrees.

``plan`` runs at the MPC rate: phase clock, reference, lift, QP. ``act`` runs at the physics rate:
swing feet follow their paths, stance feet press the planned forces. Both take and return the same
``ControllerState``; nothing is hidden, so they run in a Python loop, in ``lax.scan`` and under
``vmap`` alike. The caller owns ``jit``.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kjax import gait, qp
from kjax.config import RunConfig
from kjax.legs import lateral, swing
from kjax.legs.base import LegCommand, View, build_base
from kjax.mpc.lmpc import LmpcMemory, start_memory
from kjax.params import ControllerParams
from kjax.planning import ForceTask, Planner, build_planner, periodic_motion
from kjax.types import Observation


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
      memory: of the LMPC within a stance: its last plan and where the QP goes on from.
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
    memory: LmpcMemory
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


class Controller(NamedTuple):
    """A controller is a record of pure functions.

    Attributes:
      init: (params, observation) -> state.
      plan: (params, state, observation) -> (state, info), once per control_dt.
      act: (params, state, observation) -> (state, torque), once per sim_dt; torque (4, 3) [N m]
        of (abduction, thigh, calf) in leg order, within the robot's limits.
      step: plan, then act: (params, state, observation) -> (state, torque, info).
      init_from: (params, view) -> state; ``init`` for a caller that knows the view itself, such as
        a rigid body without legs (``kjax.tuning``).
      plan_from: (params, state, view, contact, readable) -> (state, info); ``plan`` likewise.
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
    init_from: Callable[[ControllerParams, View], ControllerState]
    plan_from: Callable[
        [ControllerParams, ControllerState, View, Bool[Array, "4"], Bool[Array, ""]],
        tuple[ControllerState, PlanInfo],
    ]


def build_controller(config: RunConfig, planner: Planner | None = None) -> Controller:
    """Controller functions for the static choices of a config (rates, horizon, solver).

    Args:
      config: of the run.
      planner: of forces; that of the config if ``None``.
    """
    lmpc = config.lmpc
    sim_dt = config.sim.sim_dt
    base = build_base(config.sim.base)
    plan_forces = build_planner(config) if planner is None else planner
    hessians_stay = config.koopman.feet == "fixed" and config.koopman.model == "linear"

    def init(params: ControllerParams, observation: Observation) -> ControllerState:
        observation = _cast(observation, params)
        track = base.track(observation)
        return init_from(params, base.view(params.robot, track, observation), track)

    def init_from(
        params: ControllerParams, view: View, track: Array | None = None
    ) -> ControllerState:
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
            memory=start_memory(params.tables, lmpc, carry=hessians_stay),
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
        return plan_from(params, state, view, observation.contact, readable)

    def plan_from(
        params: ControllerParams,
        state: ControllerState,
        view: View,
        contact: Array,
        readable: Array,
    ) -> tuple[ControllerState, PlanInfo]:
        body = view.planar
        schedule = params.schedule

        clock = next_clock(params, state, lmpc.control_dt)
        where = (clock.gait, clock.phase)
        stance, mode = schedule.stance[where], schedule.mode[where]
        lifting = state.stance & ~stance
        switched = clock.gait != state.clock.gait
        # A new gait gives legs that are in the air already another time to come down.
        anew = ~stance & switched
        swings = swing.begin_swings(
            state.swing, lifting | anew, view.feet, gait.time_to_touchdown(schedule, clock)
        )
        cut = stance & ~state.stance & switched
        swings = swing.end_swings(params.swing, swings, stance, cut, contact, view.feet)

        command = params.command.velocities[_piece(params.command.times, state.time)]
        change = params.command_slew * lmpc.control_dt
        velocity = state.velocity + jnp.clip(command - state.velocity, -change, change)
        usual = periodic_motion(params, clock.gait, clock.phase, clock.cycle, clock.elapsed)
        error = jnp.stack([velocity - body.x[3], usual[1] - body.x[2]])
        rate, limit = params.integral
        # Errors beyond the limit are a step on its way, not a bias.
        correction = state.correction + rate * lmpc.control_dt * jnp.clip(error, -limit, limit)
        # What one gait's model misses says nothing about another's.
        correction = jnp.where(switched, 0.0, jnp.clip(correction, -limit, limit))
        target = velocity + correction[0]
        slack = params.position_slack
        position = jnp.clip(
            state.position + target * lmpc.control_dt, body.x[0] - slack, body.x[0] + slack
        )
        count = jnp.sum(stance)
        under = jnp.sum(jnp.where(stance, body.feet[:, 1] - params.robot.foot_radius, 0.0))
        ground = jnp.where(count > 0, under / jnp.maximum(count, 1), state.ground)
        solved = plan_forces(
            params,
            ForceTask(
                clock=clock,
                stance=stance,
                mode=mode,
                body=body,
                readable=readable,
                position=position,
                velocity=target,
                command=command + correction[0],
                height=params.height[clock.gait] + params.follow_ground * ground,
                ground=ground,
                lean=correction[1],
                memory=state.memory,
            ),
        )

        moved = ControllerState(
            time=state.time + lmpc.control_dt,
            clock=clock,
            stance=stance,
            position=jnp.where(readable, position, state.position),
            velocity_command=command,
            ground=jnp.where(readable, ground, state.ground),
            velocity=velocity,
            correction=jnp.where(readable, correction, state.correction),
            memory=solved.memory,
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

    return Controller(
        init=init, plan=plan, act=act, step=step, init_from=init_from, plan_from=plan_from
    )


def next_clock(params: ControllerParams, state: ControllerState, control_dt: float) -> gait.Clock:
    """Place in the gait at the next plan, ``control_dt`` [s] after the last one."""
    wanted = params.gaits[_piece(params.gait_times, state.time)]
    return gait.advance(params.schedule, state.clock, control_dt, wanted)


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
