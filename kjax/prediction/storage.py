"""Fitted models on disk: one .npz per model, its parameters stacked over contact modes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from kjax.koopman.models import BilinearModel
from kjax.prediction.families import Past, Start
from kjax.prediction.features import BY_NAME
from kjax.prediction.learned import Layer, LearnedModel
from kjax.types import INPUT_DIM, STATE_DIM, Mode

_SUFFIX = ".npz"


class Stored(NamedTuple):
    """What a file holds.

    Attributes:
      family: ``"residual"`` or ``"learned"``.
      dt: step of the model [s].
      params: W (M, 6, F) of a residual, or a ``LearnedModel``; a leading axis over ``Mode``.
      spread: (M, 6) standard deviation of the one-step error [m, rad, m/s, rad/s].
      features: that the weights of a residual belong to, a name of ``features.BY_NAME``.
    """

    family: str
    dt: float
    params: Any
    spread: np.ndarray
    features: str = "affine"


def save(path: str | Path, stored: Stored) -> Path:
    """Write a model whole or not at all; its directory must exist.

    Args:
      path: of the file; ``.npz`` is appended where it is missing, as ``load`` does.
      stored: the model.

    Returns:
      The file that was written.
    """
    arrays: dict[str, Any] = {
        "family": np.array(stored.family),
        "dt": np.array(stored.dt),
        "spread": np.asarray(stored.spread),
    }
    if stored.family == "residual":
        arrays |= {"W": np.asarray(stored.params), "features": np.array(stored.features)}
    elif stored.family == "learned":
        model: LearnedModel = stored.params
        for i, layer in enumerate(model.layers):
            arrays[f"W_{i}"], arrays[f"b_{i}"] = np.asarray(layer.W), np.asarray(layer.b)
        arrays |= {"A": np.asarray(model.head.A), "B": np.asarray(model.head.B)}
        arrays["B_feet"] = np.asarray(model.head.B_feet)
        arrays |= {"centre": np.asarray(model.centre), "scale": np.asarray(model.scale)}
    else:
        raise ValueError(f"family must be 'residual' or 'learned', got {stored.family!r}")
    return write(path, arrays)


def write(path: str | Path, arrays: Mapping[str, Any]) -> Path:
    """Write a model's arrays whole or not at all; returns the file."""
    file = _with_suffix(path)
    scratch = file.with_name(f".{file.name}.part{_SUFFIX}")
    try:
        np.savez(scratch, **arrays)
        scratch.replace(file)
    finally:
        scratch.unlink(missing_ok=True)
    return file


def load(path: str | Path, family: str) -> Stored:
    """Read a model of this family.

    Args:
      path: of the file, with or without ``.npz``.
      family: ``"residual"`` or ``"learned"``.

    Raises:
      ValueError: in one line that names the file and the fault: missing, unreadable, not a
        model's, of another family, or with an array that is missing, not real, not finite, or of
        another shape than the family and the other arrays ask for.
    """
    if family not in ("residual", "learned"):
        raise ValueError(f"family must be 'residual' or 'learned', got {family!r}")
    file, arrays = read(path, family)
    try:
        if family == "residual":
            own = str(arrays["features"]) if "features" in arrays else "affine"
            shapes = _residual_shapes(own)
        else:
            own = "affine"
            shapes = _learned_shapes(arrays)
        for name, shape in {"dt": (), "spread": (len(Mode), STATE_DIM), **shapes}.items():
            check_array(name, arrays[name], shape)
    except KeyError as error:
        raise fault(file, f"lacks {error}") from None
    except ValueError as error:
        raise fault(file, str(error)) from None
    if family == "residual":
        params: Any = arrays["W"]
    else:
        params = LearnedModel(
            layers=tuple(Layer(arrays[f"W_{i}"], arrays[f"b_{i}"]) for i in range(_layers(arrays))),
            head=BilinearModel(arrays["A"], arrays["B"], arrays["B_feet"]),
            centre=arrays["centre"],
            scale=arrays["scale"],
        )
    for name, least in (("dt", "above 0"), ("scale", "above 0"), ("spread", "of at least 0")):
        values = arrays.get(name, np.ones(()))
        if (values < 0).any() or (least == "above 0" and (values == 0).any()):
            raise fault(file, f"{name} holds {values.min():g}, wanted values {least}")
    return Stored(family, float(arrays["dt"]), params, arrays["spread"], own)


