"""Models whose parameters lie in a file: residuals of the rigid body, and learned lifting."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kjax.koopman.observables import states_only
from kjax.prediction import families, features, storage
from kjax.prediction.families import BodyModel, Family, ResidualModel
from kjax.prediction.kind import Bodies, ModelChoice, ModelKind
from kjax.prediction.learned import learned
from kjax.spec import ModelSpec


def _residual_family(spec: ModelSpec) -> Family:
    own = features.BY_NAME[spec.features]
    return families.residual(spec.dt, own, remembers=spec.features != "affine")


def _residual(choice: ModelChoice, bodies: Bodies) -> tuple[Any, Any]:
    own, spread = _of_modes(choice, bodies)
    return ResidualModel(BodyModel(bodies.body, bodies.alpha), own), spread


def _of_modes(choice: ModelChoice, bodies: Bodies) -> tuple[Any, Any]:
    stored, chosen = _stored(choice), np.array(bodies.modes)
    own = jax.tree.map(lambda leaf: jnp.asarray(leaf)[chosen], stored.params)
    return own, jnp.asarray(stored.spread)[chosen]


def _lifted(choice: ModelChoice, spec: ModelSpec) -> ModelSpec:
    size = _stored(choice).params.head.A.shape[-1]
    return replace(spec, lifted=size - len(states_only().names))


def _stored(choice: ModelChoice) -> storage.Stored:
    path = storage.resolve(choice.file)
    try:
        content = path.stat()
        changed = (content.st_mtime_ns, content.st_size, content.st_ino)
    except OSError:
        changed = (0, 0, 0)
    stored = _read(path, choice.model, changed)
    if abs(stored.dt - choice.dataset.dt) > 1e-9:
        raise ValueError(
            f"file: '{path}' holds a model of steps of {stored.dt} s, dataset.dt is "
            f"{choice.dataset.dt} s"
        )
    return stored


@lru_cache(maxsize=8)
def _read(path: Path, family: str, changed: tuple[int, int, int]) -> storage.Stored:
    return storage.load(path, family)


RESIDUAL = ModelKind(
    family=_residual_family,
    params=_residual,
    spec=lambda choice, spec: replace(spec, features=_stored(choice).features),
    takes_file=True,
)
LEARNED = ModelKind(
    family=lambda spec: learned(spec.dt, spec.lifted),
    params=_of_modes,
    spec=_lifted,
    takes_file=True,
)
