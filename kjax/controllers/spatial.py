"""The plan in three dimensions: references, horizon, footholds, forces.

Everything is in the local frame of ``ControllerState``, its origin moved to the ground below the
centre of mass; headings are counted from the track.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax import gait, qp
from kjax.controllers.command import HEIGHT, PITCH, ROLL, V_X, V_Y, YAW_RATE
from kjax.controllers.contacts import mean_height, next_swings
from kjax.controllers.params import ControllerParams, Tables
from kjax.controllers.planning import periodic_motion
from kjax.controllers.reference import command_now, next_clock
from kjax.controllers.state import ControllerState, PlanInfo
from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState
from kjax.legs import contact, lateral, spatial, swing
from kjax.legs.base import View
from kjax.legs.footholds import Arrival, footholds, turned
from kjax.legs.ground import next_slope, rise, soles, upright
from kjax.mpc import grid, momentum
from kjax.mpc.momentum import MomentumMemory
from kjax.mpc.response import PredictionTask, Targets
from kjax.mpc.rigid_models import PREDICTIONS
from kjax.spec import ControllerSpec, SpatialSpec

ERROR_CLIP = 0.25  # of integral action (anti-windup), part of its largest correction
USABLE = 1e-2  # residual up to which a plan at the iteration limit walks better than none

PlanFrom = Callable[[Tables, ControllerState, View, Array, Array], tuple[ControllerState, PlanInfo]]


class _Motion(NamedTuple):
    """What the body shall do from now on.

    Attributes:
      command: (6,) in force.
      velocity: (3,) references of v_x, v_y and yaw rate: the command at bounded rates.
      correction: (3,) what integral action adds to those of v_x, v_y and the heading.
      height: reference of the height above the gait's own [m].
      heading: reference of the yaw now, without that [rad].
      lag: (2,) reference of the place less the place [m].
      lead: (2,) velocity less its reference [m/s].
    """

    command: Float[Array, "6"]
    velocity: Float[Array, "3"]
    correction: Float[Array, "3"]
    height: Float[Array, ""]
    heading: Float[Array, ""]
    lag: Float[Array, "2"]
    lead: Float[Array, "2"]

    def at(self, t: Float[Array, "*k"]) -> tuple[Array, Array, Array]:
        """Way (*k, 2) and velocity (*k, 2) wanted, and heading (*k,), after a time ``t`` [s]."""
        speed, first = self.velocity[:2] + self.correction[:2], self.heading + self.correction[2]
        angle = self.velocity[2] * t
        small = jnp.abs(angle) < 1e-4
        safe = jnp.where(small, 1.0, angle)
        ahead = jnp.where(small, 1.0 - angle**2 / 6.0, jnp.sin(safe) / safe)
        across = jnp.where(small, 0.5 * angle, (1.0 - jnp.cos(safe)) / safe)
        now = turned(first, speed)
        way = jnp.stack(
            [ahead * now[0] - across * now[1], across * now[0] + ahead * now[1]], axis=-1
        )
        heading = first + angle
        return t[..., None] * way, turned(heading, speed), heading


def start_spatial(spec: SpatialSpec, dtype: jnp.dtype) -> MomentumMemory:
    """What is remembered before the first plan."""
    return MomentumMemory(
        force=jnp.zeros((spec.nodes, 4, 3), dtype),
        end=jnp.zeros((spec.nodes,), dtype),
        planned=jnp.zeros((), bool),
    )


def build_spatial_plan(spec: ControllerSpec) -> PlanFrom:
    """``Controller.plan_from`` of the LMPC in three dimensions."""
    assert spec.spatial is not None
    sizes, control_dt = spec.spatial, spec.control_dt
    predict = PREDICTIONS[sizes.model]

    def plan_from(
        tables: Tables, state: ControllerState, view: View, flags: Array, valid: Array
    ) -> tuple[ControllerState, PlanInfo]:
        params = tables.params
        own, body = params.spatial, view.whole
        assert own is not None
        assert body is not None  # a free base's view has it
        assert isinstance(state.memory, MomentumMemory)
        clock = next_clock(params, state, control_dt)
        stance = params.schedule.stance[clock.gait, clock.phase]
        feet = jnp.where(valid, view.feet, state.feet)
        swings = next_swings(params, state, clock, stance, flags, feet)
        assert state.slope is not None
        touching = soles(params.robot.foot_radius, feet, state.slope.slope)
        slope = next_slope(
            state.slope, touching, stance & flags & valid, control_dt / own.slope_time
        )
        level = feet[:, 2] - params.robot.foot_radius - rise(slope.slope, feet[:, :2])
        ground = mean_height(level, stance, state.ground)  # below the trunk's origin
        below = ground + rise(slope.slope, body.com[:2] - body.base[:2])

        velocity = spatial.rotate(body.heading, body.com_vel)
        omega = spatial.rotate(body.heading, body.omega)
        origin = jnp.stack([body.com[0], body.com[1], below])
        start = BodyState(
            p=body.com - origin,
            R=body.rotation,
            v=velocity,
            L=srb_spatial.momentum(own.body, body.rotation, omega),
        )
        switched = clock.gait != state.clock.gait
        motion = _next_motion(params, state, switched, body.yaw, velocity, control_dt)
        nodes = grid.build_grid(
            params.schedule, clock, sizes.nodes,
            node_dt=own.grid[1], horizon=own.grid[0], shortest=0.5 * control_dt,
        )  # fmt: skip
        targets = _targets(params, clock, nodes, motion, slope.slope)
        com = body.rotation.T @ (body.com - body.base)
        contacts = _contacts(
            params, clock, nodes, motion, touching - origin[None], com, slope.slope
        )
        nominal = momentum.shifted(state.memory, nodes, targets.force, control_dt)
        lasts = params.schedule.duration[clock.gait, nodes.phase]
        over = (nodes.end - 0.5 * nodes.length - nodes.begin) / jnp.where(lasts > 0, lasts, 1.0)
        response = predict(
            PredictionTask(
                own.body, start, nodes.length, contacts, nominal, targets, own.learned, over
            )
        )
        torques = _torque_maps(params, response.states, contacts, com)
        solved = momentum.solve(
            response,
            nodes,
            nominal,
            targets,
            jax.tree.map(lambda a: a[clock.gait], own.weights),
            momentum.foot_rows(own.limits, upright(slope.slope), torques),
            grid.list_feet(nodes.stance, sizes.feet),
            tolerance=sizes.tolerance,
            max_iterations=sizes.max_iterations,
        )
        usable = (solved.status <= qp.Status.ITERATION_LIMIT) & (solved.residual < USABLE) & valid
        force = jnp.where(usable, solved.force, nominal)
        next_state = state._replace(
            time=state.time + control_dt,
            clock=clock,
            stance=stance,
            lag=jnp.where(valid, motion.lag, state.lag),
            heading=jnp.where(valid, motion.heading, state.heading),
            command=motion.command,
            height=motion.height,
            ground=jnp.where(valid, ground, state.ground),
            slope=jax.tree.map(lambda a, b: jnp.where(valid, a, b), slope, state.slope),
            velocity=motion.velocity,
            correction=jnp.where(valid, motion.correction, state.correction),
            memory=MomentumMemory(force, nodes.end, jnp.ones((), bool)),
            force=jnp.where(stance[:, None], force[0], 0.0),
            swing=swings,
            feet=feet,
        )
        first = jax.tree.map(lambda a: a[0], targets)
        info = PlanInfo(
            status=jnp.where(valid, solved.status, qp.Status.NON_FINITE).astype(jnp.int32),
            residual=jnp.where(valid, solved.residual, jnp.inf),
            iterations=solved.iterations,
            mode=params.schedule.mode[clock.gait, clock.phase],
            x=jnp.concatenate([rotations.trunk_angles(start.R), start.p, omega, velocity]),
            reference=jnp.concatenate(
                [rotations.trunk_angles(first.R), first.p, first.omega, first.v]
            ),
            contact_fault=contact.is_faulty(state.contact),
            command_ignored=jnp.zeros((), bool),
            blind_time=jnp.where(valid, 0.0, state.blind_time + spec.act_dt),
        )
        return next_state, info

    return plan_from


def _next_motion(
    params: ControllerParams,
    state: ControllerState,
    switched: Bool[Array, ""],
    yaw: Float[Array, ""],
    velocity: Float[Array, "3"],
    control_dt: float,
) -> _Motion:
    """References one control tick on."""
    own = params.spatial
    assert own is not None
    command = command_now(params, state)
    wanted = jnp.stack([command[V_X], command[V_Y], command[YAW_RATE]])
    change = control_dt * jnp.stack([params.command_slew, params.command_slew, own.slew])
    reference = state.velocity + jnp.clip(wanted - state.velocity, -change, change)
    steady = jnp.all(reference == wanted)
    climb = params.height_slew * control_dt
    height = state.height + jnp.clip(command[HEIGHT] - state.height, -climb, climb)
    ahead = _wrapped(state.heading + reference[2] * control_dt - yaw)
    ahead = jnp.clip(ahead, -own.heading_slack, own.heading_slack)
    heading = _wrapped(yaw + ahead)
    moving = turned(-heading, velocity[:2])
    near = jnp.clip(reference[:2] - moving, -own.velocity_slack, own.velocity_slack)
    reference = jnp.append(moving + near, reference[2])
    lead = velocity[:2] - turned(heading, reference[:2])
    # Errors in the axes of the trunk, where what causes them stays.
    error = jnp.append(turned(-heading, -lead), ahead)
    rate, limit = own.integral
    # While the command is on its way, and of larger errors, it is a step that is left, not a bias.
    most = ERROR_CLIP * limit
    learned = jnp.where(steady, rate * control_dt * jnp.clip(error, -most, most), 0.0)
    correction = jnp.clip(state.correction + learned, -limit, limit)
    correction = jnp.where(switched, 0.0, correction)
    lead = lead - turned(heading, correction[:2])
    slack = params.position_slack
    lag = jnp.clip(state.lag - lead * control_dt, -slack, slack)
    return _Motion(command, reference, correction, height, heading, lag, lead)


def _targets(
    params: ControllerParams,
    clock: gait.Clock,
    nodes: grid.Grid,
    motion: _Motion,
    slope: Float[Array, "2"],
) -> Targets:
    """What the body shall do at the nodes' ends, in the frame of the plan."""
    own = params.spatial
    assert own is not None
    way, velocity, heading = motion.at(nodes.end)
    within = nodes.end - nodes.begin
    periodic = periodic_motion(params, clock.gait, nodes.phase, nodes.cycle, within)
    z, theta, v_z, pitch_rate = periodic.T
    zero = jnp.zeros_like(z)

    def about(angle: Array, axis: int) -> Array:
        return rotations.exp(jnp.stack([angle if i == axis else zero for i in range(3)], axis=-1))

    R_yaw = about(heading, 2)
    ahead, left = (
        jnp.stack([jnp.cos(heading), jnp.sin(heading)]),
        jnp.stack([-jnp.sin(heading), jnp.cos(heading)]),
    )
    # Axes of a trunk that lies along a plane: nose along it, then the left side.
    slope_pitch = jnp.arctan(own.alignment * slope @ ahead)
    slope_roll = jnp.arctan(own.alignment * slope @ left * jnp.cos(slope_pitch))
    # Nose up is a turn about the axis to the right.
    pitch = theta + motion.command[PITCH] + slope_pitch
    roll = motion.command[ROLL] + slope_roll
    R = R_yaw @ about(-pitch, 1) @ about(roll, 0)
    yaw_rate = zero + motion.velocity[2]
    # Along a plane the trunk turns about its normal.
    tilted = own.alignment * yaw_rate
    omega = jnp.stack([-(slope @ ahead) * tilted, -(slope @ left) * tilted - pitch_rate, yaw_rate])
    place = motion.lag[None] + way
    height = params.height[clock.gait] + motion.height + z + rise(slope, place)
    full = params.schedule.duration[clock.gait]
    used = jnp.arange(full.shape[0]) < params.schedule.phases[clock.gait]
    cycle = gait.preview(params.schedule, clock, 0.0).duration.sum()
    load = own.force_z[clock.gait] * (cycle / jnp.sum(jnp.where(used, full, 0.0)))
    force_z = jnp.where(nodes.stance, jnp.repeat(load, 2)[None], 0.0)
    flat = jnp.zeros_like(force_z)
    return Targets(
        R=R,
        p=jnp.concatenate([place, height[:, None]], axis=1),
        omega=jnp.einsum("kij,kj->ki", R_yaw, omega.T),
        v=jnp.concatenate([velocity, (v_z + rise(slope, velocity))[:, None]], axis=1),
        heading=jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-1),
        force=jnp.stack([flat, flat, force_z], axis=-1),
    )


