"""A kind of prediction model: how a config's choice becomes a spec, a family and its parameters.

``koopman.model`` names one: of the modules in ``kjax.prediction.kinds``, or ``"module:NAME"`` for
one's own. Everything else asks the record.
"""

import importlib
import pkgutil
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from jaxtyping import Array, Float, PRNGKeyArray

from kjax.config import ConfigError, KoopmanConfig
from kjax.dynamics.srb_planar import SrbParams
from kjax.lookup import look_up
from kjax.prediction.families import Family
from kjax.spec import ModelSpec
from kjax.types import Mode


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
      spec: what shapes the program, from the config and a spec that has kind, step and feet.
      takes_file: whether ``koopman.file`` holds its parameters.
      is_body: whether its parameters are the rigid body's own: mass and inertia may be tuned.
      of_height: whether its parameters depend on the reference height.
    """

    family: Callable[[ModelSpec], Family]
    params: Callable[[KoopmanConfig, Bodies], tuple[Any, Any]] | None
    spec: Callable[[KoopmanConfig, ModelSpec], ModelSpec] = lambda config, spec: spec
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
      ConfigError: for a name that is none.
    """
    try:
        kind: ModelKind = look_up("koopman.model", name, model_kinds(), ModelKind)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    return kind
