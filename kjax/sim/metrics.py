"""What an episode starts from and what it leaves: initial state, noise, trajectory, metrics."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float, Int

from kjax import qp
from kjax.config import (
    RunConfig,
    SimConfig,
)
from kjax.config.gaits import gait_setting
from kjax.config.units import in_si
from kjax.controllers.resolve import build_command
from kjax.controllers.walkable import build_gaits
from kjax.legs.base import build_base
from kjax.legs.posture import stand_pose
from kjax.robots import Robot, get_robot
from kjax.sim import free_base
from kjax.sim.observe import Observe, find_addresses
from kjax.sim.scene import robot_addresses
from kjax.types import COMMAND_NAMES, RobotParams

# Height of the centre of mass over the leg's length; about the trunk lying on the ground.
FALL_HEIGHT = 0.28
FALL_TILT = 1.0  # rad, pitch or roll
SETTLE_TIME = 0.5  # s; metrics leave out the start from standing
LATE_TIME = 2.0  # s after the last change of command, for what should be steady by then


@dataclass(kw_only=True)
class Trajectory:
    """One robot's episode; arrays (N,) at the physics rate, from a batch at the control rate.

    Attributes:
      dt: time between two samples [s].
      time: [s].
      qpos: (N, nq) positions of the model.
      qvel: (N, nv) velocities of the model.
      x: (N, 6) true SRB state of the whole-body centre of mass, from the start on the floor
        [m, rad, m/s, rad/s].
      feet: (N, 4, 2) foot centres (x, z), likewise, in the plane of a free base's heading [m].
      foot_force: (N, 4) normal force on the contact sensors [N].
      torque: (N, 4, 3) joint torques commanded (abduction, thigh, calf) [N m].
      gait: (N,) index of the gait, order of ``controller.build_gaits``.
      stance: (N, 4) scheduled stance.
      force: (N, 4, 3) planned force of each leg on the robot, world axes, turned by the heading
        at the start [N].
      velocity_command: (N,) [m/s].
      velocity_reference: (N,) what the LMPC tracks: the command at a bounded rate [m/s].
      body_contact: (P,) whether anything but a foot touches the world at a control tick; from a
        batch (0,).
      plan_status: (P,) ``qp.Status`` of each plan.
      plan_residual: (P,) KKT residual [-].
      plan_iterations: (P,) solver iterations.
      plan_time: (P,) wall time of each call [s]; from a batch (0,).
      act_time: (N,) wall time of each call [s]; from a batch (0,).
      wall_time: of the whole loop [s]; from a batch the time of all of it.
      fell: whether the robot fell (the episode ends there).
      interrupted: whether the user stopped the run.
    """

    dt: float
    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    x: np.ndarray
    feet: np.ndarray
    foot_force: np.ndarray
    torque: np.ndarray
    gait: np.ndarray
    stance: np.ndarray
    force: np.ndarray
    velocity_command: np.ndarray
    velocity_reference: np.ndarray
    body_contact: np.ndarray
    plan_status: np.ndarray
    plan_residual: np.ndarray
    plan_iterations: np.ndarray
    plan_time: np.ndarray
    act_time: np.ndarray
    wall_time: float
    fell: bool
    interrupted: bool

    def save(self, path: Path) -> None:
        """Write everything to a compressed ``.npz``."""
        np.savez_compressed(path, **{f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def load(cls, path: Path) -> "Trajectory":
        """Read what ``save`` wrote."""
        with np.load(path) as data:
            values: dict[str, Any] = {f.name: data[f.name] for f in fields(cls)}
        for name, kind in (
            ("dt", float),
            ("wall_time", float),
            ("fell", bool),
            ("interrupted", bool),
        ):
            values[name] = kind(values[name])
        return cls(**values)


def reference_height(
    gait: Int[np.ndarray, "N"], time: Float[np.ndarray, "N"], config: RunConfig
) -> Float[np.ndarray, "N"]:
    """Height of the centre of mass above the ground that is asked for [m].

    Args:
      gait: (N,) index of the gait.
      time: (N,) since the start [s].
      config: of the run.
    """
    si = in_si(config, get_robot(config.robot).params)
    heights = [gait_setting(si, one.name, "body_height") for one in build_gaits(config)]
    command = build_command(config.command)
    piece = np.searchsorted(command.times, time + 1e-9, side="right") - 1
    return np.array(heights)[gait] + command.values[piece, COMMAND_NAMES.index("height")]


def initial_state(config: RunConfig, model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Qpos (nq,), qvel (nv,) of the robot, standing, disturbed as the config and its seed say."""
    robot = get_robot(config.robot)
    si = in_si(config, robot.params)
    height, joints = stand_pose(
        robot.params, float(gait_setting(si, config.gait.names[0], "body_height"))
    )
    pose, rates = np.zeros(3), np.zeros(3)
    pose[1] = height
    spread, noise = config.noise, np.random.default_rng([config.seed, 0])
    if spread.enabled:
        pitch = spread.initial_pitch * noise.standard_normal()
        pose[2] = -pitch
        # Keep the lower pair of feet on the ground rather than in it.
        pose[1] += abs(np.sin(pitch)) * robot.params.hip_pos[0, 0]
        rates[:2] = spread.initial_velocity * noise.standard_normal(2)
        rates[2] = -spread.initial_pitch_rate * noise.standard_normal()
    if config.sim.base == "free":
        pose, rates = free_base.from_planar(pose, rates)
        free_base.turn(pose, rates, config.sim.heading)
        pose[:3] += [*config.sim.start, config.sim.floor]
    else:
        pose[:2] += [config.sim.start[0], config.sim.floor]
    qpos, qvel = np.zeros(model.nq), np.zeros(model.nv)
    if (len(pose) + 12, len(rates) + 12) != (model.nq, model.nv):
        raise ValueError(
            f"sim.base = '{config.sim.base}' has no model of nq {model.nq} and nv {model.nv}"
        )
    qpos[: len(pose)], qvel[: len(rates)] = pose, rates
    find_addresses(robot, model).set_joints(qpos, joints)
    return qpos, qvel


