"""How far each gait goes, by bisection: speed, height of blocks, push, slipperiness of the ground.

A value passes if at least 95 % of the seeds stay up and do what was asked: reach the speed within
20 %, cross the field. Leaves results.json and figure.png in the output folder. Every episode is
kept there, so the same command goes on after Ctrl-C. The whole takes about 20 minutes per base on
two cores: a point is 20 episodes of 6 to 10 s, less where two of them have failed already.
"""

import dataclasses
import json
import math
from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from paper_results import CONFIGS, cycle

from kjax import cli
from kjax.config import ConfigError, RunConfig, load_config
from kjax.episodes import Run, Store, code_version, config_hash, open_runner
from kjax.sim.bisection import bisect

SHARE = 0.95  # of the seeds that must pass
SPEED = 0.2  # largest relative error of the mean speed
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
      resolution: to bisect to.
      vary: (value, seed, config) -> overrides of that episode.
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
    vary: Callable[[float, int, RunConfig], dict[str, Any]]
    wants: str = ""


def _speed(value: float, seed: int, config: RunConfig) -> dict[str, Any]:
    return {"command.velocities": [0.0, value]}


def _height(value: float, seed: int, config: RunConfig) -> dict[str, Any]:
    return {"terrain.height_min": value, "terrain.height_max": value, "terrain.seed": seed}


def _push(value: float, seed: int, config: RunConfig) -> dict[str, Any]:
    """At 3 s, later by another part of the gait's cycle for every seed (golden ratio)."""
    place = (seed * (math.sqrt(5.0) - 1.0) / 2.0) % 1.0
    late = place * cycle(config, config.gait.names[0])
    return {"push.times": [round(3.0 + late, 3)], "push.forward": value}


def _friction(value: float, seed: int, config: RunConfig) -> dict[str, Any]:
    return {"sim.friction": value}


def _steady(speed: float, duration: float) -> dict[str, Any]:
    """Walk in place for 1 s, then at a speed that is reached at 2 m/s^2."""
    return {
        "duration": duration,
        "command.times": [0.0, 1.0],
        "command.velocities": [0.0, speed],
        "lmpc.command_slew": 2.0,
    }


_TROT, _BOUND = "trot_velocity.toml", "bound_multiphase.toml"
_FLYING = {"gait.trot_flight": 0.05, "gait.stance_time": 0.15}
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
         config=_TROT, overrides=_steady(WALK["trot"], 6.0), easy=1.0, hard=65.0, resolution=1.0,
         vary=_push),
    Axis(name="push_bound", title="bound", quantity="strongest forward push", unit="N s",
         config=_BOUND, overrides=_steady(WALK["bound"], 6.0), easy=1.0, hard=65.0,
         resolution=1.0, vary=_push),
    Axis(name="friction_trot", title="trot", quantity="slipperiest ground, friction", unit="-",
         config=_TROT, overrides=_steady(WALK["trot"], 8.0), easy=0.8, hard=0.05,
         resolution=0.025, vary=_friction, wants="speed"),
    Axis(name="friction_bound", title="bound", quantity="slipperiest ground, friction", unit="-",
         config=_BOUND, overrides=_steady(WALK["bound"], 8.0), easy=0.8, hard=0.05,
         resolution=0.025, vary=_friction, wants="speed"),
)  # fmt: skip
NAMES = tuple(axis.name for axis in AXES)


def main() -> None:
    """Parse the command line, search every axis, draw the figure."""
    args = _parse()
    folder = cli.output_folder(args, "envelope")
    cli.configure_jax(one_core=args.jobs == 1)
    code = code_version()
    store = Store(folder / "episodes.json", code)
    if store.outdated:
        print(f"{folder}: the code has changed since; starting afresh")
    found = _kept(folder / "results.json", code, args)
    try:
        with open_runner(store, jobs=args.jobs) as run:
            for axis in AXES:
                for base in args.bases if axis.name in args.only else ():
                    one = _search(axis, base, args, run)
                    found[f"{axis.name}_{base}"] = one
                    print(f"{axis.quantity}, {one['title']}: {_shown(one)}", flush=True)
                    _save(folder, found, code, args)
    except ConfigError as error:
        cli.fail(str(error))
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        raise SystemExit(130) from None
    print(f"results in {folder}/")


