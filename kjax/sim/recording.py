"""What a batch of closed loops leaves: one array per quantity, and each robot's episode from it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kjax.config import RunConfig
from kjax.sim.episode import Trajectory, metrics
from kjax.sim.walk import TickLog


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A batch's run, sampled at the beginning of each control tick (T ticks, B robots).

    Attributes:
      configs: of the robots.
      dt: control tick [s].
      ticks: (B,) number of ticks that each robot did, the one in which it fell included.
      fell: (B,) whether it did.
      qpos: (T, B, nq) positions of the model.
      qvel: (T, B, nv) velocities.
      torque: (T, B, 12) joint torques in leg order [N m].
      log: of the controller, leading axes (T, B).
      wall_time: of the run [s].
      interrupted: whether it was stopped before its end.
    """

    configs: Sequence[RunConfig]
    dt: float
    ticks: np.ndarray
    fell: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    torque: np.ndarray
    log: TickLog
    wall_time: float
    interrupted: bool = False

    def trajectory(self, robot: int) -> Trajectory:
        """The episode of one robot, as ``mujoco_loop.simulate`` returns it."""
        count = int(self.ticks[robot])

        def own(series: np.ndarray) -> np.ndarray:
            return np.asarray(series[:count, robot])

        log = TickLog(*map(own, self.log))
        none = np.zeros(0)
        return Trajectory(
            dt=self.dt,
            time=np.arange(count) * self.dt,
            qpos=own(self.qpos),
            qvel=own(self.qvel),
            x=log.x,
            feet=log.feet,
            foot_force=log.foot_force,
            torque=own(self.torque).reshape(-1, 4, 3),
            gait=log.gait,
            stance=log.stance,
            force=log.force,
            velocity_command=log.velocity_command,
            velocity_reference=log.velocity_reference,
            body_contact=none,
            plan_status=log.status,
            plan_residual=log.residual,
            plan_iterations=log.iterations,
            plan_time=none,
            act_time=none,
            wall_time=self.wall_time,
            fell=bool(self.fell[robot]),
            interrupted=self.interrupted,
        )

    def metrics(self) -> Iterator[dict[str, Any]]:
        """Metrics of each robot, as of a single run; those of wall time are left out."""
        for robot, config in enumerate(self.configs):
            yield metrics(self.trajectory(robot), config)


def empty_log(ticks: int, log: TickLog) -> TickLog:
    """Arrays (T, B, ...) for logs like ``log`` (B, ...)."""
    return TickLog(*(np.zeros((ticks, *leaf.shape), leaf.dtype) for leaf in log))
