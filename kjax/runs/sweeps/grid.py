"""From a sweep's axes to its cases: a grid or a random sample, times seeds."""

import ast
import difflib
import math
import operator
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kjax.config import AxisConfig, ConfigError, RunConfig, SweepConfig, load_config
from kjax.config.shipped import shipped_config, shipped_names
from kjax.controllers.walkable import check_walkable
from kjax.robots import get_robot
from kjax.sim.metrics import metric_names
from kjax.sim.resolve import resolve_goal


@dataclass(frozen=True, kw_only=True)
class Plan:
    """All cases of a sweep.

    Attributes:
      dims: names of the dimensions, ``seed`` the last one.
      coords: name -> (dims, values, unit) of every axis, and of the seeds.
      shape: length of each dimension.
      cases: the configs, in C order of the dimensions.
    """

    dims: tuple[str, ...]
    coords: dict[str, tuple[tuple[str, ...], np.ndarray, str]]
    shape: tuple[int, ...]
    cases: list[RunConfig]


def plan(sweep: SweepConfig, file: Path) -> Plan:
    """The cases of a sweep.

    Args:
      sweep: its config.
      file: that it came from; a ``base`` that is a file is seen from there.

    Raises:
      ConfigError: naming the key that no run can be made of, or that no figure can be drawn of,
        or the point at which the robot cannot walk.
    """
    seeds = np.arange(sweep.first_seed, sweep.first_seed + sweep.seeds)
    names = tuple(sweep.axes)
    units = {name: axis.unit for name, axis in sweep.axes.items()}
    if sweep.sample:
        rng = np.random.default_rng(sweep.sample_seed)
        drawn = rng.random((sweep.sample, len(names)))
        points = [
            {name: _between(sweep.axes[name], part) for name, part in zip(names, row, strict=True)}
            for row in drawn
        ]
        dims: tuple[str, ...] = ("sample",)
        shape: tuple[int, ...] = (sweep.sample,)
        coords = {
            name: (dims, np.array([point[name] for point in points]), units[name]) for name in names
        }
    else:
        values = {name: _values(axis) for name, axis in sweep.axes.items()}
        dims, shape = names, tuple(len(v) for v in values.values())
        points = [
            {name: values[name][i] for name, i in zip(names, index, strict=True)}
            for index in np.ndindex(*shape)
        ]
        coords = {name: ((name,), np.array(values[name]), units[name]) for name in names}
    base = base_of(sweep, file)
    cases = []
    for point in points:
        keys = {key: _fill(value, point, f"{file}: set.{key}") for key, value in sweep.set.items()}
        for seed in seeds:
            own = {**keys, "seed": int(seed), "terrain.seed": int(seed)}
            cases.append(_load(base, own, point, file))
        _check_walkable(cases[-1], point, file)
    _check_figure(sweep, dims, cases, file)
    coords["seed"] = (("seed",), seeds, "-")
    return Plan(dims=(*dims, "seed"), coords=coords, shape=(*shape, len(seeds)), cases=cases)


def base_of(sweep: SweepConfig, file: Path) -> Path:
    """The closed loop's own config: a file seen from the sweep's, or a shipped one by its name."""
    path = file.parent / sweep.base
    return shipped_config(sweep.base) if sweep.base in shipped_names() else path


def _check_figure(
    sweep: SweepConfig, dims: tuple[str, ...], cases: list[RunConfig], file: Path
) -> None:
    """Refuse a figure of axes or metrics that there are none of, before anything walks."""
    wish = sweep.figure
    if wish is None:
        return
    for key in ("x", "y", "panels"):
        name = getattr(wish, key)
        if name and name not in dims:
            raise ConfigError(
                f"{file}: figure.{key}: no axis named '{name}', there are {', '.join(dims)}"
            )
    known = {"success"}.union(*(metric_names(resolve_goal(case)) for case in cases))
    for name in wish.metrics:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(sorted(known))}"
            raise ConfigError(f"{file}: figure.metrics: no metric named '{name}'; {hint}")


def _load(base: Path, keys: Mapping[str, Any], point: Mapping[str, Any], file: Path) -> RunConfig:
    try:
        return load_config(RunConfig, base, keys)
    except ConfigError as error:
        where = ", ".join(f"{name} = {value}" for name, value in point.items())
        raise ConfigError(f"{file}: at {where}: {error}") from None


def _check_walkable(config: RunConfig, point: Mapping[str, Any], file: Path) -> None:
    """Refuse a point before anything walks, not when its turn comes."""
    try:
        with warnings.catch_warnings(action="ignore"):  # each is told when its walk begins
            check_walkable(config, get_robot(config.robot).params)
    except ValueError as error:
        where = ", ".join(f"{name} = {value}" for name, value in point.items())
        raise ConfigError(f"{file}: at {where}: {error}") from None


def _values(axis: AxisConfig) -> list[Any]:
    if axis.values:
        return list(axis.values)
    assert axis.low is not None  # SweepConfig saw to it
    assert axis.high is not None
    assert axis.count is not None
    return [float(v) for v in np.round(np.linspace(axis.low, axis.high, axis.count), 12)]


def _between(axis: AxisConfig, part: float) -> float:
    assert axis.low is not None  # SweepConfig saw to it
    assert axis.high is not None
    return float(axis.low + (axis.high - axis.low) * part)


def _fill(value: Any, point: Mapping[str, Any], key: str) -> Any:
    """The value with its expressions computed."""
    if isinstance(value, list | tuple):
        return [_fill(item, point, key) for item in value]
    if isinstance(value, str) and value.startswith("="):
        return evaluate(value[1:].strip(), point, key)
    return value


_OPERATORS: dict[type, Any] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.USub: operator.neg,
}


def evaluate(text: str, names: Mapping[str, Any], key: str) -> Any:
    """Value of an expression of names, literals, + - * / and brackets; a name alone may be text.

    Raises:
      ConfigError: naming the key, for anything else, and where the value is no finite number.
    """
    unwanted = ConfigError(f"{key}: got '= {text}', wanted literals, axes and + - * / ( )")

    def value(node: ast.AST) -> Any:
        match node:
            case ast.Name(id=name) if name in names:
                return names[name]
            case ast.Name(id=name):
                raise ConfigError(f"{key}: no axis named '{name}', there are {', '.join(names)}")
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return number
            case ast.UnaryOp(op=sign, operand=inner) if type(sign) in _OPERATORS:
                return _OPERATORS[type(sign)](number_of(inner))
            case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _OPERATORS:
                return _OPERATORS[type(sign)](number_of(left), number_of(right))
        raise unwanted

    def number_of(node: ast.AST) -> Any:
        found = value(node)
        if isinstance(found, bool) or not isinstance(found, int | float):
            raise unwanted
        return found

    where = ", ".join(f"{name} = {there}" for name, there in names.items())
    try:
        found = value(ast.parse(text, mode="eval").body)
    except SyntaxError:
        raise unwanted from None
    except ZeroDivisionError:
        raise ConfigError(f"{key}: got '= {text}', which divides by zero at {where}") from None
    except OverflowError:
        found = math.inf
    if isinstance(found, float) and not math.isfinite(found):
        raise ConfigError(f"{key}: got '= {text}', which is no finite number at {where}")
    return found
