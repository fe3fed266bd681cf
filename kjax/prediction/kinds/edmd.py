"""Models fitted to rollouts of the rigid body: linear (the paper's) and bilinear EDMD."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from kjax.dynamics.srb_planar import SrbParams
from kjax.koopman.checks import require_dataset
from kjax.koopman.dataset import sample, sample_ranges
from kjax.koopman.edmd import build_dictionary, fit_bilinear
from kjax.prediction import families
from kjax.prediction.families import Family
from kjax.prediction.kind import Bodies, ModelChoice, ModelKind
from kjax.spec import ModelSpec
from kjax.types import INPUT_DIM, MODE_ALPHA, Mode


def _spec(choice: ModelChoice, spec: ModelSpec) -> ModelSpec:
    return replace(spec, dictionary=choice.dictionary)


def _family(build: Any, spec: ModelSpec) -> Family:
    if spec.dictionary is None:
        raise ValueError(f"a {spec.kind} model needs a dictionary")
    family: Family = build(build_dictionary(spec.dictionary), spec.dt)
    return family


def _bilinear(choice: ModelChoice, bodies: Bodies) -> tuple[Any, Any]:
    params, spread, finite = _fit_bilinear(bodies.body, choice, bodies.key, bodies.modes)
    if not bool(finite):
        raise ValueError("dataset: the bilinear fit is not finite, check its ranges and the body")
    return params, spread


@partial(jax.jit, static_argnames=("choice", "modes"))
def _fit_bilinear(
    body: SrbParams, choice: ModelChoice, key: Array, modes: tuple[Mode, ...]
) -> tuple[Any, Any, Any]:
    dictionary, dataset = build_dictionary(choice.dictionary), choice.dataset
    measured = choice.measured_feet
    require_dataset(dataset, dictionary.size * (1 + INPUT_DIM) + (8 if measured else 0))

    def one(key: Array, alpha: Array, body: SrbParams) -> tuple[Any, Any]:
        snapshots = sample(
            key, body, alpha, sample_ranges(dataset, vary_feet=measured),
            rollouts=dataset.rollouts, steps=dataset.steps, dt=dataset.dt, hold=dataset.hold,
        )  # fmt: skip
        return fit_bilinear(dictionary, snapshots, feet_terms=measured)

    chosen = np.array(modes)
    keys = jax.random.split(key, len(Mode))[chosen]
    model, report = jax.vmap(one)(keys, jnp.asarray(MODE_ALPHA[chosen], float), body)
    return model, report.residual_rms, report.finite.all()


LINEAR = ModelKind(family=partial(_family, families.linear), params=None, spec=_spec)
BILINEAR = ModelKind(family=partial(_family, families.bilinear), params=_bilinear, spec=_spec)