def _parse() -> Namespace:
    return cli.parse_study(
        __doc__.split("\n\n")[0],
        NAMES,
        counts={"seeds": (20, "episodes per point")},
        base="planar",
        quick="2 seeds of 1.2 s, coarsely: to check the script",
        default_out="envelope",
    )


def _kept(path: Path, code: str, args: Namespace) -> dict[str, Any]:
    """Brackets of an earlier call that still hold, so that ``--only`` adds to the figure."""
    old = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if (old.get("code"), old.get("quick")) != (code, args.quick):
        return {}
    return {
        f"{axis.name}_{base}": old["axes"][f"{axis.name}_{base}"]
        for axis in AXES
        for base in ("planar", "free")
        if old["axes"].get(f"{axis.name}_{base}", {}).get("config")
        == config_hash(_config(axis, base, args))
    }


def _config(axis: Axis, base: str, args: Namespace) -> RunConfig:
    """Config of an axis, before its value is put in."""
    overrides = {"sim.base": base} | axis.overrides
    config = load_config(RunConfig, CONFIGS / axis.config, overrides)
    return dataclasses.replace(config, duration=1.2) if args.quick else config


def _search(axis: Axis, base: str, args: Namespace, run: Run) -> dict[str, Any]:
    """Bisect one axis; the bracket and every point that was probed."""
    config = _config(axis, base, args)
    seeds = min(args.seeds, 2) if args.quick else args.seeds
    allowed = math.floor((1.0 - SHARE) * seeds + 1e-9)
    probed: list[dict[str, Any]] = []

    def passes(value: float) -> bool:
        chosen = [_changed(config, axis.vary(value, seed, config), seed) for seed in range(seeds)]

        def hopeless(results: list[dict[str, Any]]) -> bool:
            return sum(not _passed(axis, value, result) for result in results) > allowed

        label = f"{axis.name} ({base}) {value:.3g} {axis.unit}"
        results = [r for r in run(chosen, label=label, enough=hopeless) if r is not None]
        failures = sum(not _passed(axis, value, result) for result in results)
        falls = sum(result["fell"] for result in results)
        probed.append(
            {"value": value, "run": len(results), "failures": failures, "falls": falls,
             "passed": failures <= allowed}
        )  # fmt: skip
        return failures <= allowed

    resolution = abs(axis.hard - axis.easy) / 2.0 if args.quick else axis.resolution
    bracket = bisect(passes, axis.easy, axis.hard, resolution)
    return {
        "title": f"{axis.title}, {base}",
        "quantity": axis.quantity,
        "unit": axis.unit,
        "easy": axis.easy,
        "passed": bracket.passed,
        "failed": bracket.failed,
        "resolution": resolution,
        "seeds": seeds,
        "config": config_hash(config),
        "probed": probed,
    }


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
    if one["passed"] is None:
        return f"fails at {one['easy']:.3g} {one['unit']} already"
    limit = f"{one['passed']:.3g} {one['unit']} passes"
    return limit + (", the end of the search" if one["failed"] is None
                    else f", {one['failed']:.3g} does not")  # fmt: skip


def _save(folder: Path, found: dict[str, Any], code: str, args: Namespace) -> None:
    from kjax.viz.report import envelope_figure

    record = {"provenance": cli.provenance(), "code": code, "quick": args.quick, "share": SHARE}
    cli.save_json(folder / "results.json", record | {"axes": found})
    envelope_figure(found, folder / "figure.png")


if __name__ == "__main__":
    cli.run(main)
