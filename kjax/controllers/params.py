"""Parameters of a controller, and the tables that are condensed from them once, off line."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from kjax import gait
from kjax.concrete import is_concrete
from kjax.dynamics.srb_spatial import SpatialBody
from kjax.koopman.models import LinearModel
from kjax.koopman.so3 import So3Model
from kjax.legs import lateral, swing
from kjax.mpc import horizon, momentum
from kjax.mpc.lmpc import LmpcTables, ModeSettings, build_tables
from kjax.precision import full_precision
from kjax.prediction.build import Prediction
from kjax.prediction.residual_wrench import ResidualWrench
from kjax.spec import ControllerSpec
from kjax.types import Command, RobotParams


class Fits(NamedTuple):
    """What is learned from data, of every contact mode of every gait (M of them).

    Attributes:
      model: linear EDMD models over one step of the data.
      feet: (M, 2, 2) nominal contact points, body frame [m].
      spread: (M, n_x) standard deviation of the one-step error of the model in use.
      prediction: another prediction model, where the config names one.
    """

    model: LinearModel
    feet: Float[Array, "M 2 2"]
    spread: Float[Array, "M n_x"]
    prediction: Prediction | None


class SpatialParams(NamedTuple):
    """Parameters of the LMPC in three dimensions.

    Attributes:
      body: mass and inertia of the prediction.
      weights: of the errors, per second; each gait's (G, ...).
      limits: of the forces.
      grid: (2,) length of the horizon, and longest node where two feet stand [s].
      force_z: (G, 2) mean vertical force of a front and a rear leg in its stance [N].
      slew: of the reference yaw rate [rad/s^2].
      velocity_slack: clamp of the velocity reference's lead [m/s].
      heading_slack: clamp of the heading reference's lead [rad].
      velocity_time: in which the velocity is predicted to reach its reference [s].
      integral: (2, 3) integral action on v_x, v_y and heading: its rates [1/s] and its limits
        [m/s, m/s, rad].
      slope_time: in which the slope of the ground is filtered [s].
      alignment: part of that slope that the trunk takes [-].
      learned: what was found from data, where the model is a learned one.
    """

    body: SpatialBody
    weights: momentum.Weights
    limits: momentum.Limits
    grid: Float[Array, "2"]
    force_z: Float[Array, "G 2"]
    slew: Float[Array, ""]
    velocity_slack: Float[Array, ""]
    heading_slack: Float[Array, ""]
    velocity_time: Float[Array, ""]
    integral: Float[Array, "2 3"]
    slope_time: Float[Array, ""]
    alignment: Float[Array, ""]
    learned: So3Model | ResidualWrench | None = None


class ControllerParams(NamedTuple):
    """All parameters of a controller; data, so any leaf may be batched or replaced.

    Attributes:
      robot: geometry and masses.
      fits: the planar controller's prediction models; ``None`` for that in three dimensions.
      modes: weights and bounds of the LMPC within a stance, of every contact mode of every gait.
      problem: (G, P) which of these each phase of a gait is.
      uncertainty_discount: how much less its uncertain steps weigh; not read where the spec does
        not discount [-].
      friction: mu of its friction rows; not read where the spec has none [-].
      torque_fraction: part of the joint torque limits in its torque rows; likewise [-].
      schedule: gaits.
      gait_times: (K,) times at which a gait is asked for, the first one 0 [s].
      gaits: (K,) index of the gait asked for then.
      reference: (G, ramp levels, P, samples, 4) periodic motion of each gait; see
        ``gait.reference``.
      multiphase: LMPC over a gait cycle, for gaits that use it.
      spatial: LMPC in three dimensions; ``None`` for the planar controller.
      swing: swing settings.
      lateral: regulator of roll, yaw and sideways motion; of no effect on the planar base.
      command: what the robot is asked to do over time.
      height: (G,) mean height of the centre of mass above the ground [m].
      command_slew: largest rate of change of the reference velocity [m/s^2].
      height_slew: the same of the reference height [m/s].
      integral: (2, 2) integral action on velocity and pitch: its rates [1/s] and its limits
        [m/s, rad].
      position_slack: clamp of the position reference's lag [m].
      hold_time: how long the last torque holds without a valid sample [s].
      blind_damping: joint damping after that [N m s/rad].
    """

    robot: RobotParams
    fits: Fits | None
    modes: ModeSettings
    problem: Int[Array, "G P"]
    uncertainty_discount: Float[Array, ""]
    friction: Float[Array, ""]
    torque_fraction: Float[Array, ""]
    schedule: gait.Schedule
    gait_times: Float[Array, "K"]
    gaits: Int[Array, "K"]
    reference: Float[Array, "G levels P samples 4"]
    multiphase: horizon.MultiPhaseParams
    spatial: SpatialParams | None
    swing: swing.SwingParams
    lateral: lateral.LateralParams
    command: Command
    height: Float[Array, "G"]
    command_slew: Float[Array, ""]
    height_slew: Float[Array, ""]
    integral: Float[Array, "2 2"]
    position_slack: Float[Array, ""]
    hold_time: Float[Array, ""]
    blind_damping: Float[Array, ""]


class Tables(NamedTuple):
    """What a controller's functions take: its parameters, and what is condensed from them.

    Attributes:
      params: parameters; those that the LMPC's tables are condensed from (fits, modes,
        uncertainty_discount) are not read any more.
      lmpc: the planar controller's condensed problems within a stance, of every contact mode.
    """

    params: ControllerParams
    lmpc: LmpcTables | None


@full_precision
def condense(spec: ControllerSpec, params: ControllerParams, *, dtype: Any = None) -> Tables:
    """Precompute what depends on the parameters alone.

    The work is done in float64 whatever the caller's default, and the result is cast once; inside
    ``jit``, ``grad`` or ``vmap`` it is done in the floating type of the traced parameters.

    Args:
      spec: of the controller.
      params: from ``kjax.controllers.resolve``, or changed since.
      dtype: floating type of the result; JAX's current default if ``None``.
    """
    if not isinstance(params, ControllerParams):
        raise TypeError(f"params: wanted those of kjax.resolve, got {type(params).__name__}")
    dtype = jnp.zeros(()).dtype if dtype is None else jnp.dtype(dtype)
    if not is_concrete((params, jnp.zeros(()))):  # the latter is traced inside jit, whatever params
        return cast(Tables(params, _condensed(spec, params)), dtype)
    with jax.enable_x64(True):
        tables = Tables(params, jax.device_get(_condensed(spec, jax.tree.map(_as_float64, params))))
    return cast(tables, dtype)


def with_params(tables: Tables, **changes: Any) -> Tables:
    """Tables with other parameters that nothing is condensed from, e.g. ``command``.

    Raises:
      ValueError: for parameters that the LMPC's tables are condensed from.
    """
    params = tables.params
    condensed = sorted({"fits", "modes", "uncertainty_discount"} & changes.keys())
    if condensed:
        raise ValueError(f"{', '.join(condensed)}: the tables are condensed from it; use condense")
    # In the type that is there: else every function compiles again.
    changes = {
        name: jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), new, getattr(params, name))
        for name, new in changes.items()
    }
    return tables._replace(params=params._replace(**changes))


@partial(jax.jit, static_argnums=0)
@full_precision
def _condensed(spec: ControllerSpec, params: ControllerParams) -> LmpcTables | None:
    if params.fits is None:
        return None
    return build_tables(
        params.fits.model,
        params.modes,
        steps=round(spec.model_dt / spec.model.dt),
        horizon=spec.horizon,
        feet=params.fits.feet,
        spread=params.fits.spread,
        uncertainty_discount=params.uncertainty_discount if spec.discounts_uncertainty else None,
    )


def _as_float64(leaf: Any) -> np.ndarray:
    array = np.asarray(leaf)
    return array.astype(float) if np.issubdtype(array.dtype, np.floating) else array


def cast(tree: Any, dtype: Any) -> Any:
    """Arrays on the device, floats in ``dtype``, integers as int32."""
    return jax.device_put(jax.tree.map(lambda leaf: _as(leaf, dtype), tree))


def _as(leaf: Any, dtype: Any) -> Array | np.ndarray:
    """A copy of the leaf: floats in ``dtype``, integers as int32, the rest as it is."""
    # NumPy casts what is known without compiling a program for every shape.
    array = np.array(leaf) if is_concrete(leaf) else jnp.asarray(leaf)
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array.astype(dtype)
    if jnp.issubdtype(array.dtype, jnp.integer):
        return array.astype(np.int32)
    return array
