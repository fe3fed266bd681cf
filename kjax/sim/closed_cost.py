"""The cost of ``kjax.tuning`` for what MuJoCo did, so that both are compared on the same scale."""

import numpy as np

from kjax.robots import get_robot
from kjax.sim import free_base
from kjax.sim.metrics import asked, reference_height, reference_velocity
from kjax.sim.recording import Recording
from kjax.tuning.loop import CostWeights, Trace, cost
from kjax.tuning.planar import PLANAR
from kjax.tuning.spatial import SPATIAL


def recording_costs(
    recording: Recording,
    weights: CostWeights = CostWeights(),  # noqa: B008
) -> np.ndarray:
    """Cost (B,) of every robot of a batch; ticks after its fall count as fallen.

    Planned forces stand for those on the body: what joints or ground keep back of them shows in the
    motion only.
    """
    out = []
    for robot, episode in enumerate(recording.episodes):
        is_spatial = episode.controller.spatial is not None
        trace = (_spatial_trace if is_spatial else _planar_trace)(recording, robot)
        params = get_robot(episode.goal.scene.robot).params
        out.append(float(cost(params, trace, weights, SPATIAL if is_spatial else PLANAR)))
    return np.array(out)


def _planar_trace(recording: Recording, robot: int) -> Trace:
    log = recording.log
    height = reference_height(log.gait[:, robot], _time(recording), recording.episodes[robot].goal)
    wanted = np.stack([log.velocity_reference[:, robot], height], axis=1)
    force = np.asarray(log.force[:, robot])[..., ::2]
    return _trace(recording, robot, log.x[:, robot], wanted, force)


def _spatial_trace(recording: Recording, robot: int) -> Trace:
    """The velocity along the heading and up is that of the centre of mass, sideways the trunk's."""
    log, goal, time = recording.log, recording.episodes[robot].goal, _time(recording)
    x, qpos, qvel = log.x[:, robot], recording.qpos[:, robot], recording.qvel[:, robot]
    roll, pitch, yaw = free_base.attitude(qpos)
    v_y = np.cos(yaw) * qvel[:, 1] - np.sin(yaw) * qvel[:, 0]
    omega = free_base.angular_velocity(qpos, qvel)
    along, left = (omega[:, 0] * np.cos(yaw) + omega[:, 1] * np.sin(yaw),
                   omega[:, 1] * np.cos(yaw) - omega[:, 0] * np.sin(yaw))  # fmt: skip
    state = np.stack(
        [roll, pitch, yaw, qpos[:, 0], qpos[:, 1], x[:, 1],
         along, left, omega[:, 2], x[:, 3], v_y, x[:, 4]],
        axis=1,
    )  # fmt: skip
    height = reference_height(log.gait[:, robot], time, goal)
    wanted = np.concatenate(
        [reference_velocity(time, goal), height[:, None], asked(time, goal, "roll", "pitch")],
        axis=1,
    )
    return _trace(recording, robot, state, wanted, np.asarray(log.force[:, robot]))


def _trace(
    recording: Recording, robot: int, x: np.ndarray, wanted: np.ndarray, force: np.ndarray
) -> Trace:
    log, ticks = recording.log, len(recording.qpos)
    return Trace(
        x=x,  # type: ignore[arg-type]
        wanted=wanted,  # type: ignore[arg-type]
        feet=log.feet[:, robot],
        stance=log.stance[:, robot],
        mode=log.gait[:, robot],
        force=force,  # type: ignore[arg-type]
        missing=np.zeros_like(force),  # type: ignore[arg-type]
        status=log.status[:, robot],
        alive=np.arange(ticks) < recording.ticks[robot] - recording.fell[robot],
    )


def _time(recording: Recording) -> np.ndarray:
    return recording.dt * np.arange(len(recording.qpos))
