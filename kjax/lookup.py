"""Objects by name: one of kjax's, or one's own as ``"module:NAME"``."""

import difflib
import importlib
from collections.abc import Mapping
from typing import Any


def look_up(key: str, name: str, known: Mapping[str, str], wanted: type, more: str = "") -> Any:
    """What a name stands for.

    Args:
      key: of the config, for errors.
      name: one of ``known``, or ``"module:NAME"``.
      known: names, and where each lies as ``"module:NAME"``.
      wanted: class of the object, or ``type`` for a class.
      more: what else a name may be, for the error.

    Raises:
      ValueError: for a name that is none, or an object of another class.
    """
    place = known.get(name, name)
    module, _, attribute = place.partition(":")
    if not attribute:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise ValueError(
            f"{key}: got '{name}', wanted one of {', '.join(known)}, {more}or 'module:NAME' for a "
            f"{wanted.__name__} of your own{hint}"
        )
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        path = "; is its folder in PYTHONPATH?" if isinstance(error, ModuleNotFoundError) else ""
        raise ValueError(f"{key}: '{name}' cannot be loaded: {error}{path}") from None
    if not isinstance(found, wanted):
        raise ValueError(f"{key}: '{name}' is a {type(found).__name__}, wanted a {wanted.__name__}")
    return found
