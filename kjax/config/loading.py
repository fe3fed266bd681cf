"""From TOML and the command line to a config; a wrong key or value is one clear line."""

import dataclasses
import difflib
import json
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from kjax.config.checks import Tunable, Unit
from kjax.config.control import LateralConfig, LegConfig, LmpcConfig
from kjax.config.gaits import LIBRARY, GaitConfig, Gaits, dump_used, on_library, reachable_gaits

T = TypeVar("T")


# Keys of earlier versions in SI units, and what they are now; of [gaits.NAME] as of [lmpc].
_RESCALED = {
    "state_weights": "Q",
    "input_weight": "R",
    "force_x_max": "grf_x_max",
    "force_z_min": "grf_z_min",
    "force_z_max": "grf_z_max",
    "height": "body_height",
}
_RESCALED_GAIT = _RESCALED | {
    "feet_front": "foothold_front",
    "feet_rear": "foothold_rear",
    "velocity_gain": "foothold_gain",
    "apex": "swing_height",
}
_RESCALED_LEG = {
    "apex": "swing_height",
    "velocity_gain": "foothold_gain",
    "kp": "swing_kp",
    "kd": "swing_kd",
    "kp_abduction": "abduction_kp",
    "kd_abduction": "abduction_kd",
    "blind_damping": "blind_kd",
}
_RESCALED_LATERAL = {
    "roll_stiffness": "roll_kp",
    "roll_damping": "roll_kd",
    "yaw_stiffness": "yaw_kp",
    "yaw_damping": "yaw_kd",
    "damping": "sideways_kd",
    "wrench_weights": "wrench_cost",
    "velocity_gain": "foothold_gain",
}


def _rescaled(cls: type, new: str, section: str) -> str:
    """What to say of a key that is now in units that scale with the robot."""
    info = cls.__pydantic_fields__[new]  # type: ignore[attr-defined]
    unit = next(mark for mark in info.metadata if isinstance(mark, Unit))
    return (
        f"is now {section}.{new}, in units of {unit.text} (m g: the robot's weight, L: its leg "
        "length)"
    )


def _all_rescaled(cls: type, names: Mapping[str, str], old: str, new: str) -> dict[str, str]:
    return {f"{old}.{key}": _rescaled(cls, name, new) for key, name in names.items()}


# What has become of keys of earlier versions.
_BOUND = "is now [gaits.bound] (or gaits.bound_multiphase, which predicts through flight)"
RETIRED = {
    **_all_rescaled(LmpcConfig, _RESCALED, "lmpc", "lmpc"),
    **_all_rescaled(LegConfig, _RESCALED_LEG, "leg", "leg"),
    **_all_rescaled(LateralConfig, _RESCALED_LATERAL, "lateral", "lateral"),
    **_all_rescaled(GaitConfig, _RESCALED_GAIT, "bound", "gaits.bound"),
    **_all_rescaled(
        GaitConfig,
        {key: name for key, name in _RESCALED.items() if key != "height"},
        "multiphase",
        "gaits.bound_multiphase",
    ),
    **{
        f"bound.{key}": f"{_BOUND}: set its period, offset and duty"
        for key in ("front_stance", "first_flight", "rear_stance", "second_flight")
    },
    **{
        f"bound.{key}": f"is now gaits.bound.{key}"
        for key in ("ramp_start", "ramp_cycles", "reference", "force_edge")
    },
    "bound.horizon": "has gone: the gait bound_multiphase predicts through flight (gait.names)",
    "lmpc.caution": "is now lmpc.uncertainty_discount",
    "gait.stance_time": "has gone: set gaits.trot.period and gaits.trot.duty",
    "gait.trot_flight": "has gone: the gait flying_trot has flights (gait.names)",
    "gait.switch_rule": "is now gaits.bound.switch_rule: 'anywhere', 'first_flight', 'cycle_end'",
    "gait.landing_time": "has gone: set gaits.bound.transition_gait = 'landing' and "
    "gaits.landing.period",
    "command.velocities": "is now command.v_x",
    "lmpc.height_above": "is no key any more: heights are measured from the stance feet",
    "lateral.friction_offset": "is no key any more: lateral.friction bounds the horizontal force",
    "lateral.plan_friction": "is no key any more: lmpc.friction bounds the plan, lateral.friction "
    "what is pressed",
    "lateral.plan_friction_bound": "is no key any more: lmpc.friction and multiphase.friction "
    "bound the plan, lateral.friction what is pressed",
}


