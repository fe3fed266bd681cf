"""Metrics of an episode against what was asked of it; the unit stands in the key."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from kjax import qp
from kjax.robots import Robot, get_robot
from kjax.sim import free_base
from kjax.sim.episode import Goal
from kjax.sim.scene import robot_addresses
from kjax.sim.tick_stats import TickStats, of_run
from kjax.sim.trajectory import Trajectory
from kjax.types import COMMAND_NAMES

SETTLE_TIME = 0.5  # s; metrics leave out the start from standing
LATE_TIME = 2.0  # s after the last change of command, for what should be steady by then


def reference_height(
    gait: Int[np.ndarray, "N"], time: Float[np.ndarray, "N"], goal: Goal
) -> Float[np.ndarray, "N"]:
    """Height of the centre of mass above the ground that is asked for [m].

    Args:
      gait: (N,) index of the gait.
      time: (N,) since the start [s].
      goal: of the episode.
    """
    return goal.heights[gait] + asked(time, goal, "height")[:, 0]


def reference_velocity(time: Float[np.ndarray, "N"], goal: Goal) -> Float[np.ndarray, "N 3"]:
    """References of v_x, v_y [m/s] and yaw rate [rad/s]: the command at bounded rates.

    Args:
      time: (N,) since the start [s].
      goal: of the episode.
    """
    columns = [COMMAND_NAMES.index(name) for name in ("v_x", "v_y", "yaw_rate")]
    wanted = np.asarray(goal.command.values)[:, columns]
    begin = np.asarray(goal.command.times, float)
    rates = goal.slews[[0, 0, 1]]
    finite = np.where(np.isfinite(rates), rates, 0.0)

    def moved(change: np.ndarray, passed: Any) -> np.ndarray:
        most = np.where(np.isfinite(rates), finite * passed, np.inf)
        return np.clip(change, -most, most)

    out, before = np.zeros((len(time), 3)), np.zeros(3)
    for piece, (start, end) in enumerate(zip(begin, [*begin[1:], np.inf], strict=True)):
        inside = (time >= start - 1e-9) & (time < end - 1e-9)
        change, passed = wanted[piece] - before, time[inside, None] - start
        out[inside] = before + moved(change, passed)
        if np.isfinite(end):
            before = before + moved(change, end - start)
    return out


def asked(time: Float[np.ndarray, "N"], goal: Goal, *names: str) -> Float[np.ndarray, "N k"]:
    """Columns of the command at some times."""
    piece = np.searchsorted(goal.command.times, time + 1e-9, side="right") - 1
    columns = [COMMAND_NAMES.index(name) for name in names]
    return np.asarray(goal.command.values)[piece][:, columns]


def metrics(run: Trajectory, goal: Goal, stats: TickStats | None = None) -> dict[str, Any]:
    """Flat metrics of an episode, the unit in the key.

    Args:
      run: the episode.
      goal: what was asked in it.
      stats: of the physics steps between its samples; its samples themselves if ``None``.
        Percentiles, roll and yaw, and what concerns fields and switches are of the samples.
    """
    if not isinstance(goal, Goal):
        raise TypeError(
            f"goal: wanted kjax.sim.resolve.resolve_goal(config), got {type(goal).__name__}"
        )
    steady = run.time >= SETTLE_TIME
    result: dict[str, Any] = {
        "fell": run.fell,
        "fall_time_s": float(run.time[-1]) if run.fell else None,
        "interrupted": run.interrupted,
        "simulated_s": float(len(run.time) * run.dt),
    }
    if not steady.any():
        return result
    robot, scene = get_robot(goal.scene.robot), goal.scene
    if stats is None:
        slip = slip_path(run, robot, scene.contact_threshold)
        stats = of_run(run, slip, np.asarray(robot.params.torque_limit))
    # Ticks whose steps are known: not that of a fall, and none with a number that is not finite.
    known = (stats.steps > 0) & (run.time[: len(stats.steps)] >= SETTLE_TIME)
    if not known.any():
        return result
    walked, steps = TickStats(*(series[known] for series in stats)), stats.steps[known].sum()
    joints = stats.saturated_joints.sum(axis=0) / stats.steps.sum()
    unsolved = run.plan_status != qp.Status.SOLVED
    result |= {
        "velocity_rmse_mps": float(np.sqrt(walked.command_error.sum() / steps)),
        "pitch_max_deg": float(np.degrees(walked.pitch.max())),
        "pitch_p95_deg": float(np.percentile(np.degrees(np.abs(run.x[steady, 2])), 95)),
        "height_mean_m": float(walked.height.sum() / steps),
        "height_min_m": float(walked.height_min.min()),
        "height_max_m": float(walked.height_max.max()),
        "distance_m": float(run.x[-1, 0] - run.x[0, 0]),
        **_tracking(run, goal, stats, known),
        **_crossing(run, goal),
        **_switching(run, goal),
        **free_base.metrics(run.qpos, run.qvel, asked(run.time, goal, "v_y", "yaw_rate"), steady),
        **free_base.path_errors(run.qpos, reference_velocity(run.time, goal), run.dt),
        "foot_slip_m": float(stats.slip.sum() / _stances(run)),
        "torque_max_nm": float(stats.torque.max()),
        "torque_saturation_fraction": float(stats.saturated.sum() / stats.steps.sum()),
        **{
            f"{name}_saturation_fraction": float(value)
            for name, value in zip(("abduction", "thigh", "knee"), joints, strict=True)
        },
        "body_contact_fraction": (
            float(run.body_contact.mean())
            if scene.contacts == "all" and len(run.body_contact)
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


def metric_names(goal: Goal) -> set[str]:
    """Keys of ``metrics`` of an episode with this goal, but for those of wall time.

    An episode that ends before the robot has settled (``SETTLE_TIME``) has the first four only.
    """
    names = {"fell", "fall_time_s", "interrupted", "simulated_s"}
    if goal.duration <= SETTLE_TIME:
        return names
    names |= {
        "velocity_rmse_mps", "velocity_reference_rmse_mps", "pitch_max_deg", "pitch_p95_deg",
        "height_mean_m", "height_min_m", "height_max_m", "distance_m", "foot_slip_m",
        "torque_max_nm", "torque_saturation_fraction", "abduction_saturation_fraction",
        "thigh_saturation_fraction", "knee_saturation_fraction", "body_contact_fraction",
        "qp_unsolved", "qp_iterations_median",
    }  # fmt: skip
    if goal.duration > goal.command.times[-1] + LATE_TIME:
        names |= {"velocity_late_mean_mps", "velocity_late_rmse_mps"}
    if goal.scene.terrain == "flat":
        names |= {"height_error_max_m", "height_error_mean_m"}
    else:
        names |= {"crossed", "field_pitch_p95_deg"}
    if len(goal.gait_times) > 1:
        names |= {"switch_time_s", "switch_pitch_max_deg", "pitch_settle_s"}
    if goal.scene.base == "free":
        names |= {
            "roll_max_deg", "roll_p95_deg", "yaw_max_deg", "velocity_y_rmse_mps",
            "yaw_rate_rmse_radps", "lateral_drift_m", "path_error_max_m", "heading_error_max_deg",
        }  # fmt: skip
    return names


def _tracking(
    run: Trajectory, goal: Goal, stats: TickStats, known: Bool[np.ndarray, "P"]
) -> dict[str, Any]:
    """Speed against what the LMPC is given and late in the run; height against the configured one.

    The height is that of the gait in use (for a bound its mean in stance), on flat ground only.
    """
    time, gait = run.time[: len(known)], run.gait[: len(known)]
    result: dict[str, Any] = {
        "velocity_reference_rmse_mps": float(
            np.sqrt(stats.reference_error[known].sum() / stats.steps[known].sum())
        ),
    }
    late = known & (time >= goal.command.times[-1] + LATE_TIME)
    if late.any():
        steps = stats.steps[late].sum()
        result |= {
            "velocity_late_mean_mps": float(stats.velocity[late].sum() / steps),
            "velocity_late_rmse_mps": float(np.sqrt(stats.command_error[late].sum() / steps)),
        }
    if goal.scene.terrain == "flat":
        wanted = reference_height(gait[known], time[known], goal)
        steps = stats.steps[known]
        extremes = np.stack([stats.height_min[known], stats.height_max[known]]) - wanted
        result |= {
            "height_error_max_m": float(np.abs(extremes).max()),
            "height_error_mean_m": float(
                abs((stats.height[known] - steps * wanted).sum() / steps.sum())
            ),
        }
    return result


def _crossing(run: Trajectory, goal: Goal) -> dict[str, Any]:
    """Whether the robot has left the obstacle field behind, where there is one."""
    if goal.scene.terrain == "flat":
        return {}
    clear = goal.field[1] + 0.3  # m, the rear feet as well
    inside = (run.x[:, 0] > goal.field[0] - 0.3) & (run.x[:, 0] < clear)
    pitch = np.degrees(np.abs(run.x[inside, 2]))
    return {
        "crossed": bool(not run.fell and run.x[-1, 0] > clear),
        "field_pitch_p95_deg": float(np.percentile(pitch, 95)) if inside.any() else None,
    }


def _switching(run: Trajectory, goal: Goal) -> dict[str, Any]:
    """When the last switch of gait happened, and the pitch after it.

    Settled means: from then on the pitch stays within 3 deg, or within 1.1 times its largest value
    in the last second where the gait itself pitches more.
    """
    changes = np.flatnonzero(np.diff(run.gait)) + 1
    if len(goal.gait_times) < 2 or not len(changes):
        return {}
    at = changes[np.searchsorted(run.time[changes], goal.gait_times[-1] - 1e-9)]
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
    """Mean path that a foot's contact point slides along the ground per stance [m]."""
    return float(slip_path(run, robot, threshold).sum() / _stances(run))


def slip_path(run: Trajectory, robot: Robot, threshold: float) -> Float[np.ndarray, "N-1"]:
    """Path along the ground that feet in contact slide from each sample to the next, summed [m].

    The foot is a sphere: while the calf turns, its centre moves without slip. What counts is the
    velocity of the material point at the bottom, v_centre - (d angle / dt) * radius; on the planar
    base along x only.
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
        slide = np.abs(np.diff(run.feet[:, :, 0], axis=0) - rolled)
    touching = run.foot_force > threshold
    pressed = touching[:-1] & touching[1:]
    return np.asarray(np.where(pressed, slide, 0.0).sum(axis=1))


def _stances(run: Trajectory) -> int:
    """Number of stances that began, one at least."""
    begun = np.sum(np.diff(run.stance.astype(int), axis=0) > 0) + run.stance[0].sum()
    return max(int(begun), 1)
