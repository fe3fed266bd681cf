"""The prediction model that a config names: family, numbers of every contact mode, uncertainty."""

from dataclasses import fields, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from kjax.config import ConfigError, KoopmanConfig
from kjax.dynamics import srb_planar
from kjax.koopman.checks import require_dataset
from kjax.koopman.dataset import ranges_from_config, sample
from kjax.koopman.edmd import build_dictionary, fit_bilinear
from kjax.koopman.observables import states_only
from kjax.prediction import families, features, storage
from kjax.prediction.families import BodyModel, Family, ResidualModel
from kjax.prediction.learned import learned
from kjax.spec import DictionarySpec, ModelSpec
from kjax.types import INPUT_DIM, MODE_ALPHA, STATE_DIM, Mode


class Prediction(NamedTuple):
    """Numbers of a prediction model, stacked over contact modes; data.

    Attributes:
      numbers: of the family.
      force: (M, 4) force per leg about which it is linearised, body frame [N].
      spread: (M, 6) standard deviation of the one-step error; the model's uncertainty
        [m, rad, m/s, rad/s].
    """

    numbers: Any
    force: Float[Array, "M 4"]
    spread: Float[Array, "M 6"]


def model_spec(config: KoopmanConfig) -> ModelSpec:
    """What shapes the program of a config's model.

    Raises:
      ConfigError: for a file that cannot be used.
    """
    spec = ModelSpec(
        kind=config.model, dt=config.dataset.dt, measured_feet=config.feet == "measured"
    )
    if config.model in ("linear", "bilinear"):
        names = [field.name for field in fields(DictionarySpec)]
        dictionary = DictionarySpec(**{name: getattr(config, name) for name in names})
        return replace(spec, dictionary=dictionary)
    if config.model == "residual":
        return replace(spec, features=_stored(config).features)
    if config.model == "learned":
        size = _stored(config).numbers.head.A.shape[-1]
        return replace(spec, lifted=size - len(states_only().names))
    return spec


def build_family(spec: ModelSpec) -> Family:
    """The family of a model."""
    dt = spec.dt
    if spec.kind in ("linear", "bilinear"):
        if spec.dictionary is None:
            raise ValueError(f"a {spec.kind} model needs a dictionary")
        build = families.linear if spec.kind == "linear" else families.bilinear
        return build(build_dictionary(spec.dictionary), dt)
    if spec.kind == "srb_hover":
        return families.linear(states_only(), dt, "srb_hover")
    if spec.kind == "srb":
        return families.rigid_body(dt)
    if spec.kind == "planted":
        return families.planted(dt)
    if spec.kind == "exact":
        return families.exact(dt)
    if spec.kind == "residual":
        own = features.BY_NAME[spec.features]
        return families.residual(dt, own, remembers=spec.features != "affine")
    return learned(dt, spec.lifted)


def build_prediction(
    body: srb_planar.SrbParams,
    config: KoopmanConfig,
    key: PRNGKeyArray,
    *,
    modes: tuple[Mode, ...],
    heights: tuple[float, ...],
) -> Prediction:
    """Numbers of a config's model in every contact mode; for all but the linear EDMD model.

    Args:
      body: parameters of the rigid body in every mode, stacked.
      config: of the model.
      key: random key of the training data.
      modes: contact modes that ``body`` is stacked over.
      heights: of the centre of mass in each, for what is linearised beforehand [m].

    Raises:
      ConfigError: for a file that cannot be used.
      ValueError: for a fit that is not finite.
    """
    chosen = np.array(modes)
    alpha = jnp.asarray(MODE_ALPHA[chosen], float)
    force = jax.vmap(families.hover)(body, alpha)
    spread = jnp.zeros((len(modes), STATE_DIM))
    numbers: Any
    if config.model == "srb_hover":
        numbers = jax.vmap(
            lambda body, alpha, height: families.linearised_srb(
                body, alpha, height, config.dataset.dt
            )
        )(body, alpha, jnp.asarray(heights, float))
    elif config.model in ("srb", "planted", "exact"):
        numbers = BodyModel(body, alpha)
    elif config.model == "bilinear":
        numbers, spread, finite = _fit_bilinear(body, config, key, modes)
        if not bool(finite):
            raise ValueError("the bilinear fit is not finite: check srb and koopman.dataset ranges")
    elif config.model in ("residual", "learned"):
        stored = _stored(config)
        own = jax.tree.map(lambda leaf: jnp.asarray(leaf)[chosen], stored.numbers)
        numbers = ResidualModel(BodyModel(body, alpha), own) if config.model == "residual" else own
        spread = jnp.asarray(stored.spread)[chosen]
    else:
        raise ValueError(f"model '{config.model}' has its own tables (edmd.fit_modes)")
    return Prediction(numbers=numbers, force=force, spread=spread)


@partial(jax.jit, static_argnames=("config", "modes"))
def _fit_bilinear(
    body: srb_planar.SrbParams, config: KoopmanConfig, key: Array, modes: tuple[Mode, ...]
) -> tuple[Any, Any, Any]:
    dictionary, data = build_dictionary(config), config.dataset
    measured = config.feet == "measured"
    require_dataset(data, dictionary.size * (1 + INPUT_DIM) + (8 if measured else 0))

    def one(key: Array, alpha: Array, body: srb_planar.SrbParams) -> tuple[Any, Any]:
        ranges = ranges_from_config(data, vary_feet=measured)
        snapshots = sample(
            key, body, alpha, ranges, rollouts=data.rollouts,
            steps=round(data.duration / data.dt), dt=data.dt, hold=data.hold,
        )  # fmt: skip
        return fit_bilinear(dictionary, snapshots, feet_terms=measured)

    chosen = np.array(modes)
    keys = jax.random.split(key, len(Mode))[chosen]
    model, report = jax.vmap(one)(keys, jnp.asarray(MODE_ALPHA[chosen], float), body)
    return model, report.residual_rms, report.finite.all()


def _stored(config: KoopmanConfig) -> storage.Stored:
    path = storage.resolve(config.file)
    try:
        content = path.stat()
        changed = (content.st_mtime_ns, content.st_size, content.st_ino)
    except OSError:
        changed = (0, 0, 0)
    stored = _read(path, config.model, changed)
    if abs(stored.dt - config.dataset.dt) > 1e-9:
        raise ConfigError(
            f"koopman.file: '{path}' holds a model of steps of {stored.dt} s, koopman.dataset.dt "
            f"is {config.dataset.dt} s"
        )
    return stored


@lru_cache(maxsize=8)
def _read(path: Path, family: str, changed: tuple[int, int, int]) -> storage.Stored:
    return storage.load(path, family)
