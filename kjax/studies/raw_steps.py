"""Raw command steps: does the robot fall, touch the ground with its body, or pitch?

The velocity command jumps (lmpc.command_slew = inf) from 0, and from -0.5 m/s, to values from -0.5
to 0.8 m/s at a random phase of the gait: trot with 6 steps of 1 ms and with 10 of 20 ms, planar and
free base, with the default rows (friction, torque, mean force as the reference of R) and with the
paper's literal box. Wanted with the rows: no fall, no body contact, pitch after the step under
5 degrees for steps of up to 0.6 m/s and under 8 beyond.

Leaves results.json, table.md and figure.png in the output folder. Every finished step is kept
there: the same command goes on after Ctrl-C, and several with other --gaits, --bases or --forces
may work in one folder. The trot over 6 ms takes about 2 minutes of one core per base and kind of
limits, the one over 200 ms several times as long.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from kjax import cli
from kjax.config import CommandConfig, RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.options import Count, Options, parse, require, require_names
from kjax.robots import get_robot
from kjax.runs.batches import batch_key, run_batch
from kjax.runs.cache import Cache, open_cache
from kjax.sim.contacts import body_contact
from kjax.sim.intervals import median_interval, wilson
from kjax.sim.observe import find_addresses
from kjax.sim.resolve import build_scene
from kjax.sim.trajectory import Trajectory
from kjax.viz.tables import markdown_table

GAITS = {"trot": "trot_velocity.toml", "trot_long": "trot_velocity_long.toml"}
TITLES = {"trot": "trot, 6 x 1 ms", "trot_long": "trot, 10 x 20 ms"}
BASES = ("planar", "free")
# What keeps forces feasible. Rows: the defaults, which the configs do not touch.
FORCES: dict[str, dict[str, Any]] = {
    "rows": {
        "lmpc.friction": 0.6, "lmpc.torque_fraction": 0.95, "lmpc.input_reference": "mean",
    },
    "box": {
        "lmpc.friction": inf, "lmpc.torque_fraction": inf, "lmpc.input_reference": "zero",
    },
}  # fmt: skip
# Velocity before the step -> earliest time of the step, velocities after it [m/s, s, m/s].
STEPS: dict[float, tuple[float, tuple[float, ...]]] = {
    0.0: (1.0, (-0.5, -0.3, 0.3, 0.6, 0.8)),
    -0.5: (2.0, (0.1, 0.8)),
}
AFTER = 1.5  # s that are looked at after a step
SMALL, LARGE = 0.6, 1.4  # m/s, sizes of steps up to which a limit of the pitch holds
PITCH = {SMALL: 5.0, LARGE: 8.0}  # deg


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A gait on a base with one kind of force limits.

    Attributes:
      gait: key of ``GAITS``.
      base: sim.base.
      forces: key of ``FORCES``.
    """

    gait: str
    base: str
    forces: str

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{self.gait}_{self.base}_{self.forces}"

    @property
    def title(self) -> str:
        """For tables."""
        return f"{TITLES[self.gait]}, {self.base}, {self.forces}"


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, run what is missing, write table and figure; 0 if all was run."""
    args = _parse(argv)
    folder = cli.output_folder(args, "raw_steps")
    cli.configure_jax()
    cache = open_cache(folder, Path(__file__))
    chosen = [
        Setting(gait=gait, base=base, forces=forces)
        for forces in args.forces for gait in args.gaits for base in args.bases
    ]  # fmt: skip
    try:
        for number, case in enumerate(chosen, start=1):
            for start in STEPS:
                configs = [c for _, row in steps_of(case, start, args) for c in row]
                run_batch(
                    cache, configs, torques="every_step", chunk=args.seeds, threads=args.threads,
                    measure=after_step, label=f"{case.name} from {start:g} m/s",
                )  # fmt: skip
            print(f"[{number}/{len(chosen)}] {_sentence(case, measured(case, args, cache))}",
                  flush=True)  # fmt: skip
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        return 130
    found = list(_finished(cache, args))
    record = {
        "quick": args.quick,
        "seeds": args.seeds,
        "pitch_limit_deg": {f"{size:g}": limit for size, limit in PITCH.items()},
        "steps": found,
    }
    text = table(found, quick=args.quick)
    cli.save_study(folder, record, text, lambda path: figure(found, path), file="results.json")
    return 0


@dataclass(kw_only=True)
class RawStepOptions(Options):
    """Options of the study."""

    gaits: tuple[str, ...] = tuple(GAITS)
    """Which of them."""

    bases: tuple[str, ...] = BASES
    """Of the trunk."""

    forces: tuple[str, ...] = tuple(FORCES)
    """How they are limited."""

    seeds: int = 64
    """Episodes per step."""

    threads: Count = None
    """One per core if left out."""

    quick: bool = False
    """2 seeds, one step from each speed: to check the script."""


def _parse(argv: Sequence[str] | None) -> RawStepOptions:
    args = parse(RawStepOptions, argv, __doc__.split("\n\n")[0])
    for name, known in (("gaits", GAITS), ("bases", BASES), ("forces", FORCES)):
        require_names(args, name, known)
    require(args, "seeds", "threads", least=1)
    if args.quick:
        args.seeds = min(args.seeds, 2)
    return args


def steps_of(
    case: Setting, start: float, args: RawStepOptions
) -> Iterator[tuple[float, list[RunConfig]]]:
    """Velocities after a step from ``start``, and the configs of all seeds."""
    earliest, values = STEPS[start]
    if args.quick:
        earliest, values = 0.6, values[-1:]
    base = load_config(
        RunConfig,
        shipped_config(GAITS[case.gait]),
        {"sim.base": case.base, "lmpc.command_slew": inf, **FORCES[case.forces]},
    )
    cycle = base.gaits[base.gait.names[0]].period
    duration = earliest + cycle + (0.2 if args.quick else AFTER)
    for value in values:
        configs = []
        for seed in range(args.seeds):
            phase = np.random.default_rng([seed, 16]).uniform()
            dt = base.lmpc.control_dt
            at = round(round((earliest + phase * cycle) / dt) * dt, 6)
            command = CommandConfig(times=(0.0, at), v_x=(start, value))
            configs.append(dataclasses.replace(base, seed=seed, command=command, duration=duration))
        yield value, configs


def after_step(run: Trajectory, config: RunConfig) -> dict[str, Any]:
    """What an episode did from its step on, and whether its body ever touched the ground."""
    begin = config.command.times[-1]
    later = run.time >= begin - 1e-9
    touched = body_contact(*_scene(config.robot, config.sim.base, config.sim.contacts), run.qpos)
    pitch = np.degrees(np.abs(run.x[later, 2]))
    return {
        "step_time_s": begin,
        "step_pitch_max_deg": float(pitch.max()) if len(pitch) else None,
        "step_pitch_at_s": float(run.time[later][pitch.argmax()]) if len(pitch) else None,
        "body_contact_ticks": int(touched.sum()),
        "body_contact_time_s": float(run.time[touched.argmax()]) if touched.any() else None,
    }


@lru_cache
def _scene(name: str, base: str, contacts: str) -> tuple[Any, Any]:
    """The scene of all episodes, for collisions only, and the robot's addresses in it."""
    keys = {"robot": name, "sim.base": base, "sim.contacts": contacts}
    model = build_scene(load_config(RunConfig, None, keys), visual=False)
    return model, find_addresses(get_robot(name), model)


