"""From a config to the LMPC in three dimensions: its spec and its parameters."""

from functools import lru_cache
from itertools import accumulate
from math import ceil
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kjax import gait
from kjax.concrete import array_library, stacked
from kjax.config import ConfigError, SpatialConfig
from kjax.config.gaits import SPATIAL_WEIGHTS, gait_setting
from kjax.config.units import InSi
from kjax.controllers.params import SpatialParams
from kjax.controllers.rigid_body import body_numbers, mean_force
from kjax.dynamics import spatial_data
from kjax.dynamics.spatial_data import footholds
from kjax.dynamics.srb_spatial import SpatialBody
from kjax.koopman import so3
from kjax.mpc import momentum
from kjax.prediction import residual_wrench
from kjax.prediction.residual_wrench import ResidualWrench
from kjax.spec import SpatialSpec
from kjax.types import RobotParams


def spatial_spec(gaits: list[gait.Gait], config: SpatialConfig) -> SpatialSpec:
    """Sizes that suffice for every place in every gait."""
    borders = max(_borders(one, config.horizon) for one in gaits)
    whole = ceil(config.horizon / config.node_dt - 1e-6)
    return SpatialSpec(
        nodes=whole + borders,
        feet=2 * (whole + borders),
        model=config.model,
        tolerance=config.tolerance,
        max_iterations=config.max_iterations,
    )


def _borders(one: gait.Gait, horizon: float) -> int:
    """Largest number of ends of phases that a horizon holds."""
    durations = one.durations(0) * (2 + ceil(horizon / sum(one.durations(0))))
    most = 1
    for first in range(len(one.phases)):
        borders = accumulate(durations[first:], initial=0.0)
        most = max(most, sum(end < horizon for end in borders))
    return most


def spatial_params(gaits: list[gait.Gait], config: InSi, robot: RobotParams) -> SpatialParams:
    """Parameters from a config in SI units."""
    own = config.spatial
    mass, pitch_inertia = body_numbers(config, robot)
    inertia = robot.inertia * (pitch_inertia / robot.pitch_inertia)
    xp = array_library(mass, inertia)
    return SpatialParams(
        body=SpatialBody(mass=xp.asarray(mass, float), inertia=xp.asarray(inertia, float)),
        weights=momentum.Weights(
            **{
                key: stacked([gait_setting(config, one.name, key) for one in gaits])
                for key in SPATIAL_WEIGHTS
            }
        ),
        limits=momentum.Limits(
            friction=_floats(own.friction),
            force_z=stacked([own.grf_z_min, own.grf_z_max]),
            torque=_floats(own.torque_fraction) * robot.torque_limit,
        ),
        grid=stacked([own.horizon, own.node_dt]),
        force_z=mean_force(gaits, config, robot),
        slew=_floats(own.yaw_slew),
        velocity_slack=_floats(own.velocity_slack),
        heading_slack=_floats(own.heading_slack),
        velocity_time=_floats(own.velocity_time),
        integral=stacked([own.integral_gains, own.integral_limits]),
        slope_time=_floats(own.slope_time),
        alignment=_floats(own.alignment),
        learned=_learned(own, robot, mass, inertia),
    )


LEARNED = {"edmd": False, "bilinear": True}  # names of the models, and whether they are bilinear


def _learned(
    own: InSi, robot: RobotParams, mass: Any, inertia: Any
) -> so3.So3Model | ResidualWrench | None:
    """What was found from data, NumPy in float64; ``None`` for the other models.

    EDMD's is of the rigid body, a residual lies in its file.
    """
    if own.model == "residual":
        try:
            return residual_wrench.load(own.file)
        except ValueError as error:
            raise ConfigError(f"spatial.{error}") from None
    if own.model not in LEARNED:
        return None
    body = tuple(np.asarray(a, float).tobytes() for a in (mass, inertia, footholds(robot)))
    return _fit(body, LEARNED[own.model], own.snapshots, own.training_seed, own.node_dt / 2)


@lru_cache(maxsize=16)
def _fit(
    of_body: tuple[bytes, ...], bilinear: bool, snapshots: int, seed: int, dt: float
) -> so3.So3Model:
    """The fit of one body and its footholds, from their bytes."""
    mass, inertia, feet = (np.frombuffer(one) for one in of_body)
    with jax.enable_x64(True):
        body = SpatialBody(jnp.asarray(mass[0]), jnp.asarray(inertia.reshape(3, 3)))
        data = spatial_data.draw(
            body, feet.reshape(4, 3), [seed, 4], range(4),
            count=snapshots, nodes=1, dt=dt, anywhere=True,
        )  # fmt: skip
        return jax.device_get(so3.fit_body(data, dt, bilinear=bilinear))


def _floats(value: Any) -> Any:
    return array_library(value).asarray(value, float)
