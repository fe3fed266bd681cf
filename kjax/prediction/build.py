"""The prediction model that is chosen: family, parameters of each contact mode, spread."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from kjax.dynamics import srb_planar
from kjax.prediction import families
from kjax.prediction.families import Family
from kjax.prediction.kind import Bodies, ModelChoice, get_kind
from kjax.spec import ModelSpec
from kjax.types import MODE_ALPHA, STATE_DIM, Mode


class Prediction(NamedTuple):
    """Parameters of a prediction model, stacked over contact modes; data.

    Attributes:
      params: of the family.
      force: (M, 4) force per leg about which it is linearised, body frame [N].
      spread: (M, 6) standard deviation of the one-step error; the model's uncertainty
        [m, rad, m/s, rad/s].
    """

    params: Any
    force: Float[Array, "M 4"]
    spread: Float[Array, "M 6"]


def model_spec(choice: ModelChoice) -> ModelSpec:
    """What shapes the program of a model.

    Raises:
      ValueError: for a model that there is not, or a file that cannot be used.
    """
    kind = get_kind(choice.model)
    if kind.takes_file and not choice.file:
        raise ValueError(f"file: model = '{choice.model}' needs a file with its parameters")
    if choice.file and not kind.takes_file:
        raise ValueError(f"file: model = '{choice.model}' takes no file, got '{choice.file}'")
    spec = ModelSpec(
        kind=choice.model,
        dt=choice.dataset.dt,
        measured_feet=choice.measured_feet,
        tabulated=kind.params is None,
    )
    return kind.spec(choice, spec)


def build_family(spec: ModelSpec) -> Family:
    """The family of a model."""
    return get_kind(spec.kind).family(spec)


def build_prediction(
    body: srb_planar.SrbParams,
    choice: ModelChoice,
    key: PRNGKeyArray,
    *,
    modes: tuple[Mode, ...],
    heights: tuple[float, ...],
) -> Prediction:
    """Parameters of a model in every contact mode; for all but the linear EDMD model.

    Args:
      body: parameters of the rigid body in every mode, stacked.
      choice: of the model.
      key: random key of the training data.
      modes: contact modes that ``body`` is stacked over.
      heights: of the centre of mass in each, for what is linearised beforehand [m].

    Raises:
      ValueError: for a file that cannot be used, a fit that is not finite, and parameters that are
        not those of each mode.
    """
    make = get_kind(choice.model).params
    if make is None:
        raise ValueError(f"model: '{choice.model}' has its own tables (edmd.fit_modes)")
    alpha = jnp.asarray(MODE_ALPHA[np.array(modes)], float)
    params, spread = make(choice, Bodies(body, alpha, modes, heights, key))
    _check_shapes(choice.model, params, spread, len(modes))
    return Prediction(params=params, force=jax.vmap(families.hover)(body, alpha), spread=spread)


def _check_shapes(model: str, params: Any, spread: Any, modes: int) -> None:
    """Refuse parameters that are not stacked over the modes: traced code would take any index."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if np.shape(leaf)[:1] != (modes,):
            name = f"params{jax.tree_util.keystr(path)}"
            raise ValueError(
                f"model: {model}: {name} has shape {np.shape(leaf)}, wanted a leading axis of "
                f"{modes}, the number of bodies.modes"
            )
    if np.shape(spread) != (modes, STATE_DIM):
        got = type(spread).__name__ if spread is None else f"a spread of shape {np.shape(spread)}"
        raise ValueError(
            f"model: {model}: params must give parameters and a spread of shape "
            f"({modes}, {STATE_DIM}), zeros where the model is exact, got {got}"
        )