def measured(case: Setting, args: RawStepOptions, cache: Cache) -> list[dict[str, Any]]:
    """Falls, body contacts and pitch of each step of a finished case."""
    rows = []
    for start in STEPS:
        for value, configs in steps_of(case, start, args):
            keys = [batch_key(cache, c, "every_step", measure=after_step) for c in configs]
            done = [cache[key] for key in keys]
            pitch = np.array([one["step_pitch_max_deg"] or np.nan for one in done], float)
            worst = int(np.nanargmax(pitch))
            size = round(abs(value - start), 6)
            limit = next(deg for most, deg in PITCH.items() if size <= most)
            falls = sum(one["fell"] for one in done)
            touches = sum(one["body_contact_ticks"] > 0 for one in done)
            over = int((pitch >= limit).sum())
            rows.append({
                "gait": case.gait, "base": case.base, "forces": case.forces,
                "from_mps": start, "to_mps": value, "size_mps": size, "episodes": len(done),
                "falls": falls, "falls_interval": wilson(falls, len(done)),
                "body_contacts": touches, "body_contacts_interval": wilson(touches, len(done)),
                "pitch_limit_deg": limit, "pitch_over": over,
                "pitch_over_interval": wilson(over, len(done)),
                "pitch_median_deg": float(np.nanmedian(pitch)),
                "pitch_median_interval_deg": median_interval(pitch[np.isfinite(pitch)]),
                "pitch_max_deg": float(pitch[worst]), "worst_seed": worst,
                "worst_step_time_s": done[worst]["step_time_s"],
                "worst_pitch_at_s": done[worst]["step_pitch_at_s"],
                "fallen_seeds": [i for i, one in enumerate(done) if one["fell"]],
                "qp_unsolved": sum(one.get("qp_unsolved", 0) for one in done),
                "met": falls == 0 and touches == 0 and over == 0,
            })  # fmt: skip
    return rows


