"""From a sweep's axes to its cases: a grid or a random sample, times seeds."""

import ast
import operator
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kjax.config import AxisConfig, ConfigError, RunConfig, SweepConfig, load_config


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
      file: that it came from; ``base`` is seen from there.

    Raises:
      ConfigError: naming the key that no run can be made of.
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
    base = file.parent / sweep.base
    cases = []
    for point in points:
        keys = {key: _fill(value, point, f"set.{key}") for key, value in sweep.set.items()}
        for seed in seeds:
            own = {**keys, "seed": int(seed), "terrain.seed": int(seed)}
            cases.append(_load(base, own, point, file))
    coords["seed"] = (("seed",), seeds, "-")
    return Plan(dims=(*dims, "seed"), coords=coords, shape=(*shape, len(seeds)), cases=cases)


def _load(base: Path, keys: Mapping[str, Any], point: Mapping[str, Any], file: Path) -> RunConfig:
    try:
        return load_config(RunConfig, base, keys)
    except ConfigError as error:
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
    """Value of an expression of names, numbers, + - * / and brackets; a name alone may be text.

    Raises:
      ConfigError: naming the key, for anything else.
    """

    def value(node: ast.AST) -> Any:
        match node:
            case ast.Name(id=name) if name in names:
                return names[name]
            case ast.Name(id=name):
                raise ConfigError(f"{key}: no axis named '{name}', there are {', '.join(names)}")
            case ast.Constant(value=int() | float() as number):
                return number
            case ast.UnaryOp(op=sign, operand=inner) if type(sign) in _OPERATORS:
                return _OPERATORS[type(sign)](value(inner))
            case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _OPERATORS:
                return _OPERATORS[type(sign)](value(left), value(right))
        raise ConfigError(f"{key}: got '= {text}', wanted numbers, axes and + - * / ( )")

    try:
        tree = ast.parse(text, mode="eval")
    except SyntaxError:
        raise ConfigError(f"{key}: got '= {text}', wanted numbers, axes and + - * / ( )") from None
    return value(tree.body)