def replacement_of(key: str) -> str:
    """What has become of a key of an earlier version; empty for a key that there never was."""
    section, _, leaf = key.rpartition(".")
    if section.startswith("gaits.") and leaf in _RESCALED_GAIT:
        return _rescaled(GaitConfig, _RESCALED_GAIT[leaf], section)
    return RETIRED.get(key, "")


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names file, key, value and wish."""


def fields(cls: type, prefix: str = "") -> Iterator[tuple[str, FieldInfo, Any]]:
    """Leaf keys of a config class as (dotted name, field, default)."""
    for name, info in cls.__pydantic_fields__.items():  # type: ignore[attr-defined]
        if info.annotation is Gaits:
            for gait, own in LIBRARY.items():
                for key, entry, _ in fields(GaitConfig, f"{prefix}{name}.{gait}."):
                    yield key, entry, getattr(own, key.rsplit(".", 1)[1])
        elif dataclasses.is_dataclass(info.annotation):
            yield from fields(info.annotation, f"{prefix}{name}.")  # type: ignore[arg-type]
        else:
            yield f"{prefix}{name}", info, info.default


def tunable(cls: type, gaits: Iterable[str] = ()) -> dict[str, Tunable]:
    """Keys of a config class that may be tuned, and how.

    Args:
      cls: config class.
      gaits: names of a config's own gaits, besides the library's.
    """
    keys = [(name, info) for name, info, _ in fields(cls)]
    for gait in gaits:
        keys += [(name, info) for name, info, _ in fields(GaitConfig, f"gaits.{gait}.")]
    return {
        name: mark for name, info in keys for mark in info.metadata if isinstance(mark, Tunable)
    }


class Overlay:
    """A config to be read with other values at some keys, traced ones perhaps."""

    def __init__(self, config: Any, values: Mapping[str, Any]):
        """The config (or a section of it), and values by dotted key."""
        self._config, self._values = config, dict(values)

    def __getattr__(self, name: str) -> Any:
        """The value, the section with its values, or what the config holds."""
        if name in self._values:
            return self._values[name]
        inside = {
            key.removeprefix(f"{name}."): value
            for key, value in self._values.items()
            if key.startswith(f"{name}.")
        }
        held = self._config
        own = held[name] if isinstance(held, Mapping) else getattr(held, name)
        return Overlay(own, inside) if inside else own

    def __getitem__(self, name: str) -> Any:
        """Likewise, of a mapping such as ``gaits``."""
        return self.__getattr__(name)


def load_config(
    cls: type[T], path: str | Path | None = None, overrides: Mapping[str, Any] | None = None
) -> T:
    """Config of type ``cls`` from a TOML file, with overrides by dotted name.

    Args:
      cls: a config dataclass of this module.
      path: TOML file; ``None`` means all defaults.
      overrides: e.g. ``{"lmpc.horizon": 10}``; they win over the file.

    Raises:
      ConfigError: with one line that names the file, the key, what came and what was wanted.
    """
    data: dict[str, Any] = {}
    source = "command line"
    if path is not None:
        source = str(path)
        try:
            # Editors on Windows put a byte order mark first, which TOML has not.
            data = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
        except FileNotFoundError:
            raise ConfigError(f"{source}: no such file{_nearest_file(Path(path))}") from None
        except OSError as error:
            raise ConfigError(f"{source}: cannot be read: {error.strerror}") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ConfigError(f"{source}: not valid TOML: {error}") from None
    given = dict(data)
    for key, value in (overrides or {}).items():
        *sections, leaf = key.split(".")
        node = data
        for section in sections:
            node = node.setdefault(section, {})
            if not isinstance(node, dict):
                raise ConfigError(f"{source}: {key}: '{section}' is a value, not a section")
        node[leaf] = value
    if "gaits" in data:
        data["gaits"] = on_library(data["gaits"])
    try:
        # Through JSON, since strict mode then takes lists for tuples but still no "3" for 3.
        return TypeAdapter(cls).validate_json(json.dumps(data, default=str), strict=True)
    except ValidationError as error:
        from kjax.config.kinds import other_kind  # it imports the classes that this file fills

        text = other_kind(given, cls)
        raise ConfigError(
            f"{source} {text}" if text else f"{source}: {_explain(error, cls)}"
        ) from None


def _explain(error: ValidationError, cls: type) -> str:
    """One line on the first problem, and how many more there are."""
    first, *rest = error.errors(include_url=False)
    loc = tuple(str(part) for part in first["loc"])
    key = ".".join(loc)
    came = first["input"]
    if first["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        became = replacement_of(key)
        if became:
            return f"{key}: {became}"
        inner = [old for old in RETIRED if old.startswith(f"{key}.")]
        if inner and isinstance(came, Mapping):  # a section that has gone
            old = next((o for o in inner if o.split(".", 1)[1] in came), inner[0])
            return f"{old}: {RETIRED[old]}"
        names = {name for name, _, _ in fields(cls)}
        names |= {name.rsplit(".", 1)[0] for name in names if "." in name}
        near_key = nearest_key(key, names)
        hint = f"; did you mean '{near_key}'?" if near_key else ""
        text = f"{key}: unknown key (got {_short(came)}){hint}"
    elif first["type"].startswith("missing") and isinstance(first["loc"][-1], str):
        text = f"{key}: missing, it has no default"
    elif first["type"] == "value_error":
        wish = first["msg"].removeprefix("Value error, ")
        text = f"{key}: {wish}" if key else wish
    else:
        wish = first["msg"].removeprefix("Input should be ")
        if first["type"] in ("tuple_type", "missing", "too_long"):
            rest = [error for error in rest if error["type"] != "missing"]
            key = ".".join(part for part in loc if not part.isdecimal())
            wish = _wanted_list(cls, key) or wish
        options = [str(o) for o in first.get("ctx", {}).get("expected", "").split("'")[1::2]]
        near = difflib.get_close_matches(str(came), options, n=1, cutoff=0.5)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        text = f"{key}: got {_short(came)}, wanted {wish}{hint}"
    return text + (f" (and {len(rest)} more)" if rest else "")


def nearest_key(key: str, known: Iterable[str]) -> str | None:
    """The config key that was probably meant: one of the same gait, where it is a gait's."""
    *section, leaf = key.split(".")
    if len(section) == 2 and section[0] == "gaits":
        leaves = {name for name, _, _ in fields(GaitConfig)}
        near = difflib.get_close_matches(leaf, leaves, n=1, cutoff=0.5)
        return ".".join([*section, *near]) if near else None
    near = difflib.get_close_matches(key, list(known), n=1, cutoff=0.5)
    return near[0] if near else None


