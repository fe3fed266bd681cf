"""How far it goes: pushes from all sides at all phases, speeds of each gait, switches of gait."""

import dataclasses
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
from kjax.studies.spatial.measures import reached, stood, switched
from kjax.viz.tables import markdown_table

_SHORT = {"gaits.trot.period": 0.4, "gaits.flying_trot.period": 0.4}
DIRECTIONS = tuple(45.0 * k for k in range(8))  # deg, from ahead to the left
PHASES = 8
IMPULSES = {"trot": (15.0, 20.0, 25.0, 30.0), "bound": (10.0, 15.0, 20.0)}  # N s
STANDS = 0.95  # part of the seeds that a push must leave standing


def _asked(v_x: float, yaw_rate: float = 0.0) -> dict[str, Any]:
    return {
        "command.times": [0.0, 0.5], "command.v_x": [0.0, v_x], "command.v_y": [],
        "command.yaw_rate": [0.0, yaw_rate],
    }  # fmt: skip


def push_configs(gait: str, impulse: float, args: SpatialOptions) -> list[RunConfig]:
    """Episodes of one strength: directions, then phases, then seeds, the last first."""
    keys = {
        **_SHORT,
        **_asked(0.5),
        "gait.names": [GAITS[gait]],
        "duration": 3.0 if args.quick else 5.0,
    }
    one = base(args, keys)
    period, out = one.gaits[GAITS[gait]].period, []
    for angle in np.radians(DIRECTIONS[:1] if args.quick else DIRECTIONS):
        for phase in range(1 if args.quick else PHASES):
            begin = round(2.4 + phase * period / PHASES, 3)
            push = dataclasses.replace(
                one.push, times=(begin,), forward=float(impulse * np.cos(angle)),
                lateral=float(impulse * np.sin(angle)), duration=0.1,
            )  # fmt: skip
            out += [dataclasses.replace(one, seed=s, push=push) for s in range(args.seeds)]
    return out


def _impulses(gait: str, args: SpatialOptions) -> tuple[float, ...]:
    return IMPULSES[gait][:1] if args.quick else IMPULSES[gait]


def _pushes(args: SpatialOptions) -> list[tuple[str, list[RunConfig]]]:
    return [
        (
            f"pushes, {gait}",
            [c for one in _impulses(gait, args) for c in push_configs(gait, one, args)],
        )
        for gait in IMPULSES
    ]


def _pushes_summary(args: SpatialOptions, done: Done) -> list[Row]:
    out = []
    for gait in IMPULSES:
        for impulse in _impulses(gait, args):
            up = np.array([not run["fell"] for run in done(push_configs(gait, impulse, args))])
            stands = up.reshape(-1, 1 if args.quick else PHASES, args.seeds).mean(axis=-1)
            out.append({
                "gait": gait, "impulse_Ns": impulse, "seeds": args.seeds,
                "stands": stands.tolist(), "weakest": float(stands.min()),
                "all": share(int(up.sum()), up.size),
            })  # fmt: skip
    return out


def strongest(rows: list[Row], gait: str) -> tuple[float, np.ndarray]:
    """Strongest push that is stood, with all weaker ones: anywhere, and from each direction.

    Args:
      rows: of the part.
      gait: whose.

    Returns:
      Impulse at the weakest direction and phase, and at the weakest phase of each direction
      (8,) [N s]; 0 for none.
    """
    own = sorted((row["impulse_Ns"], row["stands"]) for row in rows if row["gait"] == gait)
    weakest = np.array([np.min(stands, axis=1) for _, stands in own])  # (impulses, directions)
    holds = np.cumprod(weakest >= STANDS, axis=0)
    values = np.array([0.0, *(impulse for impulse, _ in own)])
    each = values[holds.sum(axis=0)]
    return float(each.min()), each


def _pushes_table(rows: list[Row]) -> str:
    header = ("push of 0.1 s", "impulse [N s]", "stood, of all [%]",
              "at the weakest direction and phase [%]")  # fmt: skip
    return markdown_table(header, [
        (row["gait"], f"{row['impulse_Ns']:g}",
         number(100 * row["all"]["count"] / row["all"]["episodes"], 1),
         number(100 * row["weakest"], 0))
        for row in rows
    ])  # fmt: skip


# Gait, and speeds [m/s] or rates [rad/s].
SPEEDS = {
    "trot": tuple(np.arange(1.2, 3.01, 0.2).round(1).tolist()),
    "flying_trot": tuple(np.arange(1.2, 3.61, 0.2).round(1).tolist()),
    "bound": tuple(np.arange(1.0, 3.41, 0.2).round(1).tolist()),
    "turn on the spot": tuple(np.arange(2.0, 8.01, 0.5).round(1).tolist()),
}
WITHIN = 0.1  # of the speed that is asked for


def speed_configs(name: str, value: float, args: SpatialOptions) -> list[RunConfig]:
    """Episodes of one speed."""
    turns = name not in IMPULSES and name != "flying_trot"
    gait = "trot" if turns else name
    asked = _asked(0.0, value) if turns else _asked(value)
    keys = {**_SHORT, **asked, "gait.names": [GAITS[gait]], "duration": 3.0 if args.quick else 7.0}
    one = base(args, keys)
    return [dataclasses.replace(one, seed=seed) for seed in range(args.seeds)]


