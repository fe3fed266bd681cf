"""How far each gait goes: speed, height of blocks, push, slipperiness of the ground.

A value passes if at least 95 % of the seeds stay up and do what was asked: keep within 20 % of the
speed, cross the field. Speed, blocks and friction are bisected; beside a speed that passes stands
the one that was reached. What a gait bears of a push depends on when it comes, and a harder push
may pass where a weaker one does not: so pushes are a map over the gait's cycle, and the limit is
the strongest one up to which every push passes at every phase.

Leaves results.json and figure.png in the output folder. Every episode is kept there, so the same
command goes on after Ctrl-C. A point is 20 episodes of 6 to 10 s, less where two of them have
failed already. On two cores a bisection takes about 2 minutes, a map of pushes about 13.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from kjax import cli
from kjax.config import ConfigError, RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.options import StudyOptions, fail, parse, require
from kjax.runs.bisection import bisect
from kjax.runs.cache import open_cache
from kjax.runs.pool import Run, cached_runner, open_runner
from kjax.studies.reproduce.paper_results import cycle

SHARE = 0.95  # of the seeds that must pass
SPEED = 0.2  # largest relative error of the mean speed
PUSH_AT = 3.0  # s
WALK = {"trot": 0.3, "bound": 0.5}  # m/s, speed for pushes and on slippery ground


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One limit to search for.

    Attributes:
      name: for ``--only`` and JSON.
      title: of its row in the figure.
      quantity: that is varied; axes with the same one share a panel.
      unit: of it.
      config: file in configs/.
      overrides: of its keys.
      easy: value to begin with.
      hard: value to end with; may be the smaller one.
      resolution: to bisect to, or between two values of the map.
      vary: (value, seed, config), of a map (value, seed, config, phase) with the place in the cycle
        from 0 to 1 -> overrides of that episode.
      phases: places in the gait's cycle, evenly spread, of a map; 0 for a bisection.
      wants: "speed" or "crossed" besides not falling, or nothing.
    """

    name: str
    title: str
    quantity: str
    unit: str
    config: str
    overrides: dict[str, Any]
    easy: float
    hard: float
    resolution: float
    vary: Callable[..., dict[str, Any]]
    phases: int = 0
    wants: str = ""


def _speed(value: float, seed: int, config: RunConfig) -> dict[str, Any]:
    return {"command.v_x": [0.0, value]}


def _height(value: float, seed: int, config: RunConfig) -> dict[str, Any]:
    return {"terrain.height_min": value, "terrain.height_max": value, "terrain.seed": seed}


def _push(value: float, seed: int, config: RunConfig, phase: float = 0.0) -> dict[str, Any]:
    """At 3 s and a part of the gait's cycle."""
    late = phase * cycle(config, config.gait.names[0])
    return {"push.times": [round(PUSH_AT + late, 3)], "push.forward": value}


def _friction(value: float, seed: int, config: RunConfig) -> dict[str, Any]:
    return {"sim.friction": value}


def _steady(speed: float, duration: float) -> dict[str, Any]:
    """In place for 1 s, then at a speed that is reached at 2 m/s^2."""
    return {
        "duration": duration,
        "command.times": [0.0, 1.0],
        "command.v_x": [0.0, speed],
        "lmpc.command_slew": 2.0,
    }


_TROT, _BOUND = "trot_velocity.toml", "bound_multiphase.toml"
# Stances of 150 ms, flights of 50.
_FLYING = {"gait.names": ["flying_trot"], "gaits.flying_trot.period": 0.4,
           "gaits.flying_trot.duty": [0.375] * 4}  # fmt: skip
