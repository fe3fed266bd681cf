"""Numbers of fitted models on disk: one .npz per model, stacked over contact modes."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kjax.config import ConfigError
from kjax.koopman.families import BilinearModel
from kjax.koopman.features import BY_NAME
from kjax.koopman.learned import Layer, LearnedModel
from kjax.types import Mode


class Stored(NamedTuple):
    """What a file holds.

    Attributes:
      family: ``"residual"`` or ``"learned"``.
      dt: step of the model [s].
      numbers: W (M, 6, F) of a residual, or a ``LearnedModel``; a leading axis over ``Mode``.
      spread: (M, 6) standard deviation of the one-step error [m, rad, m/s, rad/s].
      features: that the weights of a residual belong to, a name of ``features.BY_NAME``.
    """

    family: str
    dt: float
    numbers: Any
    spread: np.ndarray
    features: str = "affine"


def save(path: Path, stored: Stored) -> None:
    """Write a model; its directory must exist."""
    arrays: dict[str, Any] = {
        "family": np.array(stored.family),
        "dt": np.array(stored.dt),
        "spread": np.asarray(stored.spread),
    }
    if stored.family == "residual":
        arrays |= {"W": np.asarray(stored.numbers), "features": np.array(stored.features)}
    elif stored.family == "learned":
        model: LearnedModel = stored.numbers
        for i, layer in enumerate(model.layers):
            arrays[f"W_{i}"], arrays[f"b_{i}"] = np.asarray(layer.W), np.asarray(layer.b)
        arrays |= {"A": np.asarray(model.head.A), "B": np.asarray(model.head.B)}
        arrays["B_feet"] = np.asarray(model.head.B_feet)
        arrays |= {"centre": np.asarray(model.centre), "scale": np.asarray(model.scale)}
    else:
        raise ValueError(f"family must be 'residual' or 'learned', got {stored.family!r}")
    np.savez(path, **arrays)


def load(path: Path, family: str) -> Stored:
    """Read a model of this family.

    Raises:
      ConfigError: for a file that is not there, not a model's, of another family, or not finite.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except (OSError, ValueError) as error:
        raise ConfigError(f"koopman.file: cannot read '{path}': {error}") from None
    if "family" not in arrays or str(arrays["family"]) != family:
        there = str(arrays.get("family", "no model"))
        raise ConfigError(f"koopman.file: '{path}' holds {there}, wanted a {family} model")
    try:
        if family == "residual":
            numbers: Any = arrays["W"]
        else:
            count = sum(name.startswith("W_") for name in arrays)
            numbers = LearnedModel(
                layers=tuple(Layer(arrays[f"W_{i}"], arrays[f"b_{i}"]) for i in range(count)),
                head=BilinearModel(arrays["A"], arrays["B"], arrays["B_feet"]),
                centre=arrays["centre"],
                scale=arrays["scale"],
            )
        own = str(arrays.get("features", "affine"))
        stored = Stored(family, float(arrays["dt"]), numbers, arrays["spread"], own)
    except KeyError as error:
        raise ConfigError(f"koopman.file: '{path}' lacks {error}") from None
    for name, values in arrays.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise ConfigError(f"koopman.file: '{path}': {name} holds numbers that are not finite")
    if own not in BY_NAME:
        raise ConfigError(
            f"koopman.file: '{path}' holds weights of features '{own}', wanted one of "
            f"{', '.join(BY_NAME)}"
        )
    if len(stored.spread) != len(Mode):
        raise ConfigError(
            f"koopman.file: '{path}' holds {len(stored.spread)} contact modes, wanted {len(Mode)}"
        )
    return stored