def _sentence(case: Setting, rows: Sequence[dict[str, Any]]) -> str:
    falls, touches, over, count = (
        sum(row[key] for row in rows)
        for key in ("falls", "body_contacts", "pitch_over", "episodes")
    )
    worst = max(rows, key=lambda row: row["pitch_max_deg"])
    return (
        f"{case.title}: {falls} falls, {touches} body contacts, {over} beyond the limit of pitch "
        f"in {count} episodes; largest pitch {worst['pitch_max_deg']:.1f} deg "
        f"({worst['from_mps']:g} to {worst['to_mps']:g} m/s, seed {worst['worst_seed']})"
    )


def _finished(cache: Cache, args: RawStepOptions) -> Iterator[dict[str, Any]]:
    """Rows of all cases that the folder holds whole, of this code and as many seeds."""
    for forces in FORCES:
        for gait in GAITS:
            for base in BASES:
                case = Setting(gait=gait, base=base, forces=forces)
                keys = [
                    batch_key(cache, config, "every_step", measure=after_step)
                    for start in STEPS for _, row in steps_of(case, start, args) for config in row
                ]  # fmt: skip
                if all(key in cache for key in keys):
                    yield from measured(case, args, cache)


def table(found: Sequence[dict[str, Any]], *, quick: bool) -> str:
    """Markdown: all steps of a case in one row, then every step."""
    header = ("gait", "base", "forces", "steps of", "episodes", "falls", "body contacts",
              "pitch over", "share over, 95 % interval [%]", "largest pitch [deg]",
              "met")  # fmt: skip
    cases = []
    for forces, gait, base, (limit, inside) in (
        (f, g, b, s) for f in FORCES for g in GAITS for b in BASES for s in _sizes().items()
    ):
        rows = [
            row for row in found
            if (row["forces"], row["gait"], row["base"]) == (forces, gait, base)
            and inside(row["size_mps"])
        ]  # fmt: skip
        if not rows:
            continue
        count, falls, touches, over = (
            sum(row[key] for row in rows)
            for key in ("episodes", "falls", "body_contacts", "pitch_over")
        )
        low, high = wilson(over, count)
        cases.append(
            (TITLES[gait], base, forces, limit, *map(str, (count, falls, touches, over)),
             f"{100 * low:.1f} to {100 * high:.1f}",
             f"{max(row['pitch_max_deg'] for row in rows):.1f}",
             "yes" if all(row["met"] for row in rows) else "NO")
        )  # fmt: skip
    lines = [
        markdown_table(header, cases),
        _steps_table(found),
        "Rows: friction 0.6 and torques 0.95, mean force as the reference of R. Box: the paper's "
        "bounds alone, no reference. Pitch is the largest from the step on; body contact, anything "
        "but a foot that touches the ground at a control tick, is counted over whole episodes.",
    ]
    if quick:
        lines.append("\nA quick check of the machinery: this is no result.")
    return "\n".join(lines) + "\n"


