"""What engines leave of closed loops: one array per quantity (time x robot), and views of it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kjax.sim.closed_loop import TickLog
from kjax.sim.episode import Episode
from kjax.sim.metrics import metrics
from kjax.sim.tick_stats import TickStats
from kjax.sim.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Closed loops of B robots: T samples, P control ticks.

    The single engine samples every physics step, batches at the beginning of each tick (T = P).
    Rows after a robot's end mean nothing.

    Attributes:
      episodes: of the robots.
      dt: time between two samples [s].
      per_tick: samples of a control tick.
      samples: (B,) number of samples of each robot.
      ticks: (B,) number of ticks that each robot began, the one in which it fell included.
      fell: (B,) whether it did.
      qpos: (T, B, nq) positions of the model.
      qvel: (T, B, nv) velocities.
      torque: (T, B, 12) joint torques in leg order [N m].
      x: (T, B, 6) true SRB state, see ``Trajectory``.
      feet: (T, B, 4, 2) foot centres, likewise [m].
      foot_force: (T, B, 4) normal force on the contact sensors [N].
      log: of the controller, leading axes (P, B).
      stats: of the physics steps between the samples, leading axes (P, B); ``None`` where the
        samples are all that is known. In the tick of a fall there are none.
      body_contact: (P, B) whether anything but a foot touches the world, or (0, B) where the engine
        does not look.
      plan_time: (P, B) wall time of each call of ``plan``, or (0, B) from a batch [s].
      act_time: (T, B) that of ``act``, likewise [s].
      wall_time: of the run [s].
      interrupted: whether it was stopped before its end.
    """

    episodes: Sequence[Episode]
    dt: float
    per_tick: int
    samples: np.ndarray
    ticks: np.ndarray
    fell: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    torque: np.ndarray
    x: np.ndarray
    feet: np.ndarray
    foot_force: np.ndarray
    log: TickLog
    body_contact: np.ndarray
    plan_time: np.ndarray
    act_time: np.ndarray
    wall_time: float
    interrupted: bool = False
    stats: TickStats | None = None

    def trajectory(self, robot: int) -> Trajectory:
        """The episode of one robot."""
        samples, ticks = int(self.samples[robot]), int(self.ticks[robot])

        def of_robot(series: np.ndarray) -> np.ndarray:
            return np.asarray(series[:samples, robot])

        log = TickLog(*(np.asarray(series[:ticks, robot]) for series in self.log))
        held = np.arange(samples) // self.per_tick
        return Trajectory(
            dt=self.dt,
            time=np.arange(samples) * self.dt,
            qpos=of_robot(self.qpos),
            qvel=of_robot(self.qvel),
            x=of_robot(self.x),
            feet=of_robot(self.feet),
            foot_force=of_robot(self.foot_force),
            torque=of_robot(self.torque).reshape(-1, 4, 3),
            gait=log.gait[held],
            stance=log.stance[held],
            force=log.force[held],
            velocity_command=log.velocity_command[held],
            velocity_reference=log.velocity_reference[held],
            body_contact=np.asarray(self.body_contact[:ticks, robot]),
            plan_status=log.status,
            plan_residual=log.residual,
            plan_iterations=log.iterations,
            plan_time=np.asarray(self.plan_time[:ticks, robot]),
            act_time=of_robot(self.act_time),
            wall_time=self.wall_time,
            fell=bool(self.fell[robot]),
            interrupted=self.interrupted,
        )

    def metrics(self) -> Iterator[dict[str, Any]]:
        """Metrics of each robot; from a batch without those of wall time."""
        for robot, episode in enumerate(self.episodes):
            yield metrics(self.trajectory(robot), episode.goal, self._stats_of(robot))

    def _stats_of(self, robot: int) -> TickStats | None:
        if self.stats is None:
            return None
        whole = int(self.ticks[robot]) - int(self.fell[robot])
        return TickStats(*(np.asarray(series[:whole, robot], float) for series in self.stats))


def recording_of_ticks(
    episodes: Sequence[Episode],
    dt: float,
    *,
    ticks: np.ndarray,
    fell: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray,
    torque: np.ndarray,
    log: TickLog,
    wall_time: float,
    interrupted: bool,
    stats: TickStats | None = None,
) -> Recording:
    """A batch's recording, sampled at the beginning of each control tick of ``dt``.

    Eleven arguments: the fields of ``Recording`` that engines differ in, by keyword.
    """
    none = np.zeros((0, len(ticks)))
    return Recording(
        episodes=list(episodes),
        dt=dt,
        per_tick=1,
        samples=ticks,
        ticks=ticks,
        fell=fell,
        qpos=qpos,
        qvel=qvel,
        torque=torque,
        x=log.x,
        feet=log.feet,
        foot_force=log.foot_force,
        log=log,
        body_contact=none,
        plan_time=none,
        act_time=none,
        wall_time=wall_time,
        interrupted=interrupted,
        stats=stats,
    )


def empty_log(ticks: int, log: TickLog) -> TickLog:
    """Arrays (T, B, ...) for logs like ``log`` (B, ...)."""
    return TickLog(*(np.zeros((ticks, *leaf.shape), leaf.dtype) for leaf in log))


def concatenate(recordings: Sequence[Recording]) -> Recording:
    """Recordings of one rate as one; shorter ones are filled up with zeros."""
    first = recordings[0]

    def along(arrays: Sequence[np.ndarray]) -> np.ndarray:
        rows = max(len(array) for array in arrays)
        filled = [
            np.concatenate([array, np.zeros((rows - len(array), *array.shape[1:]), array.dtype)])
            for array in arrays
        ]
        return np.concatenate(filled, axis=1)

    def whole(name: str) -> np.ndarray:
        return np.concatenate([getattr(one, name) for one in recordings])

    stats = [one.stats for one in recordings if one.stats is not None]
    series = ("qpos", "qvel", "torque", "x", "feet", "foot_force")
    per_call = ("body_contact", "plan_time", "act_time")
    return Recording(
        episodes=[episode for one in recordings for episode in one.episodes],
        dt=first.dt,
        per_tick=first.per_tick,
        samples=whole("samples"),
        ticks=whole("ticks"),
        fell=whole("fell"),
        log=TickLog(*map(along, zip(*(one.log for one in recordings), strict=True))),
        **{name: along([getattr(one, name) for one in recordings]) for name in series + per_call},
        stats=(
            TickStats(*map(along, zip(*stats, strict=True)))
            if len(stats) == len(recordings)
            else None
        ),
        wall_time=sum(one.wall_time for one in recordings),
        interrupted=any(one.interrupted for one in recordings),
    )
