"""From the gait's phase to forces: within the present stance, or over a whole gait cycle.

Both take the same task and return the same plan, so that one program may hold both and each gait
use its own.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kjax import gait, qp
from kjax.controllers.params import ControllerParams, Tables
from kjax.koopman.models import LinearModel, input_map
from kjax.legs.kinematics import PlanarState
from kjax.mpc import horizon, multiphase
from kjax.mpc.cycle_rollout import CycleMemory, aged, shifted
from kjax.mpc.limits import force_limits
from kjax.mpc.lmpc import LmpcMemory, shift_plan, solve_lmpc
from kjax.prediction.build import build_family
from kjax.prediction.families import Start, operating_point
from kjax.spec import ControllerSpec, CycleSpec
from kjax.types import RobotParams


class ForceTask(NamedTuple):
    """What forces are to be planned for.

    Attributes:
      clock: gait, phase and time in it.
      stance: (4,) legs that stand.
      body: the robot in the sagittal plane, origin on the ground below its centre of mass.
      valid: whether that is what the robot does; else only a safe force is wanted.
      lag: reference of p_x less p_x [m].
      velocity: reference of v_x now [m/s].
      command: velocity that the reference is on its way to [m/s].
      height: of the centre of mass above the ground, mean of the stances [m].
      pitch_offset: correction of the pitch reference [rad].
      memory: of the LMPC within a stance.
    """

    clock: gait.Clock
    stance: Bool[Array, "4"]
    body: PlanarState
    valid: Bool[Array, ""]
    lag: Float[Array, ""]
    velocity: Float[Array, ""]
    command: Float[Array, ""]
    height: Float[Array, ""]
    pitch_offset: Float[Array, ""]
    memory: LmpcMemory


class ForcePlan(NamedTuple):
    """What comes back.

    Attributes:
      force: (4, 3) force (x, y, z) of each leg on the robot, now, heading frame: x along the
        trunk's heading, z up; the planar planner's have no y [N].
      memory: of the LMPC within a stance, for the next tick.
      status: a ``qp.Status``.
      residual: of the QP [-].
      iterations: of the solver.
      reference: (n_x,) state wanted one step ahead.
    """

    force: Float[Array, "4 3"]
    memory: LmpcMemory
    status: Int[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    reference: Float[Array, "n_x"]


Planner = Callable[[Tables, ForceTask], ForcePlan]


def build_planner(spec: ControllerSpec) -> Planner:
    """The planner of a controller: each gait predicts as far as its parameters say."""
    stance = _build_stance_planner(spec)
    if spec.cycle is None:
        return stance
    cycle = _build_cycle_planner(spec.cycle, spec.control_dt)

    def plan(tables: Tables, task: ForceTask) -> ForcePlan:
        uses_gait_cycle = tables.params.multiphase.nodes[task.clock.gait].sum() > 0
        return jax.lax.cond(uses_gait_cycle & task.stance.any(), cycle, stance, tables, task)

    return plan


def _build_model_at(
    spec: ControllerSpec,
) -> Callable[[Tables, Array, Start], tuple[Array, LinearModel | None]]:
    """Function (tables, problem, start) -> lifted state, and the model if none of the tables is."""
    steps = round(spec.model_dt / spec.model.dt)
    family = build_family(spec.model)
    lift = family.lift

    def model_at(tables: Tables, problem: Array, start: Start) -> tuple[Array, LinearModel | None]:
        if spec.model.tabulated:
            z = lift(None, start)
            if not spec.model.measured_feet:
                return z, None
            assert tables.lmpc is not None
            model = jax.tree.map(lambda a: a[problem], tables.lmpc.model)
            return z, model._replace(B=input_map(model, start.feet))
        fits = tables.params.fits
        assert fits is not None
        model_params, force, _ = jax.tree.map(lambda a: a[problem], fits.prediction)
        if not spec.model.measured_feet:
            start = start._replace(feet=fits.feet[problem])
        return lift(model_params, start), operating_point(family, model_params, start, force, steps)

    return model_at


def _build_stance_planner(spec: ControllerSpec) -> Planner:
    """The paper's scheme: the present contact mode's lifted model, as if it lasted."""
    model_at = _build_model_at(spec)
    limited = spec.friction_rows or spec.torque_rows

    def plan(tables: Tables, task: ForceTask) -> ForcePlan:
        params, clock, body = tables.params, task.clock, task.body
        ahead = spec.model_dt * jnp.arange(1, spec.horizon + 1, dtype=task.lag.dtype)
        phase, cycle = (jnp.broadcast_to(a, ahead.shape) for a in (clock.phase, clock.cycle))
        reference = reference_trajectory(
            position=task.lag,
            velocity=task.velocity,
            height=task.height,
            periodic=_motion(params, task, phase, cycle, clock.elapsed + ahead),
            ahead=ahead,
        )
        feet = _contacts(params.robot, task) @ body.rotation
        rows = None
        if limited:
            rows = force_limits(
                params.robot,
                body.trig,
                body.rotation,
                task.stance,
                friction=params.friction if spec.friction_rows else None,
                torque_fraction=params.torque_fraction if spec.torque_rows else None,
            )
        duration = gait.phase_duration(params.schedule, clock)
        rate = jnp.pi / jnp.maximum(duration, spec.control_dt)
        # Legs that have just come down pressed nothing before.
        fresh = clock.elapsed < 0.5 * spec.control_dt
        last = jnp.where(fresh, 0.0, task.memory.plan[:4])
        start = Start(body.x, feet, last, rate * clock.elapsed, rate)
        problem = params.problem[clock.gait, clock.phase]
        assert tables.lmpc is not None
        z, model = model_at(tables, problem, start)
        solution = solve_lmpc(
            tables.lmpc, problem, z, reference, task.memory, spec, model=model, rows=rows
        )
        # Out of iterations, the solver's point is feasible and no worse than its start; only
        # faulty data makes the shifted last plan the better choice.
        usable = (solution.status <= qp.Status.ITERATION_LIMIT) & task.valid
        fallback = jnp.clip(
            shift_plan(task.memory.plan, spec),
            tables.lmpc.lower[problem],
            tables.lmpc.upper[problem],
        )
        steps = jnp.where(usable, solution.plan, fallback)
        return ForcePlan(
            force=_on_legs(steps[:4].reshape(2, 2) @ body.rotation.T, task.stance),
            memory=LmpcMemory(
                plan=steps,
                problem=problem,
                warm=solution.warm,
                cycle=aged(task.memory.cycle, spec.control_dt),
            ),
            status=solution.status,
            residual=solution.residual,
            iterations=solution.iterations,
            reference=reference[0],
        )

    return plan


def reference_trajectory(
    *,
    position: Float[Array, ""],
    velocity: Float[Array, ""],
    height: Float[Array, ""],
    periodic: Float[Array, "k 4"],
    ahead: Float[Array, "k"],
) -> Float[Array, "k 6"]:
    """Reference (k, 6): constant velocity, and the gait's periodic motion about a height.

    Args:
      position: reference of p_x now [m].
      velocity: commanded v_x [m/s].
      height: mean of the centre of mass [m].
      periodic: (k, 4) deviation of p_z, theta, v_z, omega; zeros for a level trunk.
      ahead: (k,) time of each step from now [s].
    """
    z, theta, v_z, omega = periodic.T
    forward = jnp.full_like(ahead, velocity)
    return jnp.stack([position + velocity * ahead, height + z, theta, forward, v_z, omega], -1)


def _build_cycle_planner(spec: CycleSpec, control_dt: float) -> Planner:
    """A gait cycle ahead, through flight and the next stances."""
    shortest = 0.5 * control_dt

    def plan(tables: Tables, task: ForceTask) -> ForcePlan:
        params, clock, body = tables.params, task.clock, task.body
        settings = horizon.for_gait(params.multiphase, clock.gait)
        schedule = params.schedule
        nodes = horizon.build_nodes(settings, schedule, clock, spec.grid, shortest)
        forecast = horizon.predict(
            settings,
            nodes,
            body.x,
            horizon.HorizonCommand(
                position=task.lag,
                velocity=task.velocity,
                target=task.command,
                slew=params.command_slew,
                height=task.height,
                periodic=_motion(params, task, nodes.phase, nodes.cycle, nodes.place),
            ),
            horizon.Stances(
                ground=jnp.zeros_like(task.lag),
                feet=_contacts(params.robot, task) + body.x[None, :2],
                duration=schedule.duration[clock.gait, nodes.phase],
                cycle=nodes.end[-1],
            ),
        )
        last = task.memory.cycle
        nominal = None
        if last is not None:
            nominal = shifted(last, nodes, forecast.force_z, control_dt)
        solved = multiphase.solve(
            settings,
            params.robot,
            nodes,
            forecast,
            body.x,
            (body.x[:2] - body.base) @ body.rotation,
            spec,
            nominal,
        )
        # A point that misses its rows by a percent still walks better than none; without one, the
        # feet carry what they carry in the periodic motion.
        usable = (solved.status <= qp.Status.ITERATION_LIMIT) & (solved.residual < 1e-2)
        carry = jnp.stack([jnp.zeros_like(forecast.force_z[0]), forecast.force_z[0]])
        force = jnp.where(usable & task.valid, solved.force[0], carry)
        if nominal is not None:
            last = CycleMemory(jnp.where(usable & task.valid, solved.force, nominal), nodes.end)
        standing = jnp.arange(2) == nodes.end_index[0]
        return ForcePlan(
            force=_on_legs(jnp.where(standing[:, None], force, 0.0), task.stance),
            memory=task.memory._replace(plan=jnp.zeros_like(task.memory.plan), cycle=last),
            status=solved.status,
            residual=solved.residual,
            iterations=solved.iterations,
            reference=forecast.reference[0],
        )

    return plan


def _on_legs(force: Float[Array, "2 2"], stance: Bool[Array, "4"]) -> Float[Array, "4 3"]:
    """Forces (x, y, z) of all legs from the (x, z) of one front and one rear leg that stands."""
    x, z = jnp.repeat(force, 2, axis=0).T * stance[None]
    return jnp.stack([x, jnp.zeros_like(x), z], axis=-1)


def _motion(
    params: ControllerParams,
    task: ForceTask,
    phase: Int[Array, "k"],
    cycle: Int[Array, "k"],
    place: Float[Array, "k"],
) -> Float[Array, "k 4"]:
    """Deviation of p_z, theta, v_z, omega that is wanted: the gait's own, and an offset."""
    rows = periodic_motion(params, task.clock.gait, phase, cycle, place)
    return rows.at[:, 1].add(task.pitch_offset)


