"""Grounds that the robot does not see: slopes, steps, tiles; and the paper's field and profiles."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from kjax.config import RunConfig
from kjax.studies.spatial.cases import (
    GAITS,
    Done,
    Part,
    Row,
    SpatialOptions,
    base,
    median,
    number,
    percent,
    share,
)  # fmt: skip
from kjax.studies.spatial.measures import walked
from kjax.viz.tables import markdown_table

_HIGH = {"leg.swing_height": 0.33, "leg.hold_after": 0.6}  # for what feet must clear


@dataclass(frozen=True, kw_only=True)
class Ground:
    """A kind of ground over one number.

    Attributes:
      name: of it.
      title: of its row.
      unit: of the number.
      values: that are tried.
      keys: of the config besides.
      vary: key of the config that the number is for, and a factor.
    """

    name: str
    title: str
    unit: str
    values: tuple[float, ...]
    keys: dict[str, Any]
    vary: dict[str, float]


ANGLES = (10.0, 15.0, 20.0, 25.0, 30.0)
HEIGHTS = (0.04, 0.06, 0.08, 0.1, 0.12)
_STEPS = {"terrain.height_min": 1.0, "terrain.height_max": 1.0}
GROUNDS = (
    Ground(name="up", title="slope up, then down", unit="deg", values=ANGLES,
           keys={"terrain.kind": "slope"}, vary={"terrain.slope": 1.0}),
    Ground(name="down", title="slope down, then up", unit="deg", values=ANGLES,
           keys={"terrain.kind": "slope"}, vary={"terrain.slope": -1.0}),
    Ground(name="across", title="slope across the way", unit="deg", values=ANGLES,
           keys={"terrain.kind": "cross_slope"}, vary={"terrain.slope": 1.0}),
    Ground(name="steps", title="four steps up, four down", unit="m", values=HEIGHTS,
           keys={"terrain.kind": "steps", "command.v_x": [0.0, 0.3], **_HIGH}, vary=_STEPS),
    Ground(name="tiles", title="tiles of up to this height", unit="m", values=HEIGHTS,
           keys={"terrain.kind": "tiles", "terrain.count": 18, "terrain.height_min": 0.005,
                 **_HIGH}, vary={"terrain.height_max": 1.0}),
)  # fmt: skip


def values(ground: Ground, args: SpatialOptions) -> tuple[float, ...]:
    """Inclinations or heights that are walked."""
    return ground.values[:1] if args.quick else ground.values


def ground_configs(ground: Ground, value: float, args: SpatialOptions) -> list[RunConfig]:
    """Episodes of one kind of ground and value; every seed has its own field."""
    keys = {
        "terrain.start": 0.6, "terrain.end": 3.0, "terrain.width": 2.0, "terrain.count": 8,
        "duration": 3.0 if args.quick else 13.0, "command.times": [0.0, 0.5],
        "command.v_x": [0.0, 0.4], "command.v_y": [], "command.yaw_rate": [],
    }  # fmt: skip
    varied = {key: factor * value for key, factor in ground.vary.items()}
    one = base(args, keys | ground.keys | varied)
    return [
        dataclasses.replace(one, seed=seed, terrain=dataclasses.replace(one.terrain, seed=seed))
        for seed in range(args.seeds)
    ]


def _grounds(args: SpatialOptions) -> list[tuple[str, list[RunConfig]]]:
    return [
        (one.title, [c for v in values(one, args) for c in ground_configs(one, v, args)])
        for one in GROUNDS
    ]


def _grounds_summary(args: SpatialOptions, done: Done) -> list[Row]:
    return [
        _of_ground(ground, value, done(ground_configs(ground, value, args)))
        for ground in GROUNDS
        for value in values(ground, args)
    ]


def _of_ground(ground: Ground, value: float, runs: list[Row]) -> Row:
    up = [run for run in runs if run.get("crossed")]
    return {
        "ground": ground.name, "value": value, "unit": ground.unit,
        "crossed": share(len(up), len(runs)),
        "falls": sum(run["fell"] for run in runs),
        **median(up, "path_error_m", "path_error_max_m"),
        **median(up, "roll_max_deg", "roll_max_deg"),
    }  # fmt: skip


def _grounds_table(rows: list[Row]) -> str:
    header = ("ground", "value", "crossed", "95 % interval [%]", "distance from the path [m]")
    titles = {ground.name: ground.title for ground in GROUNDS}
    return markdown_table(header, [
        (titles[row["ground"]], f"{row['value']:g} {row['unit']}",
         f"{row['crossed']['count']} of {row['crossed']['episodes']}",
         percent(row["crossed"]["interval"]), number(row["path_error_m"], 3))
        for row in rows
    ])  # fmt: skip


# The paper's: config, its gait here, keys besides, and what is read.
_FLAT: dict[str, tuple[str, dict[str, Any]]] = {
    "trot, the paper's profile": ("trot_velocity", {"gaits.trot.period": 0.4}),
    "bound, the paper's profile": ("bound_velocity", {"gait.names": [GAITS["bound"]]}),
}
_ROUGH: dict[str, tuple[str, dict[str, Any]]] = {
    "trot 0.3 m/s, the paper's field": ("trot_rough", {"gaits.trot.period": 0.4}),
    "trot 0.6 m/s, the paper's field": (
        "trot_rough",
        {"gaits.trot.period": 0.4, "command.v_x": [0.0, 0.6], "duration": 8.0},
    ),
    "bound 0.75 m/s, the paper's field": ("bound_rough", {}),
}
# Of the spatial controller's own settings nothing is the planar one's.
_OWN = {
    "controller": "spatial", "sim.base": "free", "lmpc.command_slew": 4.0,
    "lmpc.position_slack": 0.04,
}  # fmt: skip


def paper_configs(title: str, args: SpatialOptions) -> list[RunConfig]:
    """Episodes of the paper's profile or field, the field with any heading in the world."""
    name, keys = (_FLAT | _ROUGH)[title]
    own: dict[str, Any] = _OWN | keys | ({"duration": 3.0} if args.quick else {})
    rough = title in _ROUGH
    if rough:
        own |= {"leg.swing_height": 0.33, "leg.hold_after": 0.6}
    one = base(args, own, name)
    out = []
    for seed in range(args.robots if rough else args.seeds):
        heading = float(np.random.default_rng([seed, 23]).uniform(-np.pi, np.pi)) if rough else 0.0
        out.append(
            dataclasses.replace(
                one, seed=seed, terrain=dataclasses.replace(one.terrain, seed=seed),
                sim=dataclasses.replace(one.sim, heading=heading),
            )
        )  # fmt: skip
    return out


