"""The controller: pure functions ``init``, ``plan``, ``act`` and ``step`` over plain pytrees.

``plan`` runs at the MPC rate: phase clock, reference, lift, QP. ``act`` runs several times in
between: swing feet follow their paths, stance feet press the planned forces. Both take and return
the same ``ControllerState``; nothing is hidden, so they run in a Python loop, in ``lax.scan`` and
under ``vmap`` alike. The caller owns ``jit``.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from kjax import gait, qp
from kjax.concrete import is_concrete
from kjax.controllers.acting import build_act, facing
from kjax.controllers.command import IGNORED
from kjax.controllers.contacts import mean_height, next_swings
from kjax.controllers.observation import (
    cast,
    check_observation,
    is_valid,
    or_neutral,
)
from kjax.controllers.params import Tables
from kjax.controllers.planning import ForceTask, Planner, build_planner
from kjax.controllers.reference import next_clock, next_reference
from kjax.controllers.spatial import PlanFrom, build_spatial_plan, start_spatial
from kjax.controllers.state import ControllerState, PlanInfo
from kjax.legs import contact, swing
from kjax.legs.base import Base, View, build_base, to_local
from kjax.legs.ground import start_slope
from kjax.legs.kinematics import PlanarState
from kjax.mpc.lmpc import LmpcMemory, start_memory
from kjax.precision import full_precision
from kjax.spec import ControllerSpec
from kjax.types import COMMAND_NAMES, JointCommand, Observation


class Controller(NamedTuple):
    """A controller is a record of pure functions; ``tables`` are from ``condense``.

    Attributes:
      init: (tables, observation) -> state. Outside ``jit`` it raises a ValueError for a sample in
        another convention (``observation.check_observation``).
      plan: (tables, state, observation) -> (state, info), once per control_dt.
      act: (tables, state, observation) -> (state, command), once per act_dt: a ``JointCommand``,
        whose torques are within the robot's limits.
      step: plan, then act: (tables, state, observation) -> (state, command, info).
      init_from: (tables, view) -> state; ``init`` for a caller that knows the view itself, such as
        a rigid body without legs (``kjax.tuning``). The view is in the local frame, see
        ``ControllerState``.
      plan_from: (tables, state, view, contact, valid) -> (state, info); ``plan`` likewise.
      control_dt: time between two plans [s].
      act_dt: time between two calls of ``act`` [s].
    """

    init: Callable[[Tables, Observation], ControllerState]
    plan: Callable[[Tables, ControllerState, Observation], tuple[ControllerState, PlanInfo]]
    act: Callable[
        [Tables, ControllerState, Observation],
        tuple[ControllerState, JointCommand],
    ]
    step: Callable[
        [Tables, ControllerState, Observation],
        tuple[ControllerState, JointCommand, PlanInfo],
    ]
    init_from: Callable[[Tables, View], ControllerState]
    plan_from: Callable[
        [Tables, ControllerState, View, Bool[Array, "4"], Bool[Array, ""]],
        tuple[ControllerState, PlanInfo],
    ]
    control_dt: float
    act_dt: float


def build_controller(spec: ControllerSpec, planner: Planner | None = None) -> Controller:
    """Controller functions for static choices (rates, horizon, solver).

    Args:
      spec: from ``kjax.controllers.resolve``.
      planner: of forces; that of the spec if ``None``.
    """
    if not isinstance(spec, ControllerSpec):
        raise TypeError(f"spec: wanted that of kjax.resolve, got {type(spec).__name__}")
    base = build_base(spec.base, spatial_forces=spec.spatial is not None)
    plan_from = _planar_plan(spec, planner) if spec.spatial is None else build_spatial_plan(spec)
    act = build_act(base, spec.act_dt)

    def init(tables: Tables, observation: Observation) -> ControllerState:
        return _init(start, tables, observation)

    def init_from(tables: Tables, view: View, track: Array | None = None) -> ControllerState:
        return _init_from(spec, tables, view, track)

    # Most callers call ``init`` once, outside jit: one program, not a hundred and forty.
    start = jax.jit(full_precision(partial(_start, base, init_from)))

    def plan(
        tables: Tables, state: ControllerState, observation: Observation
    ) -> tuple[ControllerState, PlanInfo]:
        return _plan(base, plan_from, tables, state, observation)

    def step(
        tables: Tables, state: ControllerState, observation: Observation
    ) -> tuple[ControllerState, JointCommand, PlanInfo]:
        state, info = plan(tables, state, observation)
        state, command = act(tables, state, observation)
        return state, command, info

    return Controller(
        init=full_precision(init),
        plan=full_precision(plan),
        act=full_precision(act),
        step=full_precision(step),
        init_from=full_precision(init_from),
        plan_from=full_precision(plan_from),
        control_dt=spec.control_dt,
        act_dt=spec.act_dt,
    )


def _planar_plan(spec: ControllerSpec, planner: Planner | None) -> PlanFrom:
    plan_forces = build_planner(spec) if planner is None else planner

    def plan_from(
        tables: Tables, state: ControllerState, view: View, flags: Array, valid: Array
    ) -> tuple[ControllerState, PlanInfo]:
        return _plan_from(spec, plan_forces, tables, state, view, flags, valid)

    return plan_from


def _init(
    start: Callable[..., ControllerState], tables: Tables, observation: Observation
) -> ControllerState:
    """``Controller.init``: a look at the sample where it is known, and ``start``."""
    if not isinstance(tables, Tables):
        raise TypeError(f"tables: wanted condense(spec, params), got {type(tables).__name__}")
    params = tables.params
    if is_concrete((observation, params.robot)):
        check_observation(params.robot, observation)
    return start(tables, cast(observation, params.position_slack.dtype))


def _start(
    base: Base, init_from: Callable[..., ControllerState], tables: Tables, observation: Observation
) -> ControllerState:
    """The state before the first tick."""
    params = tables.params
    # The heading of a first sample that is no good is taken from the first good one.
    valid = is_valid(observation)
    observation = or_neutral(observation, valid)
    track = base.track(observation)
    if track is not None:
        track = jnp.where(valid, track, 0.0)
    return init_from(tables, base.view(params.robot, facing(track), observation), track)


def _init_from(
    spec: ControllerSpec, tables: Tables, view: View, track: Array | None = None
) -> ControllerState:
    """``Controller.init_from``."""
    params = tables.params
    zero = jnp.zeros_like(params.position_slack)
    state = ControllerState(
        time=zero,
        clock=gait.start(params.gaits[0], zero - spec.control_dt),  # first plan: phase 0
        stance=jnp.ones((4,), bool),
        lag=jnp.zeros((2,), zero.dtype),
        heading=zero,
        command=jnp.zeros((len(COMMAND_NAMES),), zero.dtype),
        height=zero,
        ground=jnp.min(view.feet[:, -1]) - params.robot.foot_radius,
        slope=None if spec.spatial is None else start_slope(params.robot.foot_radius, view.feet),
        velocity=jnp.zeros((3,), zero.dtype),
        correction=jnp.zeros((2 if spec.spatial is None else 3,), zero.dtype),
        memory=(
            _start_lmpc(tables, spec)
            if spec.spatial is None
            else start_spatial(spec.spatial, zero.dtype)
        ),
        force=jnp.zeros((4, 3), zero.dtype),
        swing=swing.initial_swing(view.feet, lifts=spec.spatial is not None),
        feet=view.feet,
        base_vel=view.base_vel,
        torque=jnp.zeros((4, 3), zero.dtype),
        blind_time=zero,
        contact=contact.initial_contact(zero.dtype),
        track=track,
    )
    # A buffer of its own for every leaf, so that the state may be donated.
    return jax.tree.map(jnp.copy, state)


def _start_lmpc(tables: Tables, spec: ControllerSpec) -> LmpcMemory:
    assert tables.lmpc is not None  # a planar controller's are condensed
    return start_memory(tables.lmpc, spec)


def _plan(
    base: Base,
    plan_from: Callable[..., tuple[ControllerState, PlanInfo]],
    tables: Tables,
    state: ControllerState,
    observation: Observation,
) -> tuple[ControllerState, PlanInfo]:
    """``Controller.plan``."""
    params = tables.params
    observation = cast(observation, params.position_slack.dtype)
    valid = is_valid(observation)
    observation = or_neutral(observation, valid)
    if state.track is not None:
        unset = valid & (state.track == 0.0).all()
        state = state._replace(track=jnp.where(unset, base.track(observation), state.track))
    view = base.view(params.robot, facing(state.track), observation)
    return plan_from(tables, state, view, observation.contact, valid)


def _plan_from(
    spec: ControllerSpec,
    plan_forces: Planner,
    tables: Tables,
    state: ControllerState,
    view: View,
    flags: Array,
    valid: Array,
) -> tuple[ControllerState, PlanInfo]:
    """``Controller.plan_from``: clock, swing legs, ground, reference, forces."""
    assert isinstance(state.memory, LmpcMemory)
    params, control_dt = tables.params, spec.control_dt
    clock = next_clock(params, state, control_dt)
    where = (clock.gait, clock.phase)
    stance, mode = params.schedule.stance[where], params.schedule.mode[where]
    feet = jnp.where(valid, view.feet, state.feet)
    swings = next_swings(params, state, clock, stance, flags, feet)
    heights = feet[:, -1] - params.robot.foot_radius
    ground = mean_height(heights, stance, state.ground)
    wanted = next_reference(params, state, clock, view.planar, control_dt)
    task = ForceTask(
        clock=clock,
        stance=stance,
        body=_above_ground(view.planar, ground),
        valid=valid,
        lag=wanted.lag,
        velocity=wanted.velocity + wanted.correction[0],
        command=wanted.command[0] + wanted.correction[0],
        height=params.height[clock.gait] + wanted.height,
        pitch_offset=wanted.correction[1],
        memory=state.memory,
    )
    solved = plan_forces(tables, task)
    next_state = state._replace(
        time=state.time + control_dt,
        clock=clock,
        stance=stance,
        lag=jnp.where(valid, state.lag.at[0].set(wanted.lag), state.lag),
        command=wanted.command,
        height=wanted.height,
        ground=jnp.where(valid, ground, state.ground),
        velocity=state.velocity.at[0].set(wanted.velocity),
        correction=jnp.where(valid, wanted.correction, state.correction),
        memory=solved.memory,
        force=to_local(view, solved.force),
        swing=swings,
        feet=feet,
    )
    info = PlanInfo(
        status=jnp.where(valid, solved.status, qp.Status.NON_FINITE).astype(jnp.int32),
        residual=jnp.where(valid, solved.residual, jnp.inf),
        iterations=solved.iterations,
        mode=mode,
        x=_above_ground(view.planar, ground).x,
        reference=solved.reference,
        contact_fault=contact.is_faulty(state.contact),
        command_ignored=(wanted.command[IGNORED] != 0.0).any(),
        blind_time=jnp.where(valid, 0.0, state.blind_time + spec.act_dt),
    )
    return next_state, info


def _above_ground(body: PlanarState, ground: Array) -> PlanarState:
    """The body in the frame whose origin is the ground below its centre of mass."""
    origin = jnp.stack([body.x[0], ground])
    return body._replace(
        x=body.x.at[:2].add(-origin), base=body.base - origin, feet=body.feet - origin[None]
    )
