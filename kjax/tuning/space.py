"""Parameters of a config as variables, by key, in coordinates in which their steps compare.

A positive number p is the variable log(p): a step of 0.1 is one of ten per cent, of a weight of 3e4
and of one of 0.1 alike. Others are divided by a size that matters. ``params`` maps variables to the
parameters of a controller by the same code that builds them from a config; it is differentiable.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from kjax.config import Gaits, Overlay, RunConfig, Tunable, load_config, to_dict, tunable
from kjax.controllers.params import ControllerParams, Fits, cast
from kjax.controllers.resolve import gather
from kjax.controllers.resolve_fits import fit_models
from kjax.controllers.resolve_model import koopman_keys
from kjax.controllers.rigid_body import body_numbers
from kjax.prediction.families import BodyModel
from kjax.prediction.kind import get_kind
from kjax.robots import get_robot
from kjax.types import RobotParams

Variables = dict[str, Array]  # by key


TUNABLE = tunable(RunConfig)


class Space(NamedTuple):
    """Variables of some keys of a config; a record of pure functions.

    Attributes:
      kinds: in which coordinate and range each key is tuned.
      start: variables of the config itself.
      values: variables -> values by key.
      inside: variables -> the nearest ones in their ranges.
      params: variables -> controller parameters; differentiable.
      overrides: variables -> plain values by key, for ``config.load_config`` and TOML.
    """

    kinds: dict[str, Tunable]
    start: Variables
    values: Callable[[Variables], dict[str, Array]]
    inside: Callable[[Variables], Variables]
    params: Callable[[Variables], ControllerParams]
    overrides: Callable[[Variables], dict[str, Any]]


def build_space(
    config: RunConfig,
    keys: Sequence[str],
    *,
    robot: RobotParams | None = None,
    fits: Fits | None = None,
) -> Space:
    """Variables for some keys of a config.

    The Koopman models are fitted once, here: where a key moves the nominal contact points
    (gaits.NAME.feet_*, height), models with fixed feet stay those of the config.

    Args:
      config: that all other parameters come from.
      keys: of ``TUNABLE``.
      robot: whose controller it is; that of the config if ``None``.
      fits: models of a planar controller; those of the config if ``None``.

    Raises:
      ValueError: for a key that is no variable, or one whose number has no logarithm.
    """
    robot = get_robot(config.robot).params if robot is None else robot
    kinds = tunable(RunConfig, config.gaits)
    _check_keys(config, keys, kinds)
    mass, inertia = (float(number) for number in body_numbers(config, robot))
    config = replace(config, srb=replace(config.srb, mass=mass, inertia=inertia))
    if fits is None and config.controller == "planar":
        with jax.enable_x64(True):
            fits = fit_models(config, robot)
    dtype = jnp.zeros(()).dtype

    def values(variables: Variables) -> dict[str, Array]:
        return {
            key: jnp.exp(one) if (unit := kinds[key].unit) is None else one * unit
            for key, one in variables.items()
        }

    def inside(variables: Variables) -> Variables:
        return {
            key: jnp.clip(one, *(_forward(kinds[key], edge) for edge in _range(kinds[key])))
            for key, one in variables.items()
        }

    def params(variables: Variables) -> ControllerParams:
        values_by_key = values(variables)
        return cast(
            gather(Overlay(config, values_by_key), robot, _with_body(fits, values_by_key)), dtype
        )

    def overrides(variables: Variables) -> dict[str, Any]:
        return {key: np.asarray(one, float).tolist() for key, one in values(variables).items()}

    start = {
        key: jnp.asarray(_forward(kinds[key], _value_of(config, key, kinds[key])), dtype)
        for key in keys
    }
    return Space({key: kinds[key] for key in keys}, start, values, inside, params, overrides)


def _check_keys(config: RunConfig, keys: Sequence[str], kinds: Mapping[str, Tunable]) -> None:
    """Raise a ValueError for keys that are no variables of this config."""
    if not keys:
        raise ValueError("keys must name at least one variable, got none")
    with koopman_keys():
        is_body = config.controller == "spatial" or get_kind(config.koopman.model).is_body
    for key in keys:
        if key not in kinds:
            raise ValueError(f"keys: '{key}' is no variable; there are {', '.join(shown(kinds))}")
        if key.startswith("srb.") and not is_body:
            raise ValueError(
                f"keys: '{key}' is a variable of models that are the rigid body ('srb', 'planted', "
                f"'exact') only; got '{config.koopman.model}', which is fitted to data"
            )


def _value_of(config: RunConfig, key: str, kind: Tunable) -> np.ndarray:
    """What the config holds at a key, to start from."""
    held: Any = config
    for part in key.split("."):
        held = held[part] if isinstance(held, Gaits) else getattr(held, part)
    if held is None:
        raise ValueError(f"{key} is not given by the config: it has no value to start from")
    number = np.asarray(held, float)
    if kind.unit is None and not (number > 0).all():
        raise ValueError(f"{key} must be positive to be tuned, got {number.tolist()}")
    return number


def _with_body(fits: Fits | None, values_by_key: Mapping[str, Array]) -> Fits | None:
    """The fits with the tuned mass and inertia, where the model is the rigid body itself."""
    if fits is None or fits.prediction is None:
        return fits
    if not isinstance(fits.prediction.params, BodyModel):
        return fits
    body = fits.prediction.params.body
    body = body._replace(
        **{
            key.removeprefix("srb."): jnp.broadcast_to(number, body.mass.shape)
            for key, number in values_by_key.items()
            if key.startswith("srb.")
        }
    )
    model = fits.prediction.params._replace(body=body)
    return fits._replace(prediction=fits.prediction._replace(params=model))


def tuned_config(config: RunConfig, overrides: Mapping[str, Any]) -> RunConfig:
    """The config with other values at some keys, checked as any other."""
    return load_config(RunConfig, None, {**_flat(to_dict(config)), **overrides})


def _flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values by dotted key."""
    flat: dict[str, Any] = {}
    for name, value in data.items():
        inside = _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else None
        flat |= {f"{prefix}{name}": value} if inside is None else inside
    return flat


def _forward(kind: Tunable, number: Any) -> Any:
    with np.errstate(divide="ignore"):
        return np.log(number) if kind.unit is None else np.asarray(number) / kind.unit


def _range(kind: Tunable) -> tuple[float, float]:
    return kind.low, kind.high


def shown(kinds: Mapping[str, Tunable]) -> list[str]:
    """Keys, those of the gaits once."""
    parts = (key.split(".") for key in kinds)
    return list(
        dict.fromkeys(f"gaits.NAME.{p[2]}" if p[0] == "gaits" else ".".join(p) for p in parts)
    )