def _speed_values(name: str, args: SpatialOptions) -> tuple[float, ...]:
    return SPEEDS[name][:1] if args.quick else SPEEDS[name]


def _speeds(args: SpatialOptions) -> list[tuple[str, list[RunConfig]]]:
    return [
        (name, [c for v in _speed_values(name, args) for c in speed_configs(name, v, args)])
        for name in SPEEDS
    ]


def _speeds_summary(args: SpatialOptions, done: Done) -> list[Row]:
    out = []
    for name in SPEEDS:
        column = 2 if name == "turn on the spot" else 0
        for value in _speed_values(name, args):
            runs = done(speed_configs(name, value, args))
            up = [
                run for run in runs
                if run["reached"] and abs(run["reached"][column] / value - 1.0) <= WITHIN
            ]  # fmt: skip
            out.append({
                "gait": name, "asked": value, "held": share(len(up), len(runs)),
                "falls": sum(run["fell"] for run in runs),
                **median(up, "reached", "reached", column),
                **median(up, "roll_max_deg", "tilt_max_deg", 0),
                **median(up, "pitch_max_deg", "tilt_max_deg", 1),
            })  # fmt: skip
    return out


def fastest(rows: list[Row], name: str) -> Row | None:
    """The fastest that every seed holds where none fell at a slower one; ``None`` if none is."""
    best = None
    for row in sorted((one for one in rows if one["gait"] == name), key=lambda one: one["asked"]):
        if row["falls"]:
            break
        if row["held"]["count"] == row["held"]["episodes"]:
            best = row
    return best


def _speeds_table(rows: list[Row]) -> str:
    header = ("gait", "fastest that every seed holds", "reached", "roll, largest [deg]",
              "pitch, largest [deg]", "next step held by")  # fmt: skip
    lines = []
    for name in SPEEDS:
        best, unit = fastest(rows, name), "rad/s" if name == "turn on the spot" else "m/s"
        later = [
            row for row in rows
            if row["gait"] == name and row["asked"] > (best["asked"] if best else 0.0)
        ]  # fmt: skip
        beyond = later[0]["held"] if later else None
        lines.append((
            name.replace("_", " "), f"{best['asked']:g} {unit}" if best else "none",
            number(best["reached"], 2) if best else "",
            number(best["roll_max_deg"], 1) if best else "",
            number(best["pitch_max_deg"], 1) if best else "",
            f"{beyond['count']} of {beyond['episodes']}" if beyond else "end of the search",
        ))  # fmt: skip
    return markdown_table(header, lines)


SWITCH_PHASES = 64
_ROWS = (("trot", "bound", "trot"), ("trot",) * 3, ("bound",) * 3)


def switch_configs(gaits: tuple[str, ...], args: SpatialOptions) -> list[RunConfig]:
    """Episodes of one order of gaits, one for each phase of the switches."""
    names = tuple(GAITS[gait] for gait in gaits)
    one = base(args, {"gait.names": list(names)}, "omni_switch")
    trot, bound = (one.gaits[GAITS[gait]].period for gait in ("trot", "bound"))
    out = []
    for k in range(2 if args.quick else SWITCH_PHASES):
        part = k / SWITCH_PHASES
        times = (0.0, round(3.0 + part * trot, 3), round(6.0 + part * bound, 3))
        gait = dataclasses.replace(
            one.gait, names=names, times=times, also=(GAITS["trot"], GAITS["bound"])
        )
        out.append(dataclasses.replace(one, seed=k, gait=gait))
    return out


def _switches(args: SpatialOptions) -> list[tuple[str, list[RunConfig]]]:
    return [("switches", [c for gaits in _ROWS for c in switch_configs(gaits, args)])]


def _switches_summary(args: SpatialOptions, done: Done) -> Row:
    there, *steady = (done(switch_configs(gaits, args)) for gaits in _ROWS)
    above = []
    for run, *others in zip(there, *steady, strict=True):
        if run["peaks_deg"] is None or any(one["peaks_deg"] is None for one in others):
            continue
        # The gaits on both sides, each alone.
        alone = np.maximum(*(np.array(one["peaks_deg"]) for one in others))
        above.append((np.array(run["peaks_deg"]) - alone).max())
    return {
        "falls": share(sum(run["fell"] for run in there), len(there)),
        "above_median_deg": float(np.median(above)) if above else None,
        "above_largest_deg": float(np.max(above)) if above else None,
        "peak_largest_deg": max(
            (float(np.max(run["peaks_deg"])) for run in there if run["peaks_deg"]), default=None
        ),
    }


def _switches_table(row: Row) -> str:
    header = ("trot, bound, trot while turning", "falls", "95 % interval [%]",
              "peak of roll or pitch above either gait alone, median [deg]",
              "largest [deg]")  # fmt: skip
    return markdown_table(header, [
        (f"{row['falls']['episodes']} phases", str(row["falls"]["count"]),
         percent(row["falls"]["interval"]), number(row["above_median_deg"], 1),
         number(row["above_largest_deg"], 1))
    ])  # fmt: skip


PUSHES = Part(
    name="pushes", batches=_pushes, measure=stood, summary=_pushes_summary, table=_pushes_table
)
SPEED = Part(
    name="speeds", batches=_speeds, measure=reached, summary=_speeds_summary, table=_speeds_table
)
SWITCHES = Part(
    name="switches", batches=_switches, measure=switched, summary=_switches_summary,
    table=_switches_table,
)  # fmt: skip
