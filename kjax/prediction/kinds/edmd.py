"""Models fitted to rollouts of the rigid body: linear (the paper's) and bilinear EDMD."""

from dataclasses import fields, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from kjax.config import KoopmanConfig
from kjax.dynamics.srb_planar import SrbParams
from kjax.koopman.checks import require_dataset
from kjax.koopman.dataset import ranges_from_config, sample
from kjax.koopman.edmd import build_dictionary, fit_bilinear
from kjax.prediction import families
from kjax.prediction.families import Family
from kjax.prediction.kind import Bodies, ModelKind
from kjax.spec import DictionarySpec, ModelSpec
from kjax.types import INPUT_DIM, MODE_ALPHA, Mode


def _spec(config: KoopmanConfig, spec: ModelSpec) -> ModelSpec:
    names = [field.name for field in fields(DictionarySpec)]
    return replace(
        spec, dictionary=DictionarySpec(**{name: getattr(config, name) for name in names})
    )


def _family(build: Any, spec: ModelSpec) -> Family:
    if spec.dictionary is None:
        raise ValueError(f"a {spec.kind} model needs a dictionary")
    family: Family = build(build_dictionary(spec.dictionary), spec.dt)
    return family


def _bilinear(config: KoopmanConfig, bodies: Bodies) -> tuple[Any, Any]:
    params, spread, finite = _fit_bilinear(bodies.body, config, bodies.key, bodies.modes)
    if not bool(finite):
        raise ValueError("the bilinear fit is not finite: check srb and koopman.dataset ranges")
    return params, spread


@partial(jax.jit, static_argnames=("config", "modes"))
def _fit_bilinear(
    body: SrbParams, config: KoopmanConfig, key: Array, modes: tuple[Mode, ...]
) -> tuple[Any, Any, Any]:
    dictionary, data = build_dictionary(config), config.dataset
    measured = config.feet == "measured"
    require_dataset(data, dictionary.size * (1 + INPUT_DIM) + (8 if measured else 0))

    def one(key: Array, alpha: Array, body: SrbParams) -> tuple[Any, Any]:
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


LINEAR = ModelKind(family=partial(_family, families.linear), params=None, spec=_spec)
BILINEAR = ModelKind(family=partial(_family, families.bilinear), params=_bilinear, spec=_spec)
