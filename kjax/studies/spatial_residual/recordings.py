"""Closed-loop episodes of the whole robot in three dimensions, kept in the study's folder."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from kjax.config import RunConfig
from kjax.controllers.resolve import resolve
from kjax.dynamics import srb_spatial
from kjax.dynamics.srb_spatial import BodyState, SpatialBody
from kjax.legs.base import build_base
from kjax.legs.spatial import rotate
from kjax.robots import get_robot
from kjax.runs.cache import open_cache
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.observe import build_observe
from kjax.sim.resolve import batch_spec, resolve_episodes
from kjax.sim.scene import build_model
from kjax.studies.spatial.cases import SpatialOptions
from kjax.studies.spatial.commands import random_configs
from kjax.sysid.spatial_residual import SpatialEpisode, phase_over
from kjax.sysid.transitions import TOUCH
from kjax.types import RobotParams

# N, 1 sigma on the planned forces, so that they are not only feedback. With 4 N the fit predicts
# episodes of its own kind as well, but takes feedback for dynamics: in closed loop the robot falls.
FORCE = 12.0


def recorded_configs(robots: int, duration: float) -> list[RunConfig]:
    """Trots at random commands; forces perturbed."""
    return [
        dataclasses.replace(
            one, duration=duration, noise=dataclasses.replace(one.noise, force=FORCE)
        )
        for one in random_configs("own", SpatialOptions(robots=robots))
    ]


def body_of(config: RunConfig) -> SpatialBody:
    """The rigid body that a config's controller predicts with."""
    spatial = resolve(config)[1].spatial
    assert spatial is not None
    return jax.tree.map(jnp.asarray, spatial.body)


def record(
    robots: int, duration: float, folder: Path, threads: int | None = None
) -> SpatialEpisode:
    """Episodes that stood to their end (E, T, ...), from the folder where they lie there already.

    Args:
      robots: number of episodes.
      duration: of each [s].
      folder: the study's.
      threads: of the engine.
    """
    configs = recorded_configs(robots, duration)
    cache = open_cache(folder, Path(__file__))
    key = cache.key(*configs)
    arrays = cache.arrays(key)
    if arrays is None:
        print(f"recording {robots} episodes of {duration:g} s ...", flush=True)
        engine = BatchEngine(
            batch_spec(configs[0]), torques="held", threads=threads, dtype=np.float32
        )
        run = engine.run(resolve_episodes(configs))
        if run.interrupted:
            raise KeyboardInterrupt
        log = run.log
        arrays = {
            "qpos": run.qpos, "qvel": run.qvel, "force": log.force, "stance": log.stance,
            "foot_force": log.foot_force, "fell": run.fell,
        }  # fmt: skip
        cache.add_arrays(key, arrays)
        print(f"  {int(run.fell.sum())} falls, {run.wall_time:.0f} s", flush=True)
    return _episodes(arrays, configs[0])


def _episodes(arrays: dict[str, np.ndarray], config: RunConfig) -> SpatialEpisode:
    """What the controller would have seen without noise, by episode."""
    robot = get_robot(config.robot)
    observe = build_observe(robot, build_model(robot, batch_spec(config).scene), 0.0)
    params, body = resolve(config)[1].robot, body_of(config)
    base = build_base("free")
    track = jnp.array([1.0, 0.0])

    def one(qpos: jax.Array, qvel: jax.Array) -> tuple[BodyState, jax.Array, jax.Array]:
        view = base.view(_floats(params), track, observe(qpos, qvel, jnp.zeros(64)))
        whole = view.whole
        assert whole is not None
        omega = rotate(whole.heading, whole.omega)
        state = BodyState(
            p=whole.com,
            R=whole.rotation,
            v=rotate(whole.heading, whole.com_vel),
            L=srb_spatial.momentum(body, whole.rotation, omega),
        )
        soles = whole.feet.at[:, 2].add(-params.foot_radius)
        return state, omega, soles

    stood = ~arrays["fell"].astype(bool)
    qpos, qvel = (np.swapaxes(arrays[key][:, stood], 0, 1) for key in ("qpos", "qvel"))
    states, omega, feet = jax.jit(jax.vmap(jax.vmap(one)))(qpos.astype(float), qvel.astype(float))
    force, stance, foot_force = (
        np.swapaxes(arrays[key][:, stood], 0, 1) for key in ("force", "stance", "foot_force")
    )
    return SpatialEpisode(
        states=states, omega=omega, feet=feet, force=jnp.asarray(force, float),
        stance=jnp.asarray(stance), touch=jnp.asarray(foot_force > TOUCH),
        phase=jnp.asarray([phase_over(one) for one in stance.astype(bool)]),
    )  # fmt: skip


def _floats(robot: RobotParams) -> RobotParams:
    return jax.tree.map(lambda a: jnp.asarray(a, float), robot)