def periodic_motion(
    params: ControllerParams,
    gait_index: Int[Array, ""],
    phase: Int[Array, "*k"],
    cycle: Int[Array, "*k"],
    place: Float[Array, "*k"],
) -> Float[Array, "*k 4"]:
    """A gait's periodic motion, deviation of p_z, theta, v_z, omega; it stops at the phase's end.

    Args:
      params: of the controller.
      gait_index: gait.
      phase: index of the phase.
      cycle: cycle that it belongs to.
      place: time since its start [s].
    """
    levels, samples = params.reference.shape[1], params.reference.shape[3]
    clock = gait.Clock(gait=gait_index, phase=phase, cycle=cycle, elapsed=place)
    where = jnp.clip(place / gait.phase_duration(params.schedule, clock), 0.0, 1.0) * (samples - 1)
    low = jnp.minimum(where.astype(jnp.int32), samples - 2)
    part = (where - low)[..., None]
    level = jnp.minimum(cycle, levels - 1)
    left, right = (params.reference[gait_index, level, phase, i] for i in (low, low + 1))
    return (1.0 - part) * left + part * right


def _contacts(robot: RobotParams, task: ForceTask) -> Float[Array, "2 2"]:
    """Mean contact point (x, z) of each pair's stance feet, from the CoM in world axes [m].

    A pair without a stance foot gets its swing feet, which no force acts on.
    """
    sole = jnp.stack([jnp.zeros_like(robot.foot_radius), robot.foot_radius])
    pairs = (task.body.feet - sole[None] - task.body.x[None, :2]).reshape(2, 2, 2)
    weight = task.stance.reshape(2, 2).astype(pairs.dtype)
    weight = jnp.where(weight.sum(axis=1, keepdims=True) > 0, weight, 1.0)
    return (pairs * weight[..., None]).sum(axis=1) / weight.sum(axis=1)[:, None]
