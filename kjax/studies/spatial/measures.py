"""What is measured of a walk besides its usual metrics; in the order of the parts."""

from typing import Any

import numpy as np

from kjax.config import RunConfig
from kjax.sim import free_base
from kjax.sim.trajectory import Trajectory

FROM = 2.0  # s, from which errors count: half a second of standing, and time to get there
LAST = 2.0  # s at the end of a walk over which its speed is taken
AFTER = 1.0  # s after a switch in which its peak is looked for


def walked(run: Trajectory, config: RunConfig) -> dict[str, Any]:
    """Errors against the command in force, raw and averaged over a cycle, and the attitude."""
    late = run.time >= FROM
    if run.fell or not late.any():
        return {"errors": None}
    roll, pitch, yaw = free_base.attitude(run.qpos)
    moving = _moving(run, yaw)
    columns = (config.command.v_x, config.command.v_y, config.command.yaw_rate)
    last = np.array([column[-1] if column else 0.0 for column in columns])
    cycle = round(config.gaits[config.gait.names[0]].period / run.dt)
    mean = np.stack(
        [np.convolve(one, np.ones(cycle) / cycle, mode="valid") for one in moving[late].T], axis=-1
    )

    def rmse(values: np.ndarray) -> list[float]:
        return np.sqrt(np.mean((values - last) ** 2, axis=0)).tolist()

    tilt = np.degrees(np.abs(np.stack([roll, pitch])[:, late]))
    return {
        "errors": rmse(moving[late]),
        "errors_of_cycles": rmse(mean),
        "tilt_p95_deg": np.percentile(tilt, 95, axis=1).tolist(),
    }


def reached(run: Trajectory, config: RunConfig) -> dict[str, Any]:
    """Mean v_x, v_y and yaw rate at the end, and the largest roll and pitch meanwhile."""
    late = run.time >= config.duration - LAST
    if run.fell or not late.any():
        return {"reached": None}
    roll, pitch, yaw = free_base.attitude(run.qpos)
    tilt = np.degrees(np.abs(np.stack([roll, pitch])[:, late]))
    return {
        "reached": _moving(run, yaw)[late].mean(axis=0).tolist(),
        "tilt_max_deg": tilt.max(axis=1).tolist(),
    }


def switched(run: Trajectory, config: RunConfig) -> dict[str, Any]:
    """Largest |roll| and |pitch| within ``AFTER`` of each time of the gait's schedule."""
    if run.fell:
        return {"peaks_deg": None}
    roll, pitch, _ = free_base.attitude(run.qpos)
    tilt = np.degrees(np.abs(np.stack([roll, pitch])))
    windows = [(run.time >= t) & (run.time < t + AFTER) for t in config.gait.times[1:]]
    return {"peaks_deg": [tilt[:, window].max(axis=1).tolist() for window in windows]}


def stood(run: Trajectory, config: RunConfig) -> dict[str, Any]:
    """Nothing more than whether it fell."""
    del run, config
    return {}


def _moving(run: Trajectory, yaw: np.ndarray) -> np.ndarray:
    """v_x, v_y in the axes of the heading and yaw rate at every sample (N, 3)."""
    c, s = np.cos(yaw), np.sin(yaw)
    rate = np.gradient(np.unwrap(yaw), run.dt)
    return np.stack([run.x[:, 3], c * run.qvel[:, 1] - s * run.qvel[:, 0], rate], axis=-1)