def _contacts(
    params: ControllerParams,
    clock: gait.Clock,
    nodes: grid.Grid,
    motion: _Motion,
    touching: Float[Array, "4 3"],
    com: Float[Array, "3"],
    slope: Float[Array, "2"],
) -> Float[Array, "K 4 3"]:
    """Contact points of the legs in each node: where they stand, or will."""
    own = params.spatial
    assert own is not None
    index = jnp.arange(nodes.length.shape[0])
    # First node of the unbroken stance that a leg is in.
    lifted = jax.lax.cummax(jnp.where(nodes.stance, -1, index[:, None]), axis=0)
    first = jnp.minimum(lifted + 1, index[:, None])
    wait = jnp.maximum(nodes.begin[first], 0.0)
    way, velocity, heading = motion.at(wait)
    fade = jnp.exp(-wait / own.velocity_time)[..., None]
    error = motion.lead * fade
    stance_time = params.schedule.stance_time[clock.gait]
    legs = jnp.broadcast_to(jnp.arange(4)[None], first.shape)
    settings = swing.for_gait(params.swing, clock.gait)
    sideways = lateral.for_gait(params.lateral, clock.gait)
    arrival = Arrival(
        place=way + motion.lead * own.velocity_time * (1.0 - fade),
        velocity=velocity + error,
        error=error,
        heading=jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-1),
        height=jnp.broadcast_to(params.height[clock.gait] + motion.height, wait.shape[:1]),
    )
    place = jax.vmap(footholds, (None, None, 0, None, 0, None, None))(
        params.robot,
        settings.offset,
        arrival,
        com,
        stance_time[nodes.phase[first], legs],
        jnp.stack([settings.velocity_gain, sideways.foothold_gain]),
        motion.velocity[2],
    )
    later = jnp.concatenate([place, rise(slope, place)[..., None]], axis=-1)
    return jnp.where((lifted < 0)[..., None], touching[None], later)


def _torque_maps(
    params: ControllerParams,
    states: BodyState,
    contacts: Float[Array, "K 4 3"],
    com: Float[Array, "3"],
) -> Float[Array, "K 4 3 3"]:
    """Torque of each joint per force on its foot, on the nominal way [m]."""
    robot = params.robot

    def one(R: Array, p: Array, touching: Array) -> Array:
        foot = touching.at[:, 2].add(robot.foot_radius)
        _, hip, trig = spatial.inverse(robot, (foot - p[None]) @ R + com[None] - robot.hip_pos)
        return -jnp.einsum("lij,wi->ljw", spatial.foot_jacobian(robot, hip, trig), R)

    return jax.vmap(one)(states.R[:-1], states.p[:-1], contacts)


def _wrapped(angle: Float[Array, ""]) -> Float[Array, ""]:
    """The angle within half a turn of zero [rad]."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))