def _wanted_list(cls: type, key: str) -> str | None:
    """The list that a key wants, in words: "a list of 4 numbers"; ``None`` where it wants none."""
    known = chain(fields(cls), fields(GaitConfig, f"{key.rpartition('.')[0]}."))
    kind = next((info.annotation for name, info, _ in known if name == key), None)
    options = (kind, *get_args(kind))
    entries = next((get_args(one) for one in options if get_origin(one) is tuple), None)
    if entries is None:
        return None
    noun = "names" if entries[0] is str else "numbers"
    return f"a list of {noun}" if entries[-1] is ... else f"a list of {len(entries)} {noun}"


def _short(value: Any) -> str:
    """A value as shown in a message, on one line."""
    text = repr(value)
    if len(text) <= 60:
        return text
    return f"a section of {len(value)} keys" if isinstance(value, dict) else text[:57] + "..."


def _nearest_file(path: Path) -> str:
    if not path.parent.is_dir():
        return ""
    near = difflib.get_close_matches(path.name, [p.name for p in path.parent.glob("*.toml")], n=1)
    return f"; did you mean '{path.parent / near[0]}'?" if near else ""


def to_dict(config: Any) -> dict[str, Any]:
    """The config as nested plain data (lists for tuples), ready for TOML or JSON."""
    data: dict[str, Any] = TypeAdapter(type(config)).dump_python(config, mode="json")
    if "gaits" in data:
        data["gaits"] = dump_used(config.gaits, reachable_gaits(config.gaits, config.gait.names))
    return data
