"""The plan's weights of each model, found by CMA-ES with the same number of episodes for all."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from kjax.config import RunConfig
from kjax.runs.cache import Cache
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.resolve import batch_spec, resolve_episodes
from kjax.studies.spatial_walks.cases import SpatialWalksOptions, observed, tuning_configs
from kjax.studies.tune.evolution import Evolution, evolve

NAMES = (
    "roll", "pitch", "yaw", "omega_x", "omega_y", "omega_z", "v_x", "v_y", "force",
)  # fmt: skip


def logs_of(config: RunConfig) -> Float[np.ndarray, "9"]:
    """Logs of a config's weights, in the order of ``NAMES``."""
    own = config.spatial
    return np.log([*own.attitude, *own.omega, *own.velocity[:2], own.force])


def weighted(config: RunConfig, logs: Float[np.ndarray, "9"]) -> RunConfig:
    """The config with other weights; those of place and of v_z stay."""
    w = np.exp(np.asarray(logs, float)).tolist()
    spatial = dataclasses.replace(
        config.spatial, attitude=tuple(w[:3]), omega=tuple(w[3:6]),
        velocity=(*w[6:8], config.spatial.velocity[2]), force=w[8],
    )  # fmt: skip
    return dataclasses.replace(config, spatial=spatial)


def tuned(model: str, args: SpatialWalksOptions, cache: Cache) -> Evolution:
    """The search for a model's weights, from the shipped ones; they are its first candidate."""
    walks = tuning_configs(model, args)
    engine: BatchEngine | None = None

    def costs(candidates: Sequence[np.ndarray]) -> np.ndarray:
        nonlocal engine
        if engine is None:
            engine = BatchEngine(batch_spec(walks[0]), torques="held", threads=args.threads)
        configs = [weighted(walk, logs) for logs in candidates for walk in walks]
        recording = engine.run(resolve_episodes(configs))
        if recording.interrupted:
            raise KeyboardInterrupt
        found = [
            observed(recording.trajectory(robot), config)["cost"]
            for robot, config in enumerate(configs)
        ]
        return np.array(found).reshape(len(candidates), len(walks)).mean(axis=1)

    return evolve(
        costs, logs_of(walks[0]), cache=cache,
        key=cache.key(*walks, "weights", args.population), generations=args.generations,
        population=args.population, with_mean=True, label=f"{model}, weights",
    )  # fmt: skip