def _paper(args: SpatialOptions) -> list[tuple[str, list[RunConfig]]]:
    return [(title, paper_configs(title, args)) for title in _FLAT | _ROUGH]


def _paper_summary(args: SpatialOptions, done: Done) -> list[Row]:
    out = []
    for title in _FLAT | _ROUGH:
        runs = done(paper_configs(title, args))
        rough = title in _ROUGH
        hits = [run for run in runs if (run.get("crossed") if rough else not run["fell"])]
        out.append({
            "case": title, "success": share(len(hits), len(runs)),
            "failed_seeds": [s for s, run in enumerate(runs) if run not in hits],
            **median(hits, "velocity_rmse_mps", "velocity_rmse_mps"),
            **median(hits, "pitch_p95_deg", "pitch_p95_deg"),
            **median(hits, "roll_p95_deg", "roll_p95_deg"),
        })  # fmt: skip
    return out


def _paper_table(rows: list[Row]) -> str:
    header = ("the paper's, on the free base", "walked or crossed", "95 % interval [%]",
              "RMSE v_x [m/s]", "pitch, 95 % [deg]", "roll, 95 % [deg]")  # fmt: skip
    return markdown_table(header, [
        (row["case"], f"{row['success']['count']} of {row['success']['episodes']}",
         percent(row["success"]["interval"], 1), number(row["velocity_rmse_mps"], 4),
         number(row["pitch_p95_deg"], 2), number(row["roll_p95_deg"], 2))
        for row in rows
    ])  # fmt: skip


GROUND = Part(
    name="grounds", batches=_grounds, measure=walked, summary=_grounds_summary,
    table=_grounds_table,
)  # fmt: skip
PAPER = Part(
    name="paper", batches=_paper, measure=walked, summary=_paper_summary, table=_paper_table
)