def read(path: str | Path, family: str) -> tuple[Path, dict[str, Any]]:
    """The file of a model of this family, and its arrays.

    Raises:
      ValueError: in one line, for a file that is missing, unreadable, or of another family.
    """
    file = resolve(path)
    if not file.name:
        raise fault(file, "is no file")
    arrays = _read(file)
    held = str(arrays["family"]) if _is_word(arrays.get("family")) else "no model"
    if held != family:
        raise fault(file, f"holds {held[:40]}, wanted a {family} model")
    return file, arrays


def resolve(path: str | Path) -> Path:
    """The file that ``load`` reads for a path: the one that ``save`` writes, or the path itself."""
    path = Path(path)
    if not path.name:
        return path
    file = _with_suffix(path)
    return file if file.exists() else path


def _with_suffix(path: str | Path) -> Path:
    path = Path(path)
    if not path.name:
        raise fault(path, "is no file")
    return path if path.name.endswith(_SUFFIX) else path.with_name(path.name + _SUFFIX)


def fault(file: Path, text: str) -> ValueError:
    """What is wrong with a file."""
    return ValueError(f"file: '{file}' {text}")


def _read(file: Path) -> dict[str, Any]:
    """All arrays of an .npz."""
    try:
        with np.load(file, allow_pickle=False) as content:
            # A member that is no array, such as text, comes as bytes.
            return {k: v for k, v in content.items() if isinstance(v, np.ndarray)}
    except (AttributeError, TypeError):  # a bare array is no context manager
        raise fault(file, "holds no model: it is one bare array (.npy)") from None
    except OSError as error:
        reason = error.strerror or str(error)
    except Exception as error:  # zip, zlib and numpy raise a dozen types for damaged bytes
        reason = f"it is empty, cut off, damaged or no .npz ({error})"
    raise ValueError(f"file: cannot read '{file}': {reason.splitlines()[0]}")


def _is_word(value: np.ndarray | None) -> bool:
    return value is not None and value.shape == () and value.dtype.kind == "U"


def check_array(
    name: str, values: np.ndarray, shape: tuple[int, ...], rows: str = "contact modes"
) -> None:
    """Raise a ValueError that says what is wrong with an array of a model."""
    if values.dtype.kind == "c":
        raise ValueError(f"{name} holds complex values, wanted real ones")
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{name} holds values of type {values.dtype}, wanted real values")
    if shape and values.ndim == len(shape) and len(values) != shape[0]:
        text = f"{name} holds {len(values)} {rows}, wanted {shape[0]}"
        raise ValueError(text + ": fit it again, kjax had 5 before" * (len(values) == 5))
    if values.shape != shape:
        raise ValueError(f"{name} has shape {values.shape}, wanted {shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds values that are not finite")


def _residual_shapes(features: str) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of a residual model with these features."""
    if features not in BY_NAME:
        raise ValueError(
            f"holds weights of features '{features[:40]}', wanted one of {', '.join(BY_NAME)}"
        )
    x, u = jnp.zeros(STATE_DIM), jnp.zeros(INPUT_DIM)
    phi = jax.eval_shape(BY_NAME[features], Start(x, jnp.zeros((2, 2))), x, u, Past(u, u))
    return {"W": (len(Mode), STATE_DIM, phi.shape[0])}


def _layers(arrays: Mapping[str, np.ndarray]) -> int:
    return sum(name.startswith("W_") for name in arrays)


def _learned_shapes(arrays: Mapping[str, np.ndarray]) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of a learned model: every layer takes what the one before gives."""
    modes, width = len(Mode), STATE_DIM - 1  # the network does not see p_x
    shapes: dict[str, tuple[int, ...]] = {}
    for i in range(max(_layers(arrays), 1)):
        layer = arrays[f"W_{i}"].shape
        if len(layer) != 3:
            raise ValueError(f"W_{i} has shape {layer}, wanted (modes, out, in)")
        shapes[f"W_{i}"], shapes[f"b_{i}"] = (modes, layer[1], width), (modes, layer[1])
        width = layer[1]
    N = 1 + STATE_DIM + width
    return shapes | {
        "A": (modes, N, N),
        "B": (modes, N, N, INPUT_DIM),
        "B_feet": (modes, 4, N, INPUT_DIM),
        "centre": (modes, STATE_DIM),
        "scale": (modes, STATE_DIM),
    }
