"""Laps of a circle, the robot's place fed back from outside: a loop of one's own around it."""

import dataclasses
from typing import Any

import jax
import mujoco
import numpy as np

from kjax import ControlLoop
from kjax.config import RunConfig
from kjax.controllers.path import follow_path, nearest_on_circle
from kjax.sim import free_base
from kjax.sim.engines.mujoco import MujocoEngine
from kjax.sim.episode import initial_state
from kjax.sim.noise import add_noise, sensor_noise
from kjax.sim.resolve import resolve_episode
from kjax.sim.trajectory import sagittal
from kjax.studies.spatial.cases import (
    Done,
    Part,
    Row,
    SpatialOptions,
    base,
    median,
    number,
    share,
)
from kjax.studies.spatial.measures import FROM
from kjax.viz.tables import markdown_table

RADIUS, SPEED, LAPS = 1.0, 0.5, 10  # m, m/s
EVERY = 20  # physics steps between two commands
STANDS = 0.5  # s before the first


def configs(args: SpatialOptions) -> list[RunConfig]:
    """One for each of at most 8 seeds; a quick one goes for two seconds."""
    duration = 2.5 if args.quick else FROM + LAPS * 2 * np.pi * RADIUS / SPEED
    still = {"command.times": [0.0], "command.v_x": [0.0], "command.yaw_rate": []}
    one = base(args, {**still, "duration": round(duration, 2)}, "circle")
    one = dataclasses.replace(one, lmpc=dataclasses.replace(one.lmpc, position_slack=0.04))
    return [dataclasses.replace(one, seed=seed) for seed in range(min(args.seeds, 8))]


def lapped(config: RunConfig) -> Row:
    """One episode in C MuJoCo at 1 kHz, sensor noise on all that robot and path's loop see."""
    episode = resolve_episode(config)
    engine = MujocoEngine(episode.spec)
    model, at = engine.model, engine.addresses
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = initial_state(episode.start, model, at)
    mujoco.mj_forward(model, data)
    loop, high = ControlLoop(episode.spec.controller, episode.controller), data.qpos[2]
    dt, steps = model.opt.timestep, round(config.duration / model.opt.timestep)

    def look(qpos: Any, qvel: Any, sensors: Any, noise: Any) -> Any:
        return add_noise(engine.observe(qpos, qvel, sensors), noise)

    see, piece = jax.jit(look), 1000
    centre, kept = np.array([0.0, RADIUS]), []
    for i in range(steps):
        if i % piece == 0:
            noise = sensor_noise(episode.params, config.sim.base, piece, i)
        seen = jax.device_get(see(data.qpos, data.qvel, data.sensordata, noise[i % piece]))
        if i % EVERY == 0 and i * dt >= STANDS:
            place, yaw = np.asarray(seen.base_pos[:2], float), _yaw(seen.base_quat)
            point = nearest_on_circle(place, centre, RADIUS)
            loop.command(**follow_path(point, SPEED, place, yaw))
        joints = loop.step(seen, i * dt)
        data.ctrl[at.actuator] = at.sign * joints.torque
        kept.append((data.qpos.copy(), data.qvel.copy()))
        mujoco.mj_step(model, data)
        if data.qpos[2] < 0.5 * high:
            return {"fell": True}
    qpos, qvel = (np.array(one) for one in zip(*kept, strict=True))
    late = np.arange(steps) * dt >= FROM
    x, _ = sagittal(engine.robot.params, engine.observe, qpos, qvel, episode.params.origin)
    roll, pitch, _ = free_base.attitude(qpos[late])
    away = np.abs(np.hypot(*(qpos[late, :2] - centre).T) - RADIUS)
    return {
        "fell": False,
        "path_error_m": float(away.max()),
        "v_x_rmse_mps": float(np.sqrt(np.mean((x[late, 3] - SPEED) ** 2))),
        "tilt_max_deg": float(np.degrees(max(np.abs(roll).max(), np.abs(pitch).max()))),
    }


def _yaw(quat: Any) -> float:
    w, x, y, z = (float(one) for one in quat)
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _summary(args: SpatialOptions, done: Done) -> Row:
    rows = done(configs(args))
    up = [row for row in rows if not row["fell"]]
    return {
        "laps": LAPS,
        "falls": share(len(rows) - len(up), len(rows)),
        **median(up, "path_error_m", "path_error_m"),
        "path_error_worst_m": max((row["path_error_m"] for row in up), default=None),
        **median(up, "v_x_rmse_mps", "v_x_rmse_mps"),
    }


def _table(row: Row) -> str:
    header = ("circle, its place fed back", "episodes", "falls", "distance from the path [m]",
              "of the worst [m]", "RMSE v_x [m/s]")  # fmt: skip
    return markdown_table(header, [
        (f"{row['laps']} laps of {RADIUS:g} m at {SPEED:g} m/s", str(row["falls"]["episodes"]),
         str(row["falls"]["count"]), number(row["path_error_m"], 3),
         number(row["path_error_worst_m"], 3), number(row["v_x_rmse_mps"], 4))
    ])  # fmt: skip


CIRCLE = Part(name="laps", alone=configs, walk=lapped, summary=_summary, table=_table)