def _steps_table(found: Sequence[dict[str, Any]]) -> str:
    header = ("gait", "base", "forces", "from [m/s]", "to [m/s]", "falls", "body contacts",
              "pitch: median [deg]", "95 % interval", "largest", "of seed", "limit",
              "met")  # fmt: skip
    rows = []
    for row in found:
        interval = row["pitch_median_interval_deg"]
        rows.append(
            (TITLES[row["gait"]], row["base"], row["forces"], f"{row['from_mps']:g}",
             f"{row['to_mps']:g}", str(row["falls"]), str(row["body_contacts"]),
             f"{row['pitch_median_deg']:.2f}",
             "" if interval is None else "{:.2f} to {:.2f}".format(*interval),
             f"{row['pitch_max_deg']:.2f}", str(row["worst_seed"]),
             f"< {row['pitch_limit_deg']:g}", "yes" if row["met"] else "NO")
        )  # fmt: skip
    return markdown_table(header, rows)


def _sizes() -> dict[str, Callable[[float], bool]]:
    return {
        f"up to {SMALL:g} m/s": lambda size: size <= SMALL,
        f"more than {SMALL:g} m/s": lambda size: size > SMALL,
    }


def figure(found: Sequence[dict[str, Any]], path: Path) -> None:
    """Largest and median pitch over the size of the step, with falls and limits."""
    from kjax.viz.style import BLUE, DARK, GREY, RED, STYLE

    if not found:
        return
    colours = {"rows": BLUE, "box": RED}
    gaits = [gait for gait in GAITS if any(row["gait"] == gait for row in found)]
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(
            len(gaits), len(BASES), figsize=(7.2, 0.7 + 2.4 * len(gaits)), sharex=True, sharey=True,
            squeeze=False,
        )  # fmt: skip
        for line, gait in zip(axes, gaits, strict=True):
            for axis, base in zip(line, BASES, strict=True):
                for forces, colour in colours.items():
                    for start, style in ((0.0, "-"), (-0.5, "--")):
                        rows = sorted(
                            (row for row in found
                             if (row["gait"], row["base"], row["forces"], row["from_mps"])
                             == (gait, base, forces, start)),
                            key=lambda row: row["to_mps"] - start,
                        )  # fmt: skip
                        x = [row["to_mps"] - start for row in rows]
                        axis.plot(x, [row["pitch_max_deg"] for row in rows], style, marker="o",
                                  ms=3, color=colour)  # fmt: skip
                        axis.plot(x, [row["pitch_median_deg"] for row in rows], ":", color=colour,
                                  lw=0.8)  # fmt: skip
                        for place, row in zip(x, rows, strict=True):
                            if row["falls"]:
                                axis.annotate(
                                    f"{row['falls']} fell", (place, row["pitch_max_deg"]),
                                    textcoords="offset points", ha="center",
                                    xytext=(0, 4 if start == 0.0 else -9),
                                    fontsize=6, color=colour,
                                )  # fmt: skip
                axis.plot([-SMALL, SMALL], [PITCH[SMALL]] * 2, color=GREY, lw=1.2)
                axis.plot([SMALL, LARGE], [PITCH[LARGE]] * 2, color=GREY, lw=1.2)
                axis.set_yscale("log")
                axis.set_title(f"{TITLES[gait]}, {base} base", loc="left", fontsize=8)
        for axis in axes[:, 0]:
            axis.set_ylabel("pitch after the step [deg]")
        for axis in axes[-1]:
            axis.set_xlabel("change of the command [m/s]")
        axes[0, 0].set_yticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
        axes[0, 0].minorticks_off()
        axes[0, 0].set_xlim(-SMALL, LARGE)
        seeds = found[0]["episodes"]
        marks = [
            plt.Line2D([], [], color=BLUE, marker="o", ms=3),
            plt.Line2D([], [], color=RED, marker="o", ms=3),
            plt.Line2D([], [], color=DARK, ls="--"),
            plt.Line2D([], [], color=DARK, ls=":", lw=0.8),
            plt.Line2D([], [], color=GREY, lw=1.2),
        ]
        names = [f"rows, largest of {seeds}", f"box, largest of {seeds}", "from -0.5 m/s",
                 "median", "wanted"]  # fmt: skip
        fig.legend(marks, names, ncol=5, loc="lower center", fontsize=7)
        fig.tight_layout(rect=(0, 0.13 / len(gaits), 1, 1))
        fig.savefig(path, dpi=150)
        plt.close(fig)
