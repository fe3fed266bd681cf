"""A kind of prediction model: how a choice becomes a spec, a family and its parameters.

``ModelChoice.model`` names one: of the modules in ``kjax.prediction.kinds``, or ``"module:NAME"``
for one's own. Everything else asks the record.
"""

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

from jaxtyping import Array, Float, PRNGKeyArray

from kjax.dynamics.srb_planar import SrbParams
from kjax.koopman.dataset import DatasetSpec
from kjax.lookup import look_up
from kjax.prediction.families import Family
from kjax.spec import DictionarySpec, ModelSpec
from kjax.types import Mode


@dataclass(frozen=True, kw_only=True)
class ModelChoice:
    """Which prediction model, and what its parameters come from.

    A ValueError about one of these begins with its name.

    Attributes:
      model: its kind, one of ``model_kinds()``, or ``"module:NAME"`` for a ``ModelKind`` of one's
        own.
      file: with fitted parameters, for the kinds that take one.
      dictionary: observables, for the kinds that are fitted by EDMD.
      dataset: that these are fitted to; its step is the model's.
      measured_feet: whether contact points are the robot's own rather than constant per mode.
    """

    model: str = "linear"
    file: str = ""
    dictionary: DictionarySpec = field(default_factory=DictionarySpec)
    dataset: DatasetSpec = field(default_factory=DatasetSpec)
    measured_feet: bool = False


class Bodies(NamedTuple):
    """What parameters are made from: the rigid body in each contact mode.

    Attributes:
      body: parameters of the rigid body, stacked over the modes.
      alpha: (M, 2) number of legs that stand in front and behind.
      modes: contact modes.
      heights: (M,) of the centre of mass, for what is linearised beforehand [m].
      key: random key of the training data.
    """

    body: SrbParams
    alpha: Float[Array, "M 2"]
    modes: tuple[Mode, ...]
    heights: tuple[float, ...]
    key: PRNGKeyArray


class ModelKind(NamedTuple):
    """A kind of prediction model; a record of functions and of what is special about it.

    Attributes:
      family: of a spec.
      params: parameters in every contact mode, and (M, 6) standard deviation of the one-step error;
        ``None`` for one whose tables are made once from the EDMD fit ("linear").
      spec: what shapes the program, from the choice and a spec that has kind, step and feet.
      takes_file: whether ``ModelChoice.file`` holds its parameters.
      is_body: whether its parameters are the rigid body's own: mass and inertia may be tuned.
      of_height: whether its parameters depend on the reference height.
    """

    family: Callable[[ModelSpec], Family]
    params: Callable[[ModelChoice, Bodies], tuple[Any, Any]] | None
    spec: Callable[[ModelChoice, ModelSpec], ModelSpec] = lambda choice, spec: spec
    takes_file: bool = False
    is_body: bool = False
    of_height: bool = False


@cache
def model_kinds() -> dict[str, str]:
    """The kinds that kjax has: name -> where each lies, as ``"module:NAME"``."""
    import kjax.prediction.kinds as package

    modules = [f"{package.__name__}.{one.name}" for one in pkgutil.iter_modules(package.__path__)]
    return {
        name.lower(): f"{module}:{name}"
        for module in sorted(modules)
        for name, value in vars(importlib.import_module(module)).items()
        if isinstance(value, ModelKind)
    }


def get_kind(name: str) -> ModelKind:
    """A kind of model by its name.

    Raises:
      ValueError: for a name that is none.
    """
    kind: ModelKind = look_up("model", name, model_kinds(), ModelKind)
    return kind