_BLOCKS = {"terrain.kind": "blocks", "terrain.count": 5}
AXES = (
    Axis(name="speed_trot", title="trot", quantity="fastest", unit="m/s", config=_TROT,
         overrides=_steady(0.0, 8.0), easy=0.2, hard=2.2, resolution=0.0625, vary=_speed,
         wants="speed"),
    Axis(name="speed_flying_trot", title="flying trot", quantity="fastest", unit="m/s",
         config=_TROT, overrides=_steady(0.0, 8.0) | _FLYING, easy=0.2, hard=2.2,
         resolution=0.0625, vary=_speed, wants="speed"),
    Axis(name="speed_bound", title="bound", quantity="fastest", unit="m/s", config=_BOUND,
         overrides=_steady(0.0, 8.0), easy=0.2, hard=2.2, resolution=0.0625, vary=_speed,
         wants="speed"),
    Axis(name="blocks_trot", title="trot", quantity="highest blocks", unit="m",
         config="trot_rough.toml", overrides=_BLOCKS | {"duration": 10.0, "terrain.end": 1.8},
         easy=0.01, hard=0.17, resolution=0.01, vary=_height, wants="crossed"),
    Axis(name="blocks_bound", title="bound", quantity="highest blocks", unit="m",
         config="bound_rough.toml", overrides=_BLOCKS | {"duration": 8.0, "terrain.end": 2.4},
         easy=0.01, hard=0.17, resolution=0.01, vary=_height, wants="crossed"),
    Axis(name="push_trot", title="trot", quantity="strongest forward push", unit="N s",
         config=_TROT, overrides=_steady(WALK["trot"], 6.0), easy=2.5, hard=40.0, resolution=2.5,
         vary=_push, phases=7),
    Axis(name="push_bound", title="bound", quantity="strongest forward push", unit="N s",
         config=_BOUND, overrides=_steady(WALK["bound"], 6.0), easy=2.5, hard=40.0,
         resolution=2.5, vary=_push, phases=7),
    Axis(name="friction_trot", title="trot", quantity="slipperiest ground, friction", unit="-",
         config=_TROT, overrides=_steady(WALK["trot"], 8.0), easy=0.8, hard=0.05,
         resolution=0.025, vary=_friction, wants="speed"),
    Axis(name="friction_bound", title="bound", quantity="slipperiest ground, friction", unit="-",
         config=_BOUND, overrides=_steady(WALK["bound"], 8.0), easy=0.8, hard=0.05,
         resolution=0.025, vary=_friction, wants="speed"),
)  # fmt: skip
NAMES = tuple(axis.name for axis in AXES)


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, search every axis, draw the figure."""
    args = _parse(argv)
    folder = cli.output_folder(args, "envelope")
    cli.configure_jax(one_core=args.jobs == 1)
    cache = open_cache(folder)
    found: dict[str, Any] = {}
    for axis in AXES:  # what is not asked for now stays in the figure, if it is there whole
        for base in ("planar", "free"):
            if axis.name not in args.only or base not in args.bases:
                with suppress(KeyError):
                    found[f"{axis.name}_{base}"] = _search(axis, base, args, cached_runner(cache))
    try:
        with open_runner(cache, jobs=args.jobs) as run:
            for axis in AXES:
                for base in args.bases if axis.name in args.only else ():
                    one = _search(axis, base, args, run)
                    found[f"{axis.name}_{base}"] = one
                    print(f"{axis.quantity}, {one['title']}: {_shown(one)}", flush=True)
                    _save(folder, found, args)
    except ConfigError as error:
        fail(str(error))
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        return 130
    print(f"results in {folder}/")
    return 0


@dataclass(kw_only=True)
class EnvelopeOptions(StudyOptions):
    """Options of the study."""

    names = NAMES

    seeds: int = 20
    """Episodes per point."""

    base: Literal["planar", "free", "both"] = "planar"
    """Of the trunk."""


def _parse(argv: Sequence[str] | None) -> EnvelopeOptions:
    args = parse(EnvelopeOptions, argv, __doc__.split("\n\n")[0])
    require(args, "seeds", least=1)
    args.out = args.out or Path("results") / "envelope"
    return args


def _config(axis: Axis, base: str, args: EnvelopeOptions) -> RunConfig:
    """Config of an axis, before its value is put in."""
    overrides = {"sim.base": base} | axis.overrides
    config = load_config(RunConfig, shipped_config(axis.config), overrides)
    return dataclasses.replace(config, duration=1.2) if args.quick else config


def _search(axis: Axis, base: str, args: EnvelopeOptions, run: Run) -> dict[str, Any]:
    """Bracket of one axis, and every point that was probed."""
    config = _config(axis, base, args)
    seeds = min(args.seeds, 2) if args.quick else args.seeds
    resolution = abs(axis.hard - axis.easy) / 2.0 if args.quick else axis.resolution
    probed: list[dict[str, Any]] = []

    def passes(value: float, phase: float | None = None) -> bool:
        point = _point(axis, base, config, value, phase, seeds, run)
        probed.append(point)
        return bool(point["passed"])

    if axis.phases:
        count = 2 if args.quick else axis.phases
        found = _map(passes, axis, resolution, [i / count for i in range(count)])
        length = cycle(config, config.gait.names[0])
        for one in found["phases"]:
            one["late_s"] = round(one["phase"] * length, 3)
    else:
        found = bisect(passes, axis.easy, axis.hard, resolution)._asdict()
    at_limit = [p for p in probed if p["value"] == found["passed"]]
    return {
        "title": f"{axis.title}, {base}",
        "quantity": axis.quantity,
        "unit": axis.unit,
        "easy": axis.easy,
        **found,
        "reached_mps": at_limit[0]["reached_mps"] if axis.wants == "speed" and at_limit else None,
        "resolution": resolution,
        "seeds": seeds,
        "probed": probed,
    }


def _point(
    axis: Axis, base: str, config: RunConfig, value: float, phase: float | None, seeds: int,
    run: Run,
) -> dict[str, Any]:  # fmt: skip
    """Episodes of all seeds at a value, fewer where too many have failed already."""
    where = () if phase is None else (phase,)
    allowed = math.floor((1.0 - SHARE) * seeds + 1e-9)
    chosen = [_changed(config, axis.vary(value, s, config, *where), s) for s in range(seeds)]

    def hopeless(results: list[dict[str, Any]]) -> bool:
        return sum(not _passed(axis, value, result) for result in results) > allowed

    label = f"{axis.name} ({base}) {value:.3g} {axis.unit}"
    label += "" if phase is None else f" at {phase:.2f} of the cycle"
    results = [r for r in run(chosen, label=label, enough=hopeless) if r is not None]
    failures = sum(not _passed(axis, value, result) for result in results)
    speeds = [r["velocity_late_mean_mps"] for r in results
              if not r["fell"] and "velocity_late_mean_mps" in r]  # fmt: skip
    return {
        "value": value,
        **({} if phase is None else {"phase": phase}),
        "run": len(results),
        "failures": failures,
        "falls": sum(result["fell"] for result in results),
        "reached_mps": float(np.median(speeds)) if speeds else None,
        "passed": failures <= allowed,
    }


def _map(
    passes: Callable[[float, float], bool], axis: Axis, resolution: float, phases: Sequence[float]
) -> dict[str, Any]:
    """At each phase the values from the easy end on until one fails; the weakest phase counts.

    Returns:
      ``passed``, up to which every value passes at every phase (``None`` if not even the first
      does), ``failed``, the first one that fails at some phase (``None`` if none does), and the
      same of each phase.
    """
    steps = round(abs(axis.hard - axis.easy) / resolution)
    values = [float(v) for v in np.linspace(axis.easy, axis.hard, steps + 1)]
    found = []
    for phase in phases:
        good = 0
        while good < len(values) and passes(values[good], phase):
            good += 1
        found.append(
            {"phase": phase, "passed": values[good - 1] if good else None,
             "failed": values[good] if good < len(values) else None}
        )  # fmt: skip
    weakest = min(found, key=lambda one: len(values) if one["failed"] is None
                  else values.index(one["failed"]))  # fmt: skip
    return {"passed": weakest["passed"], "failed": weakest["failed"], "phases": found}


def _changed(config: RunConfig, overrides: dict[str, Any], seed: int) -> RunConfig:
    """The config with values of ``section.key`` names replaced, and a seed."""
    sections: dict[str, dict[str, Any]] = {}
    for name, value in overrides.items():
        section, key = name.split(".")
        sections.setdefault(section, {})[key] = tuple(value) if isinstance(value, list) else value
    for section, values in sections.items():
        inner = dataclasses.replace(getattr(config, section), **values)
        config = dataclasses.replace(config, **{section: inner})
    return dataclasses.replace(config, seed=seed)


def _passed(axis: Axis, value: float, result: dict[str, Any]) -> bool:
    """Whether an episode stayed up and did what was asked."""
    if result["fell"]:
        return False
    if axis.wants == "crossed":
        return result["crossed"]
    if axis.wants == "speed" and "velocity_late_mean_mps" in result:
        wanted = value if axis.quantity == "fastest" else WALK[axis.title]
        return abs(result["velocity_late_mean_mps"] - wanted) <= SPEED * wanted
    return True


def _shown(one: dict[str, Any]) -> str:
    """The bracket in words."""
    unit, phases = one["unit"], one.get("phases")
    everywhere = " at every phase" if phases else ""
    if one["passed"] is None:
        return f"fails at {one['easy']:.3g} {unit} already" + (" at some phase" if phases else "")
    limit = f"{one['passed']:.3g} {unit} passes{everywhere}"
    if one.get("reached_mps") is not None:
        limit += f" (the speed reached is {one['reached_mps']:.3g} m/s)"
    if one["failed"] is None:
        limit += ", the end of the search"
    else:
        limit += f", {one['failed']:.3g} does not"
    if phases:
        each = ", ".join("none" if p["passed"] is None else f"{p['passed']:.3g}" for p in phases)
        limit += f"; from phase to phase: {each}"
    return limit


def _save(folder: Path, found: dict[str, Any], args: EnvelopeOptions) -> None:
    from kjax.viz.report import envelope_figure

    record = {"provenance": cli.provenance(), "quick": args.quick, "share": SHARE}
    cli.save_json(folder / "results.json", record | {"axes": found})
    envelope_figure(found, folder / "figure.png")