def origin(sim: SimConfig) -> np.ndarray:
    """Where a robot starts, on the floor (3,), world [m]; recorded states are measured from it."""
    sideways = sim.start[1] if sim.base == "free" else 0.0
    return np.array([sim.start[0], sideways, sim.floor])


def sagittal(
    robot: RobotParams,
    observe: Observe,
    qpos: np.ndarray,
    qvel: np.ndarray,
    start: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """True SRB states (N, 6) and feet (N, 4, 2) along a trajectory, without noise.

    Of a free base: in the plane of its heading, with the progress along the heading at the start.

    Args:
      robot: geometry and masses.
      observe: of the model.
      qpos: (N, nq) positions.
      qvel: (N, nv) velocities.
      start: (3,) point that positions are measured from, the world's origin if ``None`` [m].
    """
    zero = jnp.zeros(3) if start is None else jnp.asarray(start)
    base = build_base("free" if free_base.is_free(qpos) else "planar")
    track = base.track(observe(jnp.asarray(qpos[0]), jnp.asarray(qvel[0]), jnp.zeros(64)))

    def one(qpos: jax.Array, qvel: jax.Array) -> tuple[jax.Array, jax.Array]:
        seen = observe(qpos, qvel, jnp.zeros(64))
        seen = seen._replace(base_pos=seen.base_pos - zero)
        body = base.view(robot, track, seen).planar
        return body.x, body.feet

    x, feet = jax.jit(jax.vmap(one))(qpos, qvel)
    return np.asarray(x), np.asarray(feet)


def metrics(run: Trajectory, config: RunConfig) -> dict[str, Any]:
    """Flat metrics of an episode, the unit in the key."""
    steady = run.time >= SETTLE_TIME
    result: dict[str, Any] = {
        "fell": run.fell,
        "fall_time_s": float(run.time[-1]) if run.fell else None,
        "interrupted": run.interrupted,
        "simulated_s": float(len(run.time) * run.dt),
    }
    if not steady.any():
        return result
    error = run.x[steady, 3] - run.velocity_command[steady]
    pitch = np.degrees(np.abs(run.x[steady, 2]))
    height = run.x[steady, 1]
    limit = get_robot(config.robot).params.torque_limit
    saturated = np.abs(run.torque) >= 0.999 * limit
    joints = saturated.any(axis=1).mean(axis=0)
    unsolved = run.plan_status != qp.Status.SOLVED
    result |= {
        "velocity_rmse_mps": float(np.sqrt(np.mean(error**2))),
        "pitch_max_deg": float(pitch.max()),
        "pitch_p95_deg": float(np.percentile(pitch, 95)),
        "height_mean_m": float(height.mean()),
        "height_min_m": float(height.min()),
        "height_max_m": float(height.max()),
        "distance_m": float(run.x[-1, 0] - run.x[0, 0]),
        **_tracking(run, config),
        **_crossing(run, config),
        **_switching(run, config),
        **free_base.metrics(run.qpos, steady),
        "foot_slip_m": foot_slip(run, get_robot(config.robot), config.sim.contact_threshold),
        "torque_max_nm": float(np.abs(run.torque).max()),
        "torque_saturation_fraction": float(saturated.any(axis=(1, 2)).mean()),
        **{
            f"{name}_saturation_fraction": float(value)
            for name, value in zip(("abduction", "thigh", "knee"), joints, strict=True)
        },
        "body_contact_fraction": (
            float(run.body_contact.mean())
            if config.sim.contacts == "all" and len(run.body_contact)
            else None
        ),
        "qp_unsolved": int(unsolved.sum()),
        "qp_iterations_median": float(np.median(run.plan_iterations)),
    }
    if len(run.plan_time):
        result |= {
            "plan_ms_median": float(1e3 * np.median(run.plan_time)),
            "plan_ms_p99": float(1e3 * np.percentile(run.plan_time, 99)),
            "act_ms_median": float(1e3 * np.median(run.act_time)),
            "act_ms_p99": float(1e3 * np.percentile(run.act_time, 99)),
            "realtime_factor": float(len(run.time) * run.dt / run.wall_time),
        }
    return result


def metric_names(config: RunConfig) -> set[str]:
    """Keys of ``metrics`` of an episode of this config, but for those of wall time.

    An episode that ends before the robot has settled (``SETTLE_TIME``) has the first four only.
    """
    names = {"fell", "fall_time_s", "interrupted", "simulated_s"}
    if config.duration <= SETTLE_TIME:
        return names
    names |= {
        "velocity_rmse_mps", "velocity_reference_rmse_mps", "pitch_max_deg", "pitch_p95_deg",
        "height_mean_m", "height_min_m", "height_max_m", "distance_m", "foot_slip_m",
        "torque_max_nm", "torque_saturation_fraction", "abduction_saturation_fraction",
        "thigh_saturation_fraction", "knee_saturation_fraction", "body_contact_fraction",
        "qp_unsolved", "qp_iterations_median",
    }  # fmt: skip
    if config.duration > config.command.times[-1] + LATE_TIME:
        names |= {"velocity_late_mean_mps", "velocity_late_rmse_mps"}
    if config.terrain.kind == "flat":
        names |= {"height_error_max_m", "height_error_mean_m"}
    else:
        names |= {"crossed", "field_pitch_p95_deg"}
    if len(config.gait.times) > 1:
        names |= {"switch_time_s", "switch_pitch_max_deg", "pitch_settle_s"}
    if config.sim.base == "free":
        names |= {"roll_max_deg", "yaw_max_deg", "lateral_drift_m"}
    return names


def _tracking(run: Trajectory, config: RunConfig) -> dict[str, Any]:
    """Speed against what the LMPC is given and late in the run; height against the configured one.

    The height is that of the gait in use (for a bound its mean in stance), on flat ground only.
    """
    steady = run.time >= SETTLE_TIME
    against = run.x[steady, 3] - run.velocity_reference[steady]
    result: dict[str, Any] = {
        "velocity_reference_rmse_mps": float(np.sqrt(np.mean(against**2))),
    }
    late = run.time >= max(SETTLE_TIME, config.command.times[-1] + LATE_TIME)
    if late.any():
        error = run.x[late, 3] - run.velocity_command[late]
        result |= {
            "velocity_late_mean_mps": float(run.x[late, 3].mean()),
            "velocity_late_rmse_mps": float(np.sqrt(np.mean(error**2))),
        }
    if config.terrain.kind == "flat":
        error = run.x[steady, 1] - reference_height(run.gait[steady], run.time[steady], config)
        result |= {
            "height_error_max_m": float(np.abs(error).max()),
            "height_error_mean_m": float(abs(error.mean())),
        }
    return result


def _crossing(run: Trajectory, config: RunConfig) -> dict[str, Any]:
    """Whether the robot has left the obstacle field behind, where there is one."""
    if config.terrain.kind == "flat":
        return {}
    clear = config.terrain.end + 0.3  # m, the rear feet as well
    inside = (run.x[:, 0] > config.terrain.start - 0.3) & (run.x[:, 0] < clear)
    pitch = np.degrees(np.abs(run.x[inside, 2]))
    return {
        "crossed": bool(not run.fell and run.x[-1, 0] > clear),
        "field_pitch_p95_deg": float(np.percentile(pitch, 95)) if inside.any() else None,
    }


def _switching(run: Trajectory, config: RunConfig) -> dict[str, Any]:
    """When the last switch of gait happened, and the pitch after it.

    Settled means: from then on the pitch stays within 3 deg, or within 1.1 times its largest value
    in the last second where the gait itself pitches more.
    """
    changes = np.flatnonzero(np.diff(run.gait)) + 1
    if len(config.gait.times) < 2 or not len(changes):
        return {}
    at = changes[np.searchsorted(run.time[changes], config.gait.times[-1] - 1e-9)]
    pitch = np.degrees(np.abs(run.x[at:, 2]))
    last = pitch[-round(1.0 / run.dt) :]
    outside = np.flatnonzero(pitch > max(3.0, 1.1 * float(last.max())))
    settled = (outside[-1] + 1) * run.dt if len(outside) else 0.0
    return {
        "switch_time_s": float(run.time[at]),
        "switch_pitch_max_deg": float(pitch.max()),
        "pitch_settle_s": float(settled),
    }


def foot_slip(run: Trajectory, robot: Robot, threshold: float) -> float:
    """Mean path that a foot's contact point slides along the ground per stance [m].

    The foot is a sphere: while the calf turns, its centre moves without slip. What counts is the
    velocity of the material point at the bottom, v_centre - (d angle / dt) * radius.
    """
    free = free_base.is_free(run.qpos)
    at = robot_addresses(robot, "free" if free else "planar")
    joints = at.joint_pos(run.qpos)
    if free:
        rates, quat = at.joint_vel(run.qvel), run.qpos[:, 3:7]
        speed = free_base.sliding_speed(robot.params, quat, run.qvel[:, :6], joints, rates)
        slide = run.dt * speed[:-1]
    else:
        angle = run.qpos[:, 2, None] + joints[:, :, 1] + joints[:, :, 2]  # of the calf, about +y
        rolled = robot.params.foot_radius * np.diff(angle, axis=0)
        slide = np.diff(run.feet[:, :, 0], axis=0) - rolled
    touching = run.foot_force > threshold
    pressed = touching[:-1] & touching[1:]
    stances = np.sum(np.diff(run.stance.astype(int), axis=0) > 0) + run.stance[0].sum()
    return float(np.abs(slide[pressed]).sum() / max(stances, 1))
